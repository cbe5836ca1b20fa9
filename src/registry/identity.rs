//! Matching attached devices to the entries of the registry.
//!
//! Pure: from attached and detached devices to the modality that begins or ends.
//!
//! 1. A unit with the vid, pid and serial number of an entry belongs to that entry alone.
//! 2. Otherwise a unit at the port of an entry that has a port and no serial number belongs to it.
//! 3. A device on the network belongs to the entry that it was found for.
//! 4. Otherwise it is one of the interchangeable units of the entries with neither: it takes the
//!    entry it had last, if that is free (recognised by its serial number if it has one, otherwise
//!    by its port), or the free entry with the lowest bit, and keeps it while plugged.
//!
//! A camera may have several entries with its identity, one for each of its streams: each takes the capture node that offers
//! its pixel format.
//!
//! A unit whose entry is taken waits: a device may appear in its new port before it disappears from its
//! old one. It begins when the entry is freed.
//!
//! Invariant: an entry has at most one node, a node at most one entry.
//! Invariant: two units are never assigned to one entry, and one unit (one port) never takes two entries of one kind,
//! but for those of the streams of a camera.

use std::collections::VecDeque;
use std::path::Path;

use rapid_core::modality::ModalityId;

use super::spec::{DeviceSpec, IdentitySpec, NodeSpec, Opens, PixelFormat, Registry};
use crate::device::{Attachment, DeviceNode, Unit, UsbIdentity};
use crate::simulation::{SimSource, TaskPart};

/// The result of matching an attached node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Assignment {
    /// It is this entry.
    Entry(ModalityId),
    /// It fits an entry that is taken, and is assigned to it when that is freed.
    Waiting {
        /// As text for the user.
        reason: String,
    },
    /// No entry matches this device.
    Unregistered {
        /// As text for the user: what the nearest entries require.
        reason: String,
    },
    /// Its device is registered, but this node is not the one the entry reads.
    WrongNode {
        /// As text for the user.
        reason: String,
    },
}

/// What a removal changes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Detached {
    /// Modalities whose node is gone, ascending by bit.
    pub freed: Vec<ModalityId>,
    /// Nodes that waited and are now assigned, perhaps to an entry just freed.
    pub assigned: Vec<(ModalityId, Attachment)>,
}

/// How a node would be matched, for `rapid devices`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Explanation {
    /// The entries it fits, best rule first.
    pub fits: Vec<ModalityId>,
    /// Which entry and why, or what the nearest entries require; one line each.
    pub reasons: Vec<String>,
}

/// Matches attached nodes to the entries of a registry.
#[derive(Debug, Clone)]
pub struct Assigner {
    /// Ascending by bit.
    entries: Vec<Entry>,
    /// In the order they were attached.
    attached: Vec<Node>,
    /// The last entry of each interchangeable unit, oldest first.
    remembered: VecDeque<(UsbIdentity, ModalityId)>,
}

#[derive(Debug, Clone)]
struct Node {
    attachment: Attachment,
    assigned: Option<ModalityId>,
}

/// A rig never has more units of one kind than this; a device that invents serial numbers may.
const MOST_REMEMBERED: usize = 256;

impl Assigner {
    /// Without attached nodes.
    pub fn new(registry: &Registry) -> Self {
        let entry = |device| Entry { is_stream: registry.shares_unit(device), ..Entry::new(device) };
        let mut entries: Vec<_> = registry.devices.iter().map(entry).collect();
        entries.sort_by_key(|entry| entry.id);
        Self { entries, attached: Vec::new(), remembered: VecDeque::new() }
    }

    /// Whether another device is known at this node's path. Then its removal was missed: detach that path first,
    /// to find out which modality ends.
    pub fn replaces(&self, attachment: &Attachment) -> bool {
        self.attached
            .iter()
            .any(|node| node.attachment.syspath == attachment.syspath && node.attachment.unit != attachment.unit)
    }

    /// A node was attached. The same node reported twice gives the same result.
    pub fn attach(&mut self, attachment: &Attachment) -> Assignment {
        let known = self.attached.iter().position(|node| node.attachment.syspath == attachment.syspath);
        if let Some(node) = known.and_then(|index| self.attached.get_mut(index)) {
            if node.attachment.unit == attachment.unit
                && let Some(id) = node.assigned
            {
                node.attachment = attachment.clone();
                return Assignment::Entry(id);
            }
            let syspath = &attachment.syspath;
            self.attached.retain(|node| node.attachment.syspath != *syspath);
        }
        let assignment = self.choose(attachment);
        let assigned = match &assignment {
            Assignment::Entry(id) => Some(*id),
            // Kept: it may be assigned when an entry is freed or added.
            Assignment::Waiting { .. } | Assignment::WrongNode { .. } | Assignment::Unregistered { .. } => None,
        };
        self.place(Node { attachment: attachment.clone(), assigned });
        assignment
    }

