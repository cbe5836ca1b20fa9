//! The units that bring finished episodes to a store (any that rclone knows: S3, SFTP, a disk).
//!
//! Invariant: what is being written is not touched: its name ends in `.partial` until it is closed.
//! Invariant: nothing is removed here unless a time is set for it, and the copy in the store was read back and is equal.

use super::HEADER;

/// The unit. Its configuration is in `/etc/rapid/upload.conf`.
pub(super) fn service() -> String {
    format!(
        r"{HEADER}
# Before the first start, as root:
#   apt install rclone
#   rclone config --config /etc/rapid/rclone.conf                   # names a store, such as lab
#   echo 'STORE=lab:episodes/rig-1' >/etc/rapid/upload.conf
#   chown root:rapid /etc/rapid/rclone.conf; chmod 640 /etc/rapid/rclone.conf
#   systemctl enable --now rapid-upload.timer
# REMOVE_AFTER=7d in upload.conf also removes episodes of that age here, once their copies were read back and are equal.
# Without it nothing is removed.
[Unit]
Description=rapid: finished episodes to the store
ConditionPathExists=/etc/rapid/upload.conf
Wants=network-online.target
After=network-online.target

[Service]
Type=oneshot
User=rapid
UMask=0027
Environment=EPISODES=/var/lib/rapid
Environment=RCLONE_CONFIG=/etc/rapid/rclone.conf
EnvironmentFile=/etc/rapid/upload.conf
# A file that was copied is known by its checksum, and a break costs the file that was being copied. What is being written,
# or waits to be repaired, is called *.mcap.partial. An episode in the store is never replaced: another of its name is an
# error here.
ExecStart=/usr/bin/rclone copy ${{EPISODES}} ${{STORE}} {SESSIONS} --checksum
ExecStart=/usr/bin/rclone copy ${{EPISODES}} ${{STORE}} {EPISODES} --checksum --immutable
ExecStart=/usr/bin/rclone check ${{EPISODES}} ${{STORE}} {EPISODES} --one-way
ExecStart=/bin/sh -euc '{REMOVE}'
Nice=10
IOSchedulingClass=idle
PrivateTmp=yes
ProtectSystem=strict
ProtectHome=yes
ReadWritePaths=/var/lib/rapid
NoNewPrivileges=yes
CapabilityBoundingSet=
"
    )
}

/// The timer of the unit.
pub(super) fn timer() -> String {
    format!(
        "{HEADER}
[Unit]
Description=rapid: finished episodes to the store, every ten minutes

[Timer]
OnBootSec=5min
OnUnitInactiveSec=10min
RandomizedDelaySec=1min

[Install]
WantedBy=timers.target
"
    )
}

/// Finished episodes.
const EPISODES: &str = "--max-depth 1 --include=*.mcap";
/// The files of sessions, of which one may change at any moment.
const SESSIONS: &str = "--max-depth 1 --include=session*.toml --include=session*.md";

/// Only what rclone lists as equal after reading both sides is removed; `$$` is a `$` of the shell.
const REMOVE: &str = r#"[ -n "$${REMOVE_AFTER:-}" ] || exit 0; equal=$$(mktemp); \
  rclone check "$$EPISODES" "$$STORE" --max-depth 1 --include=*.mcap --min-age "$$REMOVE_AFTER" --one-way --download \
    --match "$$equal" || differs=yes; \
  while IFS= read -r name; do rm -v -- "$$EPISODES/$$name"; done <"$$equal"; rm "$$equal"; [ -z "$${differs:-}" ]"#;
