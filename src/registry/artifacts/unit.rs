//! `rapid.service`: records without a screen from boot to shutdown.

use super::HEADER;
use crate::registry::spec::{DeviceSpec, NodeSpec, Opens, Registry};

/// Where the unit expects the registry.
pub const SYSTEM_REGISTRY: &str = "/etc/rapid/devices.toml";

/// The unit. The rig's name is the only thing taken from the registry; its characters are letters,
/// digits, `-`, `_` and `.`, none of which systemd interprets.
pub(super) fn unit(registry: &Registry) -> String {
    let rig = &registry.rig.name;
    // Programs that open the USB device itself; the group is that of the rules.
    let usb = registry.devices.iter().any(|device| device.node.opens() == Opens::Usb);
    let is_bus = |device: &DeviceSpec| matches!(device.node, NodeSpec::Can(_)) && device.node.opens() == Opens::Net;
    let can = if registry.devices.iter().any(is_bus) { " AF_CAN" } else { "" };
    let (make_group, group, allow) = if usb {
        ("#   groupadd --system --force plugdev\n", " plugdev", "DeviceAllow=char-usb_device rw\n")
    } else {
        ("", "", "")
    };
    let groups = format!("video dialout{group}");
    let listed = groups.replace(' ', ",");
    let touched = if usb { "cameras, serial lines, USB devices" } else { "cameras, serial lines" };
    format!(
        r"{HEADER}
# Before the first start:
{make_group}#   useradd --system --no-create-home --groups {listed} rapid
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
SupplementaryGroups={groups}
StateDirectory=rapid
# SIGINT ends the episode in progress and closes its file; that takes one fsync.
KillSignal=SIGINT
KillMode=mixed
TimeoutStopSec=30
Restart=on-failure
RestartSec=2
# The thread `mask` asks for real-time scheduling.
LimitRTPRIO=80

# What it may touch: {touched}, its recordings, and the bus that other programs
# subscribe to in /tmp and /dev/shm (which is why /tmp is not private).
DevicePolicy=closed
DeviceAllow=char-video4linux rw
DeviceAllow=char-ttyACM rw
DeviceAllow=char-ttyUSB rw
{allow}ReadWritePaths=/tmp /dev/shm
ProtectSystem=strict
ProtectHome=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectHostname=yes
NoNewPrivileges=yes
CapabilityBoundingSet=
RestrictAddressFamilies=AF_UNIX AF_NETLINK{can}
RestrictNamespaces=yes
RestrictSUIDSGID=yes
LockPersonality=yes
SystemCallArchitectures=native

[Install]
WantedBy=multi-user.target
"
    )
}
