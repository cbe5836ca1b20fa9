//! From what is the case on a machine to what is wrong with it, and what to do.
//!
//! Pure: facts and registry in, findings out.

use std::path::PathBuf;

use serde::Serialize;

use super::bandwidth::{self, Wish};
use super::facts::{Facts, Node};
use super::machine;
use super::usb::UsbDevice;
use crate::registry::{Assigner, Attachment, DeviceNode, DeviceSpec, NodeSpec, Opens, Registry, UsbIdentity};

/// A camera that runs slower than this, Mbit/s, is in the wrong port or on a bad cable.
const SLOWEST: f64 = 480.0;

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Level {
    /// As it should be.
    Ok,
    /// It works, and may surprise.
    Warn,
    /// Something will not work.
    Bad,
}

/// Something that was looked at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Finding {
    /// How bad it is.
    pub(super) level: Level,
    /// What it is about: one word.
    pub(super) about: &'static str,
    /// What is the case.
    pub(super) what: String,
    /// What to do, a command where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) fix: Option<String>,
}

impl Finding {
    pub(super) fn ok(about: &'static str, what: impl Into<String>) -> Self {
        Self { level: Level::Ok, about, what: what.into(), fix: None }
    }

    pub(super) fn warn(about: &'static str, what: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { level: Level::Warn, about, what: what.into(), fix: Some(fix.into()) }
    }

    pub(super) fn bad(about: &'static str, what: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { level: Level::Bad, about, what: what.into(), fix: Some(fix.into()) }
    }
}

/// Everything there is to say. `rules` is what `rapid artifacts` would write.
#[must_use]
pub(super) fn judge(facts: &Facts, registry: Option<&Registry>, rules: Option<&str>) -> Vec<Finding> {
    let entries = registry.map(|registry| registry.devices.as_slice()).unwrap_or_default();
    let plugged = plugged(registry, &facts.usb);
    let mut found = Vec::new();
    found.extend(buses(facts, &plugged));
    found.extend(speeds(&plugged));
    found.extend(serials(&facts.usb, entries));
    found.extend(nodes(facts, entries, &plugged));
    found.extend(machine::udev(facts, rules));
    found.extend(suspending(&plugged));
    found.extend(machine::can(facts, entries, &plugged));
    found.extend(machine::limits(facts, registry));
    found.extend(machine::disk(facts, registry));
    found
}

/// Entries with the USB device that they mean, of those that are plugged in, as a rig that starts now would assign
/// them.
#[must_use]
pub(super) fn plugged<'a>(
    registry: Option<&'a Registry>,
    usb: &'a [UsbDevice],
) -> Vec<(&'a DeviceSpec, &'a UsbDevice)> {
    let Some(registry) = registry else { return Vec::new() };
    let mut assigner = Assigner::new(registry);
    let mut units: Vec<&UsbDevice> = usb.iter().collect();
    // In the order in which hot-plug tells them at a start.
    units.sort_by(|a, b| a.port.cmp(&b.port));
    for unit in units {
        for node in nodes_of(unit) {
            assigner.attach(&node);
        }
    }
    let meant = |entry: &'a DeviceSpec| {
        let attached = assigner.attached_as(entry.id)?;
        Some((entry, usb.iter().find(|unit| unit.port == attached.unit.place())?))
    };
    registry.devices.iter().filter_map(meant).collect()
}

/// A node of each kind: whether the device has it is another question.
fn nodes_of(unit: &UsbDevice) -> [Attachment; 4] {
    let usb = UsbIdentity {
        vid: unit.vid,
        pid: unit.pid,
        serial: unit.serial.clone(),
        port: unit.port.clone(),
        ..UsbIdentity::default()
    };
    let folder = PathBuf::from("/usb").join(&unit.port);
    let node = |kind: &str, node: fn(PathBuf) -> DeviceNode| {
        let syspath = folder.join(kind);
        Attachment { node: node(syspath.clone()), syspath, unit: usb.clone().into(), driver: None }
    };
    [
        node("video", DeviceNode::Video),
        node("tty", DeviceNode::Tty),
        node("usb", DeviceNode::Usb),
        node("net", |path| DeviceNode::Net(path.display().to_string())),
    ]
}