    /// Everything at or below `syspath` is gone.
    pub fn detach(&mut self, syspath: &Path) -> Detached {
        let mut detached = Detached::default();
        self.attached.retain(|node| {
            let gone = node.attachment.is_under(syspath);
            if gone {
                detached.freed.extend(node.assigned);
            }
            !gone
        });
        detached.freed.sort_unstable();
        detached.assigned = self.promote();
        detached
    }

    /// An entry is added, whose name and bit no other has. Returns the attached nodes that are assigned to it.
    pub fn add(&mut self, device: &DeviceSpec) -> Vec<(ModalityId, Attachment)> {
        let at = self.entries.partition_point(|entry| entry.id < device.id);
        self.entries.insert(at, Entry::new(device));
        self.promote()
    }

    /// Every attached node, in the order in which they were attached.
    pub fn nodes(&self) -> impl Iterator<Item = &Attachment> {
        self.attached.iter().map(|node| &node.attachment)
    }

    /// The node that is assigned to entry `id` now.
    pub fn attached_as(&self, id: ModalityId) -> Option<&Attachment> {
        self.attached.iter().find(|node| node.assigned == Some(id)).map(|node| &node.attachment)
    }

    /// How a node would be matched if every entry were free.
    pub fn explain(&self, attachment: &Attachment) -> Explanation {
        let fitting = self.fitting(attachment);
        if fitting.is_empty() {
            return Explanation { fits: Vec::new(), reasons: self.near_misses(attachment) };
        }
        let reasons = fitting.iter().map(|(rule, entry)| match rule {
            Rule::Serial => format!("vid:pid and serial number are those of [device.{}]", entry.name),
            Rule::Port => format!("vid:pid and port are those of [device.{}]", entry.name),
            Rule::Lan => format!("it was found for [device.{}]", entry.name),
            Rule::Model => format!("vid:pid are those of [device.{}], which takes any such unit", entry.name),
        });
        Explanation { reasons: reasons.collect(), fits: fitting.iter().map(|(_, entry)| entry.id).collect() }
    }

    fn choose(&self, attachment: &Attachment) -> Assignment {
        let fitting = self.fitting(attachment);
        let Some((rule, best)) = fitting.first() else { return self.refuse(attachment) };
        if !best.is_stream
            && let Some(other) = self.other_node(attachment)
        {
            let name =
                self.entries.iter().find(|entry| Some(entry.id) == other.assigned).map_or("", |entry| &entry.name);
            let reason = format!("[device.{name}] already reads another node of this device");
            return Assignment::WrongNode { reason };
        }
        let free = |id: ModalityId| self.attached_as(id).is_none();
        let chosen = match rule {
            Rule::Serial | Rule::Port | Rule::Lan => fitting.iter().map(|(_, entry)| entry.id).find(|id| free(*id)),
            Rule::Model => {
                let mut pool = fitting.iter().map(|(_, entry)| entry.id).filter(|id| free(*id));
                let last = attachment
                    .unit
                    .usb()
                    .map(|usb| self.recall(usb))
                    .unwrap_or_default()
                    .into_iter()
                    .find(|id| pool.clone().any(|free| free == *id));
                last.or_else(|| pool.next())
            }
        };
        match chosen {
            Some(id) => Assignment::Entry(id),
            None if *rule == Rule::Model => {
                let names: Vec<_> = fitting.iter().map(|(_, entry)| entry.name.as_str()).collect();
                Assignment::Waiting { reason: format!("every entry of this model is taken ({})", names.join(", ")) }
            }
            None => {
                let port = self.attached_as(best.id).map(|node| format!("{:?}", node.unit.place())).unwrap_or_default();
                Assignment::Waiting { reason: format!("[device.{}] is taken by a unit at port {port}", best.name) }
            }
        }
    }

    /// The entries that a node fits by the best applicable rule, ascending by bit.
    fn fitting(&self, attachment: &Attachment) -> Vec<(Rule, &Entry)> {
        let fits: Vec<_> = self
            .entries
            .iter()
            .filter(|entry| entry.reads(&attachment.node) && entry.shows(attachment))
            .filter_map(|entry| Some((rule(entry, &attachment.unit)?, entry)))
            .collect();
        let best = fits.iter().map(|(rule, _)| *rule).min();
        fits.into_iter().filter(|(rule, _)| Some(*rule) == best).collect()
    }

