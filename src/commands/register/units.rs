//! Connected units without an entry, and suggested settings for them.
//!
//! Pure, except for reads of sysfs that distinguish hubs from devices and CAN adapters from network cards.

use crate::device::{Attachment, DeviceNode, UsbIdentity};
use crate::driver::camera::{CameraInfo, Rate, Rates, Size};
use crate::registry::edit::Setting;
use crate::registry::{Assigner, Assignment, PixelFormat, Registry};
use crate::simulation::{SimSource, TaskPart};

/// A USB device and its nodes that no entry reads.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Its identity, as reported by the device.
    pub usb: UsbIdentity,
    /// Its nodes, those with data first, then the USB device itself.
    pub nodes: Vec<Attachment>,
    /// Another unit of this model is plugged in or registered.
    pub has_twin: bool,
    /// Its serial number, if it is unique among connected units and printable.
    pub own_serial: Option<String>,
}

/// Units that could be registered, in the order of their ports; those with data nodes first.
pub fn unregistered(registry: Option<&Registry>, attached: &[Attachment]) -> Vec<Candidate> {
    let mut assigner = registry.map(Assigner::new);
    let taken: Vec<bool> = attached
        .iter()
        .map(|node| assigner.as_mut().is_some_and(|assigner| matches!(assigner.attach(node), Assignment::Entry(_))))
        .collect();
    let mut units: Vec<Candidate> = Vec::new();
    for (at, node) in attached.iter().enumerate() {
        // On the network, only devices of entries are searched for.
        let Some(usb) = node.unit.usb() else { continue };
        let same = |other: &Attachment| other.unit.usb().is_some_and(|other| same_unit(other, usb));
        // An entry reads one node of a kind: a second camera node of the same unit is ignored.
        let is_read = attached
            .iter()
            .zip(&taken)
            .any(|(other, taken)| *taken && same(other) && (is_usb(&node.node) || kind(other) == kind(node)));
        if is_read || taken.get(at) == Some(&true) || is_hub(node) {
            continue;
        }
        match units.iter_mut().find(|unit| same_unit(&unit.usb, usb)) {
            Some(unit) => unit.nodes.push(node.clone()),
            None => units.push(candidate(node, usb, registry, attached)),
        }
    }
    for unit in &mut units {
        unit.nodes.sort_by_key(|node| is_usb(&node.node));
    }
    units.sort_by_key(|unit| unit.nodes.iter().all(|node| is_usb(&node.node)));
    units
}

fn candidate(node: &Attachment, usb: &UsbIdentity, registry: Option<&Registry>, attached: &[Attachment]) -> Candidate {
    let model = (usb.vid, usb.pid);
    let others = || attached.iter().filter_map(|other| other.unit.usb()).filter(|other| !same_unit(other, usb));
    let entries = registry.map(|registry| registry.devices.as_slice()).unwrap_or_default();
    let shared = others().any(|other| (other.vid, other.pid) == model && other.serial == usb.serial);
    let legal = |serial: &&String| !serial.is_empty() && !serial.chars().any(char::is_control);
    Candidate {
        usb: usb.clone(),
        nodes: vec![node.clone()],
        has_twin: others().any(|other| (other.vid, other.pid) == model)
            || entries.iter().filter_map(|entry| entry.identity.usb()).any(|usb| (usb.vid, usb.pid) == model),
        own_serial: usb.serial.as_ref().filter(|_| !shared).filter(legal).cloned(),
    }
}

fn same_unit(a: &UsbIdentity, b: &UsbIdentity) -> bool {
    (a.vid, a.pid, &a.port, &a.serial) == (b.vid, b.pid, &b.port, &b.serial)
}

fn is_usb(node: &DeviceNode) -> bool {
    matches!(node, DeviceNode::Usb(_))
}

/// Hubs are USB devices too, but no sensors (USB 2.0, table 11-15: class 9).
fn is_hub(node: &Attachment) -> bool {
    is_usb(&node.node)
        && std::fs::read_to_string(node.syspath.join("bDeviceClass")).is_ok_and(|class| class.trim() == "09")
}

/// The value of `node` in an entry that reads this node; `None` if only a program can.
pub fn kind(attachment: &Attachment) -> Option<&'static str> {
    /// `ARPHRD_CAN` of `linux/if_arp.h`.
    const CAN: &str = "280";
    match &attachment.node {
        DeviceNode::Video(_) => Some("camera"),
        DeviceNode::Tty(_) => Some("serial"),
        DeviceNode::Net(_) => {
            let is_can = std::fs::read_to_string(attachment.syspath.join("type")).is_ok_and(|kind| kind.trim() == CAN);
            Some(if is_can { "can" } else { "lan" })
        }
        DeviceNode::Usb(_) | DeviceNode::Lan { .. } => None,
        DeviceNode::Sim(device) => match device.source {
            SimSource::Camera { .. } | SimSource::Task { part: TaskPart::Wrist | TaskPart::Tactile, .. } => {
                Some("camera")
            }
            SimSource::Serial { .. } | SimSource::Task { part: TaskPart::Arm, .. } => Some("serial"),
            SimSource::Process | SimSource::Replay { .. } => None,
        },
    }
}