/// The subsystem of the node that an entry opens, and its group.
fn subsystem(entry: &DeviceSpec) -> Option<(&'static str, &'static str)> {
    match entry.node.opens() {
        Opens::Video => Some(("video4linux", "video")),
        Opens::Tty => Some(("tty", "dialout")),
        Opens::Usb => Some(("usb", "plugdev")),
        Opens::Net => None,
    }
}

/// A rate, for people.
pub(super) fn megabytes(bytes: f64) -> String {
    format!("{:.1} MB/s", bytes / 1e6)
}

/// Which cameras share a bus, and whether they fit.
fn buses(facts: &Facts, plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let mut found = Vec::new();
    let roots = facts.usb.iter().filter(|device| device.is_root());
    for root in roots {
        // What runs slower has a finding of its own, and takes next to nothing behind its hub.
        let of_the_bus = |device: &UsbDevice| device.bus == root.bus && device.mbit >= SLOWEST;
        let wishes: Vec<Wish> = plugged
            .iter()
            .filter(|(_, device)| of_the_bus(device))
            .filter_map(|(entry, _)| {
                let NodeSpec::Camera(camera) = &entry.node else { return None };
                Some(Wish { name: entry.name.clone(), camera: camera.clone(), max_bytes: entry.max_bytes })
            })
            .collect();
        if !wishes.is_empty() {
            found.push(bus(root.bus, root.mbit, &wishes));
        }
    }
    found
}

fn bus(bus: u32, mbit: f64, wishes: &[Wish]) -> Finding {
    let names = wishes.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let estimated = wishes.iter().any(Wish::is_estimated);
    let most = if estimated { "at most (estimated: the largest pictures that MJPG may give) " } else { "" };
    let (taken, budget) = (bandwidth::taken(wishes, mbit), bandwidth::budget(mbit));
    let what = format!("bus {bus} carries {names}: {most}{} of {}", megabytes(taken), megabytes(budget));
    let lower = bandwidth::fitting(wishes, mbit);
    let fix = match &lower {
        Some(lower) if lower.is_empty() => return Finding::ok("bandwidth", what),
        Some(lower) => {
            let lower = lower.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            format!("this would fit: {lower}; or plug one of them into a port of another bus")
        }
        None => "plug one of them into a port of another bus".to_owned(),
    };
    // What is only estimated may fit all the same.
    if estimated { Finding::warn("bandwidth", what, fix) } else { Finding::bad("bandwidth", what, fix) }
}

/// Cameras that run slower than cameras do.
fn speeds(plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let slow =
        plugged.iter().filter(|(entry, device)| matches!(entry.node, NodeSpec::Camera(_)) && device.mbit < SLOWEST);
    let say = |(entry, device): &(&DeviceSpec, &UsbDevice)| {
        let what = format!("[device.{}] runs at {} Mbit/s, too slow for pictures", entry.name, device.mbit);
        Finding::bad("speed", what, format!("another cable, port or hub: it is at port {}", device.port))
    };
    slow.map(say).collect()
}

