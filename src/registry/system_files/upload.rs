//! The units that bring finished episodes to a store (any that rclone knows: S3, SFTP, a disk), and read back what is there.
//!
//! Invariant: what is being written is not touched: its name ends in `.partial` until it is closed.
//! Invariant: nothing is removed here unless a time is set for it, and the copy in the store was read back and is equal.
//! Invariant: nothing is removed while copies are read back: both hold the lock `.upload.lock` in the folder of the episodes.

use super::HEADER;

/// The unit. Its configuration is in `/etc/rapid/upload.conf`.
pub(super) fn service() -> String {
    let steps = steps();
    format!(
        r"{HEADER}
# Before the first start, as root:
#   apt install rclone
#   rclone config --config /etc/rapid/rclone.conf                   # names a store, such as lab
#   echo 'STORE=lab:episodes/rig-1' >/etc/rapid/upload.conf
#   chown root:rapid /etc/rapid/rclone.conf; chmod 640 /etc/rapid/rclone.conf
#   systemctl enable --now rapid-upload.timer rapid-upload-check.timer
# REMOVE_AFTER=7d in upload.conf also removes episodes of that age here, once their copies were read back and are equal.
# Without it nothing is removed. RCLONE_BWLIMIT=2M in upload.conf leaves the rest of the network to others.
[Unit]
Description=rapid: finished episodes to the store
ConditionPathExists=/etc/rapid/upload.conf
Wants=network-online.target
After=network-online.target

[Service]
{BEFORE}# A file that was copied is known by its checksum, and a break costs the file that was being copied. What is being written,
# or waits to be repaired, is called *.mcap.partial. An episode in the store is never replaced: another of its name is an
# error here. Each command runs whether or not those before it failed, and the unit fails in the end if one did: an episode
# that cannot be copied does not keep the others from being removed. Checked is what was listed before the copy, by size and
# by the checksum that the store keeps: a byte that changes in the store behind that checksum is found by
# rapid-upload-check.service, which reads the copies.
ExecStart=/bin/sh -uc '{steps}'
{AFTER}"
    )
}

/// The unit that reads back every copy whose episode is still here, and fails if one differs. An episode of less than a day may
/// be on its way to the store.
pub(super) fn check_service() -> String {
    format!(
        r"{HEADER}
# Reads the copies of all episodes that are still here, and compares every byte: see rapid-upload.service for the first start.
# A copy that differs, or is missing after a day, makes this unit fail, and the journal names it (of one that differs rclone
# prints the name alone). It is damaged, or it is another episode of the same name: delete neither before `rapid inspect` has
# read both. Moved aside in the store, the copy is kept, and rapid-upload.service copies the episode that is here:
#   rclone --config /etc/rapid/rclone.conf moveto --ignore-checksum lab:episodes/rig-1/NAME.mcap lab:episodes/rig-1/NAME.mcap.aside
[Unit]
Description=rapid: copies in the store read back
ConditionPathExists=/etc/rapid/upload.conf
Wants=network-online.target
After=network-online.target

[Service]
{BEFORE}ExecStart=/usr/bin/flock ${{EPISODES}}/{LOCK} /usr/bin/rclone check ${{EPISODES}} ${{STORE}} {EPISODES} --min-age=1d --one-way --download --differ=-
{AFTER}"
    )
}

/// The timer of the unit that reads back.
pub(super) fn check_timer() -> String {
    format!(
        "{HEADER}
[Unit]
Description=rapid: copies in the store read back, every week

[Timer]
OnCalendar=weekly
RandomizedDelaySec=1d
Persistent=yes

[Install]
WantedBy=timers.target
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

/// What both units begin their `[Service]` with: the user, the folder of episodes and the configuration of the store.
const BEFORE: &str = "\
Type=oneshot
User=rapid
UMask=0027
Environment=EPISODES=/var/lib/rapid
Environment=RCLONE_CONFIG=/etc/rapid/rclone.conf
EnvironmentFile=/etc/rapid/upload.conf
";
/// What both units end it with: a lower priority than the recorder, and no privileges.
const AFTER: &str = "\
Nice=10
IOSchedulingClass=idle
PrivateTmp=yes
ProtectSystem=strict
ProtectHome=yes
ReadWritePaths=/var/lib/rapid
NoNewPrivileges=yes
CapabilityBoundingSet=
";
/// Held while copies are read back, and while episodes are removed.
const LOCK: &str = ".upload.lock";
/// Finished episodes.
const EPISODES: &str = "--max-depth 1 --include=*.mcap";
/// The files of sessions, of which one may change at any moment.
const SESSIONS: &str = "--max-depth 1 --include=session*.toml --include=session*.md";
/// What people noted about episodes, here or in the store: the newer one counts.
const NOTES: &str = "--max-depth 1 --include=*.mcap.toml --update";

/// The episodes that the list of the shell's variable `listed` names.
const LISTED: &str = r#"--max-depth 1 --files-from-raw "$$listed""#;

/// The commands of the upload; `$$` is a `$` of the shell. An episode that is closed after the list was made is left to the next
/// start. Only what rclone lists as equal after reading both sides is removed, and nothing while copies are read back.
fn steps() -> String {
    format!(
        r#"listed=$$(mktemp) && equal=$$(mktemp) || exit; failed=; \
  rclone copy "$$EPISODES" "$$STORE" {SESSIONS} --checksum || failed=yes; \
  rclone copy "$$EPISODES" "$$STORE" {NOTES} || failed=yes; \
  rclone lsf "$$EPISODES" {EPISODES} --files-only >"$$listed" || failed=yes; \
  rclone copy "$$EPISODES" "$$STORE" {LISTED} --checksum --immutable || failed=yes; \
  rclone check "$$EPISODES" "$$STORE" {LISTED} --one-way || failed=yes; \
  if [ -n "$${{REMOVE_AFTER:-}}" ] && exec 9>>"$$EPISODES/{LOCK}" && flock --nonblock 9; then \
    rclone check "$$EPISODES" "$$STORE" {EPISODES} --min-age "$$REMOVE_AFTER" --one-way --download \
      --match "$$equal" --differ=- || failed=yes; \
    while IFS= read -r name; do rm -v -- "$$EPISODES/$$name" || failed=yes; done <"$$equal"; \
  fi; rm "$$listed" "$$equal"; [ -z "$$failed" ]"#
    )
}