    /// Another node of the same unit that is already assigned to an entry this one fits: a camera may have
    /// several capture nodes.
    fn other_node(&self, attachment: &Attachment) -> Option<&Node> {
        let usb = attachment.unit.usb()?;
        self.attached.iter().find(|node| {
            let Some(other) = node.attachment.unit.usb() else { return false };
            let same_unit = (other.vid, other.pid, &other.port) == (usb.vid, usb.pid, &usb.port);
            let entry = self.entries.iter().find(|entry| Some(entry.id) == node.assigned);
            same_unit && other.serial == usb.serial && entry.is_some_and(|entry| entry.reads(&attachment.node))
        })
    }

    fn refuse(&self, attachment: &Attachment) -> Assignment {
        let entry = self.entries.iter().find(|entry| rule(entry, &attachment.unit).is_some());
        // Hubs and keyboards are USB devices too: only one that nearly matches an entry is reported.
        let nearly = |entry: &Entry| entry.opens == Some(Opens::Usb) && entry.is_model(&attachment.unit);
        if entry.is_none() && matches!(attachment.node, DeviceNode::Usb(_)) && !self.entries.iter().any(nearly) {
            return Assignment::WrongNode { reason: format!("no entry reads {}", attachment.node.label()) };
        }
        if let Some(entry) = entry {
            let label = attachment.node.label();
            let reason = format!("[device.{}] reads its {}, not {label}", entry.name, entry.label());
            return Assignment::WrongNode { reason };
        }
        Assignment::Unregistered { reason: self.near_misses(attachment).join("; ") }
    }

    fn near_misses(&self, attachment: &Attachment) -> Vec<String> {
        let Unit::Usb(usb) = &attachment.unit else { return vec!["no entry matches it".to_owned()] };
        let mut reasons: Vec<String> = self
            .entries
            .iter()
            .filter(|entry| entry.is_model(&attachment.unit))
            .filter_map(|entry| Some((entry, entry.identity.usb()?)))
            .map(|(entry, expected)| {
                let name = &entry.name;
                match (&expected.serial, &expected.port) {
                    (Some(serial), _) if usb.serial.as_deref() != Some(serial) => {
                        let reported =
                            usb.serial.as_ref().map_or("has none".to_owned(), |own| format!("reports {own:?}"));
                        format!("vid:pid match [device.{name}], but its serial is {serial:?} and this unit {reported}")
                    }
                    (None, Some(port)) if *port != usb.port => {
                        format!(
                            "vid:pid match [device.{name}], but its port is {port} and this unit is at {:?}",
                            usb.port
                        )
                    }
                    _ => format!("it is [device.{name}], which reads its {}", entry.label()),
                }
            })
            .collect();
        if reasons.is_empty() {
            reasons.push(format!("no entry has vid:pid {:04x}:{:04x}", usb.vid, usb.pid));
        }
        reasons
    }

    /// Entries this unit had before, the best guess first.
    fn recall(&self, usb: &UsbIdentity) -> Vec<ModalityId> {
        let newest = |same: &dyn Fn(&UsbIdentity) -> bool| -> Vec<ModalityId> {
            let model = |past: &UsbIdentity| (past.vid, past.pid) == (usb.vid, usb.pid);
            let found = self.remembered.iter().rev().filter(|(past, _)| model(past) && same(past));
            found.map(|(_, id)| *id).collect()
        };
        // Cheap devices share one serial number: the port distinguishes identical units.
        let mut ids = newest(&|past| past.serial == usb.serial && past.port == usb.port);
        if usb.serial.is_some() {
            ids.extend(newest(&|past| past.serial == usb.serial));
        }
        ids
    }

    fn place(&mut self, node: Node) {
        if let (Some(id), Some(usb)) = (node.assigned, node.attachment.unit.usb().cloned()) {
            self.remembered.retain(|(past, _)| {
                (past.vid, past.pid, &past.serial, &past.port) != (usb.vid, usb.pid, &usb.serial, &usb.port)
            });
            self.remembered.push_back((usb, id));
            if self.remembered.len() > MOST_REMEMBERED {
                self.remembered.pop_front();
            }
        }
        self.attached.push(node);
    }

    /// Assigns free entries to the nodes that wait, in the order of their arrival.
    fn promote(&mut self) -> Vec<(ModalityId, Attachment)> {
        let mut begun = Vec::new();
        let waiting: Vec<Attachment> =
            self.attached.iter().filter(|node| node.assigned.is_none()).map(|node| node.attachment.clone()).collect();
        for attachment in waiting {
            let Assignment::Entry(id) = self.choose(&attachment) else { continue };
            self.attached.retain(|node| node.attachment.syspath != attachment.syspath);
            self.place(Node { attachment: attachment.clone(), assigned: Some(id) });
            begun.push((id, attachment));
        }
        begun
    }
}