/// Units that say the same serial number cannot be told apart by it.
fn serials(usb: &[UsbDevice], entries: &[DeviceSpec]) -> Vec<Finding> {
    let mut found = Vec::new();
    for (at, device) in usb.iter().enumerate().filter(|(_, device)| !device.is_hub) {
        let Some(serial) = &device.serial else { continue };
        let same = |other: &&UsbDevice| {
            (other.vid, other.pid) == (device.vid, device.pid) && other.serial.as_ref() == Some(serial)
        };
        if usb.iter().take(at).any(|other| same(&other)) {
            continue;
        }
        let ports: Vec<&str> = usb.iter().filter(same).map(|device| device.port.as_str()).collect();
        if ports.len() < 2 {
            continue;
        }
        let what = format!(
            "{} units of {:04x}:{:04x} say the serial number {serial:?}, at ports {}",
            ports.len(),
            device.vid,
            device.pid,
            ports.join(", ")
        );
        let meant = entries.iter().find(|entry| {
            let usb = entry.identity.usb();
            usb.is_some_and(|usb| (usb.vid, usb.pid) == (device.vid, device.pid) && usb.serial.as_ref() == Some(serial))
        });
        found.push(match meant {
            Some(entry) => {
                let fix =
                    format!("in [device.{}] write port = {:?} instead of the serial number", entry.name, device.port);
                Finding::bad("serials", what, fix)
            }
            None => Finding::warn("serials", what, "identify them by their ports: rapid register --port"),
        });
    }
    found
}

/// Can the nodes of the entries that are plugged in be opened?
fn nodes(facts: &Facts, entries: &[DeviceSpec], plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let mut found = Vec::new();
    let mut open = 0;
    for (entry, device) in plugged {
        let Some((subsystem, group)) = subsystem(entry).filter(|(subsystem, _)| *subsystem != "usb") else { continue };
        let own: Vec<&Node> =
            facts.nodes.iter().filter(|node| node.port == device.port && node.subsystem == subsystem).collect();
        if own.is_empty() {
            let what =
                format!("[device.{}] is plugged in at port {} and has no {subsystem} node", entry.name, device.port);
            found.push(Finding::bad("nodes", what, "see `journalctl -k -b | tail -50` for the kernel's reason"));
        }
        for node in own {
            if node.is_open_to_us {
                open += 1;
                continue;
            }
            let what = format!(
                "{} of [device.{}] may not be opened: group {}, mode {:03o}",
                node.path.display(),
                entry.name,
                node.group,
                node.mode
            );
            let fix = format!("sudo usermod -aG {group} $USER, and log in again; or sudo rapid artifacts --install");
            found.push(Finding::bad("nodes", what, fix));
        }
    }
    if open > 0 {
        found.push(Finding::ok("nodes", format!("{open} nodes of registered devices may be opened")));
    }
    let missing = entries.iter().filter(|entry| !plugged.iter().any(|(other, _)| other.name == entry.name));
    let missing: Vec<String> = missing
        .filter(|entry| entry.identity.usb().is_some())
        .map(|entry| format!("[device.{}]", entry.name))
        .collect();
    if !missing.is_empty() {
        found.push(Finding::ok("nodes", format!("not plugged in: {}", missing.join(", "))));
    }
    if facts.user.is_root {
        return found;
    }
    let mut wanted: Vec<&str> = entries.iter().filter_map(|entry| Some(subsystem(entry)?.1)).collect();
    wanted.sort_unstable();
    wanted.dedup();
    let lacking: Vec<&str> =
        wanted.into_iter().filter(|group| !facts.user.groups.iter().any(|own| own == group)).collect();
    if !lacking.is_empty() {
        let what = format!(
            "this user is not in the group {}: only who sits at the machine may open the devices",
            lacking.join(", ")
        );
        found.push(Finding::warn(
            "groups",
            what,
            format!("sudo usermod -aG {} $USER, and log in again", lacking.join(",")),
        ));
    }
    found
}

fn suspending(plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let mut seen = Vec::new();
    let mut found = Vec::new();
    for (entry, device) in plugged.iter().filter(|(_, device)| device.autosuspends) {
        if seen.contains(&&device.port) {
            continue;
        }
        seen.push(&device.port);
        let what =
            format!("[device.{}] may be suspended by the kernel while nobody reads it, and wakes late", entry.name);
        let fix = format!("echo on | sudo tee /sys/bus/usb/devices/{}/power/control", device.port);
        found.push(Finding::warn("suspend", what, fix));
    }
    found
}
