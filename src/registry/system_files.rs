//! Files generated from the registry: udev rules, module descriptors, systemd units, a layout for Foxglove.
//!
//! What to write, not where or how (`commands::artifacts` writes). Nothing but the registry decides it, and the current folder
//! where the registry was named relative to it.
//!
//! Invariant: a serial number, which a device chose, can neither add a line to a file nor match
//! more than itself; where a format cannot express it, a comment in the file states so.

mod layout;
mod udev_rules;
mod upload;

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::PathBuf;

use super::spec::{DeviceSpec, IdentitySpec, InputSpec, NodeSpec, Registry};

/// First line of every generated file but the layout, which is JSON: a file that begins otherwise must not be removed.
pub const HEADER: &str = "# Written by `rapid artifacts` from devices.toml: change that file and run it again.";

/// Folder of the descriptors among the system files.
pub const DESCRIPTORS: &str = "descriptors";

/// One file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SystemFile {
    /// Relative to the folder of system files, `udev/` in the repository.
    pub path: PathBuf,
    /// Its text.
    pub contents: String,
    /// Its permissions.
    pub mode: u32,
    /// Its purpose.
    pub kind: SystemFileKind,
}

/// The purpose of a file; decides where it is installed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SystemFileKind {
    /// udev rules.
    Rules,
    /// systemd unit.
    Unit,
    /// Descriptor of one module.
    Descriptor,
    /// Layout for the Foxglove app.
    Layout,
}

/// Every file generated from `registry`.
pub fn system_files(registry: &Registry) -> Vec<SystemFile> {
    let file = |path: PathBuf, contents, kind| SystemFile { path, contents, mode: 0o644, kind };
    let mut all = vec![
        file("99-rapid.rules".into(), udev_rules::rules(registry), SystemFileKind::Rules),
        file("rapid.service".into(), unit(registry), SystemFileKind::Unit),
        file("rapid-upload.service".into(), upload::service(), SystemFileKind::Unit),
        file("rapid-upload.timer".into(), upload::timer(), SystemFileKind::Unit),
        file("rapid-upload-check.service".into(), upload::check_service(), SystemFileKind::Unit),
        file("rapid-upload-check.timer".into(), upload::check_timer(), SystemFileKind::Unit),
        file("foxglove.json".into(), layout::layout(registry), SystemFileKind::Layout),
    ];
    for device in &registry.devices {
        let path = PathBuf::from(DESCRIPTORS).join(format!("{}.yaml", device.name));
        let stable_path = udev_rules::identify(registry, device).ok().map(|_| format!("/dev/rapid/{}", device.name));
        all.push(file(path, descriptor(device, stable_path.as_deref()), SystemFileKind::Descriptor));
    }
    all
}

/// `descriptors/<name>.yaml`: a description of a module, for people and for other programs (paper, appendix "Module
/// Catalog": module, slot, sensors, bring-up). The descriptor of one entry; `stable_path` is its name by the rules, if
/// any.
fn descriptor(device: &DeviceSpec, stable_path: Option<&str>) -> String {
    let slot = device.mount.map_or_else(|| "null".to_owned(), |mount| quoted(&mount.to_string()));
    format!(
        "{HEADER}\n\
         module: {}\n\
         slot: {slot}\n\
         sensors:\n{}\
         bring_up: \"{}\"\n\
         {}\
         path: {}\n\
         topic: {}\n\
         bit: {}\n",
        quoted(&device.name),
        sensor(&device.node),
        if device.identity.usb().is_some() { "usb" } else { "lan" },
        identity(&device.identity),
        optional(stable_path),
        quoted(&device.topic),
        device.id,
    )
}

fn optional(text: Option<&str>) -> String {
    text.map_or_else(|| "null".to_owned(), quoted)
}

fn identity(identity: &IdentitySpec) -> String {
    let Some(usb) = identity.usb() else { return "identity: null\n".to_owned() };
    format!(
        "identity:\n  vid: \"{:04x}\"\n  pid: \"{:04x}\"\n  serial: {}\n  port: {}\n",
        usb.vid,
        usb.pid,
        optional(usb.serial.as_deref()),
        optional(usb.port.as_deref()),
    )
}

fn sensor(node: &NodeSpec) -> String {
    format!("  - kind: \"{}\"\n{}", node.kind(), node.of_kind().descriptor())
}