#[derive(Debug, Clone)]
struct Entry {
    id: ModalityId,
    name: String,
    identity: IdentitySpec,
    /// The node of its device that it reads; `None` is an address on the network.
    opens: Option<Opens>,
    /// A program reads it.
    is_process: bool,
    /// The pixel format of a camera.
    format: Option<PixelFormat>,
    /// One of several streams of its unit.
    is_stream: bool,
}

/// The rule of the module's comment by which a unit fits an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Rule {
    Serial,
    Port,
    Lan,
    Model,
}

impl Entry {
    fn new(device: &DeviceSpec) -> Self {
        let opens = match &device.node {
            NodeSpec::Lan(_) if device.identity.usb().is_none() => None,
            node => Some(node.opens()),
        };
        let is_process = matches!(device.node, NodeSpec::Process(_));
        let format = match &device.node {
            NodeSpec::Camera(camera) => Some(camera.format),
            _ => None,
        };
        let (name, identity) = (device.name.clone(), device.identity.clone());
        Self { id: device.id, name, identity, opens, is_process, format, is_stream: false }
    }

    const fn label(&self) -> &'static str {
        match self.opens {
            Some(Opens::Video) => "camera",
            Some(Opens::Tty) => "serial line",
            Some(Opens::Usb) => "USB device",
            Some(Opens::Net) => "network interface",
            None => "network address",
        }
    }

    /// Whether the model matches this unit.
    fn is_model(&self, unit: &Unit) -> bool {
        let (Some(expected), Some(usb)) = (self.identity.usb(), unit.usb()) else { return false };
        (expected.vid, expected.pid) == (usb.vid, usb.pid)
    }

    /// Whether a node can be its stream, by the pixel formats that it offers. One that did not answer is of none: each would
    /// be as good as another.
    fn shows(&self, attachment: &Attachment) -> bool {
        let is_offered = |format: PixelFormat| attachment.formats.iter().any(|offered| offered == format.word());
        !self.is_stream || !matches!(attachment.node, DeviceNode::Video(_)) || self.format.is_none_or(is_offered)
    }

    fn reads(&self, node: &DeviceNode) -> bool {
        match node {
            DeviceNode::Video(_) => self.opens == Some(Opens::Video),
            DeviceNode::Tty(_) => self.opens == Some(Opens::Tty),
            DeviceNode::Usb(_) => self.opens == Some(Opens::Usb),
            DeviceNode::Net(_) => self.opens == Some(Opens::Net),
            DeviceNode::Lan { .. } => self.opens.is_none(),
            DeviceNode::Sim(device) => match device.source {
                // A simulated device without a picture node or a line sends as if it had one.
                SimSource::Camera { .. } | SimSource::Depth { .. } | SimSource::Serial { .. }
                    if matches!(self.opens, None | Some(Opens::Net)) =>
                {
                    !self.is_process
                }
                SimSource::Camera { .. } | SimSource::Task { part: TaskPart::Wrist | TaskPart::Tactile, .. } => {
                    self.opens == Some(Opens::Video) && !self.is_process && self.format != Some(PixelFormat::Z16)
                }
                SimSource::Depth { .. } => self.format == Some(PixelFormat::Z16),
                SimSource::Serial { .. }
                | SimSource::Task { part: TaskPart::Arm | TaskPart::Phone | TaskPart::Gripper, .. } => {
                    self.opens == Some(Opens::Tty) && !self.is_process
                }
                SimSource::Process => self.is_process,
                // A recorded topic is read in place of the device that was recorded.
                SimSource::Replay { .. } => true,
            },
        }
    }
}

fn rule(entry: &Entry, unit: &Unit) -> Option<Rule> {
    let (expected, usb) = match (&entry.identity, unit) {
        (IdentitySpec::Usb(expected), Unit::Usb(usb)) => (expected, usb),
        (IdentitySpec::Lan {}, Unit::Lan(lan)) => return (lan.entry == entry.name).then_some(Rule::Lan),
        _ => return None,
    };
    if (expected.vid, expected.pid) != (usb.vid, usb.pid) {
        return None;
    }
    match (&expected.serial, &expected.port) {
        (Some(serial), _) => (usb.serial.as_ref() == Some(serial)).then_some(Rule::Serial),
        (None, Some(port)) => (usb.port == *port).then_some(Rule::Port),
        (None, None) => Some(Rule::Model),
    }
}

#[cfg(test)]
mod tests;