impl Candidate {
    /// The word for `node` that its nodes suggest.
    pub fn guess(&self) -> Option<&'static str> {
        self.nodes.iter().find_map(|node| kind(node))
    }

    /// The node that an entry of this kind would read.
    pub fn node(&self, word: &str) -> Option<&Attachment> {
        self.nodes.iter().find(|node| kind(node) == Some(word))
    }

    /// The key and value by which an entry matches this unit and no other, if there are any.
    pub fn identity(&self) -> Option<(&'static str, String)> {
        match &self.own_serial {
            Some(serial) => Some(("serial", serial.clone())),
            None => self.has_twin.then(|| ("port", self.usb.port.clone())),
        }
    }
}

/// Settings that the device itself suggests.
pub fn suggested(node: &DeviceNode, camera: Option<&CameraInfo>) -> Vec<(String, Setting)> {
    match (node, camera) {
        (DeviceNode::Sim(device), _) => match device.source {
            SimSource::Camera { width, height, fps, .. } => camera_settings(width, height, fps, "MJPG"),
            SimSource::Serial { channels, .. } => serial_settings("csv", channels),
            _ => Vec::new(),
        },
        (DeviceNode::Video(_), Some(camera)) => best(camera)
            .map_or_else(Vec::new, |(width, height, fps, format)| camera_settings(width, height, fps, format)),
        _ => Vec::new(),
    }
}

fn camera_settings(width: u32, height: u32, fps: u32, format: &str) -> Vec<(String, Setting)> {
    let whole = |key: &str, value: u32| (format!("camera.{key}"), Setting::Whole(value.into()));
    vec![
        whole("width", width),
        whole("height", height),
        whole("fps", fps),
        ("camera.format".to_owned(), Setting::Text(format.to_owned())),
    ]
}

fn serial_settings(parse: &str, channels: usize) -> Vec<(String, Setting)> {
    let channels = i64::try_from(channels).unwrap_or(i64::MAX);
    vec![
        ("tty.parse".to_owned(), Setting::Text(parse.to_owned())),
        ("tty.channels".to_owned(), Setting::Whole(channels)),
    ]
}

/// A mode that suits most rigs: compressed pictures if possible, a size near 640x480, a rate near 30 Hz.
fn best(camera: &CameraInfo) -> Option<(u32, u32, u32, &'static str)> {
    let order = |fourcc: &str| PixelFormat::WORDS.iter().position(|(word, _)| *word == fourcc);
    let size = |size: &Size| match *size {
        Size::One { width, height } => (width, height),
        Size::Range { smallest, largest } => {
            (640.clamp(smallest.0, largest.0.max(smallest.0)), 480.clamp(smallest.1, largest.1.max(smallest.1)))
        }
    };
    let modes = camera.modes.iter().filter_map(|mode| Some((order(&mode.fourcc)?, size(&mode.size), &mode.rates)));
    let far = |(width, height): (u32, u32)| (u64::from(width) * u64::from(height)).abs_diff(640 * 480);
    let (format, (width, height), rates) = modes.min_by_key(|(order, size, _)| (*order, far(*size)))?;
    Some((width, height, fps(rates), PixelFormat::WORDS.get(format)?.0))
}

/// The integer rate nearest to 30 Hz.
fn fps(rates: &Rates) -> u32 {
    const PREFERRED: u32 = 30;
    let near =
        |rate: &Rate| (1..=1000).min_by_key(|fps| (f64::from(*fps) - rate.hz()).abs().to_bits()).unwrap_or(PREFERRED);
    match rates {
        Rates::List(rates) => rates.iter().map(near).min_by_key(|fps| fps.abs_diff(PREFERRED)).unwrap_or(PREFERRED),
        Rates::Range { slowest, fastest } => PREFERRED.clamp(near(slowest), near(fastest).max(near(slowest))),
    }
}

/// Settings to parse the lines of a serial device: all comma-separated numbers, or all JSON; `None` if
/// neither.
pub fn lines_look_like(lines: &[Vec<u8>]) -> Option<Vec<(String, Setting)>> {
    // The start of the first line may be missing.
    let whole: Vec<&str> = lines.iter().skip(1).filter_map(|line| std::str::from_utf8(line).ok()).collect();
    let first = whole.first()?;
    let same = |count: &dyn Fn(&str) -> Option<usize>| {
        let channels = count(first)?;
        whole.iter().all(|line| count(line) == Some(channels)).then_some(channels)
    };
    let csv = |line: &str| {
        let numbers: Result<Vec<f64>, _> = line.split(',').map(|part| part.trim().parse::<f64>()).collect();
        numbers.ok().map(|numbers| numbers.len())
    };
    let json = |line: &str| match serde_json::from_str::<serde_json::Value>(line).ok()? {
        serde_json::Value::Array(values) => Some(values.len()),
        serde_json::Value::Object(values) => Some(values.values().filter(|value| value.is_number()).count()),
        _ => None,
    };
    let channels = |found: Option<usize>| found.filter(|channels| (1..=1024).contains(channels));
    if let Some(channels) = channels(same(&csv)) {
        return Some(serial_settings("csv", channels));
    }
    channels(same(&json)).map(|channels| serial_settings("json", channels))
}

#[cfg(test)]
mod tests;