/// A YAML double-quoted scalar (YAML 1.2.2 section 7.3.1), in ASCII: parsers differ in their treatment of
/// line separators and non-characters.
pub(crate) fn quoted(text: &str) -> String {
    let mut quoted = String::with_capacity(text.len() + 2);
    quoted.push('"');
    for c in text.chars() {
        // Writing to a String cannot fail.
        let _ = match (c, u32::from(c)) {
            ('"' | '\\', _) => write!(quoted, "\\{c}"),
            (' '..='~', _) => write!(quoted, "{c}"),
            (_, code @ 0..=0xffff) => write!(quoted, "\\u{code:04x}"),
            (_, code) => write!(quoted, "\\U{code:08x}"),
        };
    }
    quoted.push('"');
    quoted
}

/// Where the unit expects the registry.
pub const SYSTEM_REGISTRY: &str = "/etc/rapid/devices.toml";

/// Device nodes: the group that may open them, set by our rules or by udev's, and their name in /proc/devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Nodes {
    group: &'static str,
    kind: &'static str,
}

/// A program opens the USB device itself.
pub(crate) const USB: Nodes = Nodes { group: "plugdev", kind: "char-usb_device" };
/// A stop or a button is a key.
const KEYS: Nodes = Nodes { group: "input", kind: "char-input" };
/// A stop, a button, or the brake of a joint, is a line of a GPIO chip.
pub(crate) const GPIO: Nodes = Nodes { group: "gpio", kind: "char-gpiochip" };

/// What the entries of a registry require of the system.
#[derive(Debug, Default)]
pub(crate) struct Needs {
    /// Kinds of sockets, besides those of udev, the journal and programs. A CAN adapter on a serial line has none.
    pub(crate) sockets: BTreeSet<&'static str>,
    /// Nodes that only some registries need.
    pub(crate) nodes: BTreeSet<Nodes>,
    /// Other programs are run: nodes and hooks.
    pub(crate) programs: bool,
    /// Motors have a guard, which outlives the program.
    pub(crate) guard: bool,
    /// A stop or a button is on a serial port of the board.
    uarts: bool,
}

impl Needs {
    fn from_registry(registry: &Registry) -> Self {
        let mut needs = Self::default();
        for device in &registry.devices {
            device.node.of_kind().need(&mut needs);
            needs.programs |= !device.hooks.is_empty();
        }
        for (_, input) in registry.inputs() {
            match input {
                InputSpec::Key(_) => _ = needs.nodes.insert(KEYS),
                InputSpec::Gpio(_) => _ = needs.nodes.insert(GPIO),
                // Those on USB are allowed to every unit.
                InputSpec::Serial(line) => needs.uarts |= !line.path.starts_with("/dev/serial"),
                InputSpec::Field(_) => {}
            }
        }
        needs
    }

    /// For nodes that only some registries need: commands that create their groups, the groups, and the permissions.
    fn nodes(&self) -> (String, String, String) {
        let (mut make, mut groups, mut allow) = (String::new(), String::new(), String::new());
        for Nodes { group, kind } in &self.nodes {
            make += &["#   groupadd --system --force ", group, "\n"].concat();
            groups += &[" ", group].concat();
            allow += &["DeviceAllow=", kind, " rw\n"].concat();
        }
        if self.uarts {
            allow += UARTS;
        }
        (make, groups, allow)
    }

    /// `RestrictAddressFamilies=`: udev uses netlink, the journal and programs `AF_UNIX`.
    fn families(&self) -> String {
        let all = ["AF_UNIX", "AF_NETLINK"].into_iter().chain(self.sockets.iter().copied());
        all.collect::<Vec<_>>().join(" ")
    }

    /// Settings that only some registries permit, one line each.
    fn only_without(&self) -> String {
        let network = if self.sockets.iter().any(|family| family.starts_with("AF_INET")) { "" } else { NO_NETWORK };
        let programs = if self.programs { PROGRAMS } else { "MemoryDenyWriteExecute=yes\n" };
        format!("{network}{programs}")
    }
}

/// For a unit with a stop or a button on a serial port of the board.
const UARTS: &str = "DeviceAllow=char-ttyS rw\nDeviceAllow=char-ttyAMA rw\n";

