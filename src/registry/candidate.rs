//! Connected units without an entry.
//!
//! Pure, except for reads of sysfs that distinguish hubs from devices and CAN adapters from network cards.

use super::identity::{Assigner, Assignment};
use super::parse::like_a_name;
use super::spec::Registry;
use crate::device::{Attachment, DeviceNode, UsbIdentity};
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
            SimSource::Camera { .. }
            | SimSource::Depth { .. }
            | SimSource::Task { part: TaskPart::Wrist | TaskPart::Tactile, .. } => Some("camera"),
            SimSource::Serial { .. }
            | SimSource::Task { part: TaskPart::Arm | TaskPart::Phone | TaskPart::Gripper, .. } => Some("serial"),
            SimSource::Process | SimSource::Replay { .. } => None,
        },
    }
}

impl Candidate {
    /// The unit in one line: model, port, serial number, product; no two connected units have the same. Contains
    /// what the unit reports, unchanged.
    pub fn describe(&self) -> String {
        let usb = &self.usb;
        let serial = usb.serial.as_ref().map_or("no serial".to_owned(), |serial| format!("serial {serial:?}"));
        let product = usb.product.as_deref().unwrap_or("(no product name)");
        format!("{:04x}:{:04x}  port {}  {serial}  {product}", usb.vid, usb.pid, usb.port)
    }

    /// A name for it that no entry has, derived from its product, if that contains one.
    pub fn suggested_name(&self, registry: Option<&Registry>) -> Option<String> {
        let name = self.usb.product.as_deref().and_then(like_a_name)?.trim_end_matches('_').to_owned();
        let is_taken = registry.is_some_and(|registry| registry.named(&name).is_some());
        (!is_taken && name.len() <= 24).then_some(name)
    }

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

#[cfg(test)]
mod tests;
