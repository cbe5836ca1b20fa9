//! A device that is physically there: what it says it is, and the node to open.
//!
//! Invariant: strings here come from the device and are not to be trusted.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Serialize;

use super::scenario::{SimDevice, SimSource};
use crate::provenance::KernelDriver;

/// What a USB device says it is, and where it is plugged in.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize)]
pub struct UsbIdentity {
    /// Vendor id.
    #[serde(serialize_with = "usb_id")]
    pub vid: u16,
    /// Product id.
    #[serde(serialize_with = "usb_id")]
    pub pid: u16,
    /// Serial number, if it has one.
    pub serial: Option<String>,
    /// Port path in the kernel's notation, for example `1-2.3`.
    pub port: String,
    /// Product string, if it has one.
    pub product: Option<String>,
    /// Manufacturer string, if it has one.
    pub manufacturer: Option<String>,
    /// Release of the device, by which makers number their firmware: `bcdDevice` as `4.18`
    /// (USB 2.0, table 9-8).
    pub firmware: Option<String>,
}

/// A vendor or product id as `devices.toml` and `lsusb` write it: `046d`.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature serde asks for")]
pub(super) fn usb_id<S: serde::Serializer>(id: &u16, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{id:04x}"))
}

/// A node that can be opened.
#[derive(Debug, Clone, PartialEq)]
pub enum DeviceNode {
    /// A V4L2 capture node, for example `/dev/video0`.
    Video(PathBuf),
    /// A serial line, for example `/dev/ttyACM0`.
    Tty(PathBuf),
    /// The USB device itself, for example `/dev/bus/usb/001/005`.
    Usb(PathBuf),
    /// A simulated device.
    Sim(Arc<SimDevice>),
}

/// One node of one attached device.
#[derive(Debug, Clone, PartialEq)]
pub struct Attachment {
    /// Path of the node in sysfs, unique among attached nodes; it lies below the path of its USB
    /// device, which is how a removal of either is recognised.
    pub syspath: PathBuf,
    /// The node.
    pub node: DeviceNode,
    /// The device it belongs to.
    pub usb: UsbIdentity,
    /// The kernel's driver of it.
    pub driver: Option<Box<KernelDriver>>,
}

impl Attachment {
    /// Does the removal of `syspath` (a node, its USB device, or a hub above) take this node away?
    #[must_use]
    pub fn is_under(&self, syspath: &Path) -> bool {
        self.syspath.starts_with(syspath)
    }
}

impl DeviceNode {
    /// Is it a topic of a recorded episode, which needs no program?
    #[must_use]
    pub fn is_recording(&self) -> bool {
        matches!(self, Self::Sim(device) if matches!(device.source, SimSource::Replay { .. }))
    }

    /// The node as shown to people.
    #[must_use]
    pub fn label(&self) -> String {
        match self {
            Self::Video(path) | Self::Tty(path) | Self::Usb(path) => path.display().to_string(),
            Self::Sim(device) => format!("sim:{}", device.name),
        }
    }
}