/// For a unit without sockets for the network.
const NO_NETWORK: &str = "IPAddressDeny=any\n";

/// For a unit with motors.
const GUARDED: &str = "\
# Motors have a guard: a separate process that stops them if rapid is killed. It needs no signal to exit.
KillMode=process
# The thread that controls the motors must not wait for a disk when memory is short.
LimitMEMLOCK=infinity
";

/// A hint for users with programs.
const PROGRAMS: &str = "\
# Programs run under these settings as well. One that needs the network gets it from `systemctl edit rapid`:
#   [Service]
#   RestrictAddressFamilies=AF_INET AF_INET6
#   IPAddressAllow=any
";

/// `rapid.service`: runs without a screen from boot to shutdown, and records when a member of its group requests it.
///
/// Invariant: the service may do what the entries of its registry need, and no more: kinds of sockets, device nodes
/// and groups follow from them. `systemd-analyze security` gives every unit 2.0 or better (a test, on every kind of
/// registry).
///
/// Settings that the unit deliberately omits, as named in systemd.exec(5):
///
/// * `PrivateTmp`, `PrivateNetwork`, `PrivateDevices`: subscribers find the bus through `/tmp` and `/dev/shm`, udev
///   reports through a netlink socket of the machine's network, and the program needs devices.
/// * `RemoveIPC`: it would remove from `/dev/shm` what the bus shares with subscribers of the same user, and leave
///   the other half in `/tmp`.
/// * `ProcSubset`: the holder of the mask is in `/proc/locks`, routes are in `/proc/net`, the boot's id and the
///   machine's name are in `/proc/sys`.
/// * `RestrictRealtime`: the thread that publishes the mask runs with real-time priority.
///
/// The unit. The rig's name is the only thing taken from the registry; its characters are letters,
/// digits, `-`, `_` and `.`, none of which systemd interprets.
fn unit(registry: &Registry) -> String {
    let rig = &registry.rig.name;
    let needs = Needs::from_registry(registry);
    let (families, only_without, kill_mode) =
        (needs.families(), needs.only_without(), if needs.guard { GUARDED } else { "KillMode=mixed\n" });
    let (make_group, group, allow) = needs.nodes();
    let groups = format!("video dialout{group}");
    let listed = groups.replace(' ', ",");
    let touched =
        if needs.nodes.contains(&USB) { "cameras, serial lines, USB devices" } else { "cameras, serial lines" };
    format!(
        r"{HEADER}
# Before the first start:
{make_group}#   useradd --system --user-group --no-create-home --groups {listed} rapid
#   install -D -m 644 devices.toml {SYSTEM_REGISTRY}
# Members of the group of that user read the recordings, in /var/lib/rapid, and control the service (`rapid monitor`,
# `rapid episode start`). To be in it from the next login on:
#   usermod --append --groups rapid YOUR_NAME
[Unit]
Description=rapid: sensors and recording of rig {rig}
Documentation=man:udev(7)
After=systemd-udevd.service local-fs.target time-sync.target
ConditionPathExists={SYSTEM_REGISTRY}

[Service]
Type=exec
ExecStart=/usr/local/bin/rapid --headless --group-control --config {SYSTEM_REGISTRY} --out /var/lib/rapid
User=rapid
SupplementaryGroups={groups}
StateDirectory=rapid
StateDirectoryMode=0750
UMask=0027
# SIGINT ends the episode in progress and closes its file; that takes one fsync.
KillSignal=SIGINT
{kill_mode}TimeoutStopSec=30
# A BAD episode is not a failure of the service.
SuccessExitStatus=4
Restart=on-failure
RestartSec=2
# A rapid that hangs is killed, and started again.
WatchdogSec=20
# The thread `mask` requests real-time scheduling.
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
ProtectClock=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectProc=invisible
PrivateMounts=yes
PrivateUsers=yes
NoNewPrivileges=yes
CapabilityBoundingSet=
RestrictNamespaces=yes
RestrictSUIDSGID=yes
LockPersonality=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @keyring
SystemCallErrorNumber=EPERM
# The kinds of sockets that the devices of the registry need; AF_NETLINK is for udev.
RestrictAddressFamilies={families}
{only_without}
[Install]
WantedBy=multi-user.target
"
    )
}

#[cfg(test)]
mod tests;
