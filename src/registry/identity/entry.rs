//! An entry as the assignment sees it: which node of which unit it takes.

use crate::modality::ModalityId;
use crate::registry::attachment::{DeviceNode, Unit};
use crate::registry::scenario::{SimSource, TaskPart};
use crate::registry::spec::{CanAdapter, DeviceSpec, IdentitySpec, NodeSpec, Opens};

#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub(super) id: ModalityId,
    pub(super) name: String,
    pub(super) identity: IdentitySpec,
    pub(super) kind: Kind,
    /// A program reads it.
    is_process: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Camera,
    Serial,
    Usb,
    Net,
    Lan,
}

/// The rule of the module above by which a unit fits an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Rule {
    Serial,
    Port,
    Lan,
    Model,
}

impl Entry {
    pub(super) fn new(device: &DeviceSpec) -> Self {
        let (kind, is_process) = match &device.node {
            NodeSpec::Camera(_) => (Kind::Camera, false),
            NodeSpec::Serial(_) => (Kind::Serial, false),
            NodeSpec::Process(process) => match process.opens {
                Opens::Video => (Kind::Camera, true),
                Opens::Tty => (Kind::Serial, true),
                Opens::Usb => (Kind::Usb, true),
                Opens::Net => (Kind::Net, true),
            },
            NodeSpec::Can(can) if can.adapter != CanAdapter::SocketCan => (Kind::Serial, false),
            NodeSpec::Lan(_) if device.identity.usb().is_none() => (Kind::Lan, false),
            NodeSpec::Can(_) | NodeSpec::Lan(_) => (Kind::Net, false),
        };
        Self { id: device.id, name: device.name.clone(), identity: device.identity.clone(), kind, is_process }
    }

    /// Of the model of this unit?
    pub(super) fn is_model(&self, unit: &Unit) -> bool {
        let (Some(wished), Some(usb)) = (self.identity.usb(), unit.usb()) else { return false };
        (wished.vid, wished.pid) == (usb.vid, usb.pid)
    }

    pub(super) fn reads(&self, node: &DeviceNode) -> bool {
        match node {
            DeviceNode::Video(_) => self.kind == Kind::Camera,
            DeviceNode::Tty(_) => self.kind == Kind::Serial,
            DeviceNode::Usb(_) => self.kind == Kind::Usb,
            DeviceNode::Net(_) => self.kind == Kind::Net,
            DeviceNode::Lan { .. } => self.kind == Kind::Lan,
            DeviceNode::Sim(device) => match device.source {
                // What stands for a device that has neither a picture's node nor a line sends as if it had.
                SimSource::Camera { .. } | SimSource::Serial { .. } if matches!(self.kind, Kind::Net | Kind::Lan) => {
                    !self.is_process
                }
                SimSource::Camera { .. } | SimSource::Task { part: TaskPart::Wrist | TaskPart::Tactile, .. } => {
                    self.kind == Kind::Camera && !self.is_process
                }
                SimSource::Serial { .. } | SimSource::Task { part: TaskPart::Arm, .. } => {
                    self.kind == Kind::Serial && !self.is_process
                }
                SimSource::Process => self.is_process,
                // A recorded topic stands for whatever recorded it.
                SimSource::Replay { .. } => true,
            },
        }
    }
}

impl Kind {
    pub(super) const fn label(self) -> &'static str {
        match self {
            Self::Camera => "camera",
            Self::Serial => "serial line",
            Self::Usb => "USB device",
            Self::Net => "network interface",
            Self::Lan => "network address",
        }
    }
}

pub(super) fn rule(entry: &Entry, unit: &Unit) -> Option<Rule> {
    let (wished, usb) = match (&entry.identity, unit) {
        (IdentitySpec::Usb(wished), Unit::Usb(usb)) => (wished, usb),
        (IdentitySpec::Lan {}, Unit::Lan(lan)) => return (lan.entry == entry.name).then_some(Rule::Lan),
        _ => return None,
    };
    if (wished.vid, wished.pid) != (usb.vid, usb.pid) {
        return None;
    }
    match (&wished.serial, &wished.port) {
        (Some(serial), _) => (usb.serial.as_ref() == Some(serial)).then_some(Rule::Serial),
        (None, Some(port)) => (usb.port == *port).then_some(Rule::Port),
        (None, None) => Some(Rule::Model),
    }
}
