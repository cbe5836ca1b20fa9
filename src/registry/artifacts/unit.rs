//! `rapid.service`: records without a screen from boot to shutdown.

use super::HEADER;
use crate::registry::spec::Registry;

/// Where the unit expects the registry.
pub const SYSTEM_REGISTRY: &str = "/etc/rapid/devices.toml";

/// The unit. The rig's name is the only thing taken from the registry; its characters are letters,
/// digits, `-`, `_` and `.`, none of which systemd interprets.
pub(super) fn unit(registry: &Registry) -> String {
    let rig = &registry.rig.name;
    format!(
        r"{HEADER}
# Before the first start:
#   useradd --system --no-create-home --groups video,dialout rapid
#   install -D -m 644 devices.toml {SYSTEM_REGISTRY}
[Unit]
Description=rapid: sensors and recording of rig {rig}
Documentation=man:udev(7)
After=systemd-udevd.service local-fs.target time-sync.target
ConditionPathExists={SYSTEM_REGISTRY}

[Service]
Type=exec
ExecStart=/usr/local/bin/rapid --headless --record --config {SYSTEM_REGISTRY} --out /var/lib/rapid
User=rapid
SupplementaryGroups=video dialout
StateDirectory=rapid
# SIGINT ends the episode in progress and closes its file; that takes one fsync.
KillSignal=SIGINT
KillMode=mixed
TimeoutStopSec=30
Restart=on-failure
RestartSec=2
# The mask and control threads ask for real-time scheduling; shared memory is locked in place.
LimitRTPRIO=80
LimitMEMLOCK=infinity

# What it may touch: cameras, serial lines, its recordings, and the bus that other programs
# subscribe to in /tmp and /dev/shm (which is why /tmp is not private).
DevicePolicy=closed
DeviceAllow=char-video4linux rw
DeviceAllow=char-ttyACM rw
DeviceAllow=char-ttyUSB rw
ReadWritePaths=/tmp /dev/shm
ProtectSystem=strict
ProtectHome=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectHostname=yes
NoNewPrivileges=yes
CapabilityBoundingSet=
RestrictAddressFamilies=AF_UNIX AF_NETLINK
RestrictNamespaces=yes
RestrictSUIDSGID=yes
LockPersonality=yes
SystemCallArchitectures=native

[Install]
WantedBy=multi-user.target
"
    )
}
