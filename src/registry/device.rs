//! An attached device: its identity as it reports it, and the node to open.
//!
//! Invariant: strings here come from the device and are untrusted.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rapid_core::provenance::KernelDriver;
use rapid_core::time::Stamp;
use serde::Serialize;

use crate::simulation::{SimDevice, SimSource};

/// The identity that a USB device reports, and where it is plugged in.
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
    /// Release of the device, used by makers to number their firmware: `bcdDevice` as `4.18`
    /// (USB 2.0, table 9-8).
    pub firmware: Option<String>,
}

/// A vendor or product id as `devices.toml` and `lsusb` write it: `046d`.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature serde requires")]
pub(crate) fn usb_id<S: serde::Serializer>(id: &u16, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{id:04x}"))
}

/// The identity that a device on the network reports, and where it was found.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize)]
pub struct LanIdentity {
    /// The entry that it was found for: no other devices on the network are searched for.
    #[serde(skip)]
    pub entry: String,
    /// Its address, for example `192.168.1.7:8080`.
    pub address: String,
    /// Name of the service instance it announced, if it was found by one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub instance: Option<String>,
}

/// The identity that a device reports.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize)]
#[serde(untagged)]
pub enum Unit {
    /// A USB device.
    Usb(UsbIdentity),
    /// A device on the network.
    Lan(LanIdentity),
}

impl Unit {
    /// The USB device, if it is one.
    pub const fn usb(&self) -> Option<&UsbIdentity> {
        match self {
            Self::Usb(usb) => Some(usb),
            Self::Lan(_) => None,
        }
    }

    /// What distinguishes it from others of its model, if it reports that: a serial number, or the name of its service.
    pub fn serial(&self) -> Option<&str> {
        match self {
            Self::Usb(usb) => usb.serial.as_deref(),
            Self::Lan(lan) => lan.instance.as_deref(),
        }
    }

    /// Where it is: its USB port, or its address.
    pub fn place(&self) -> &str {
        match self {
            Self::Usb(usb) => &usb.port,
            Self::Lan(lan) => &lan.address,
        }
    }

    /// Its location as text for the user.
    pub fn location(&self) -> String {
        let what = if self.usb().is_some() { "port" } else { "address" };
        format!("{what} {}", self.place())
    }

    /// Its model, or the word `lan`.
    pub fn model(&self) -> String {
        match self {
            Self::Usb(usb) => format!("{:04x}:{:04x}", usb.vid, usb.pid),
            Self::Lan(_) => "lan".to_owned(),
        }
    }
}

impl From<UsbIdentity> for Unit {
    fn from(usb: UsbIdentity) -> Self {
        Self::Usb(usb)
    }
}

/// When the driver of a device on the network last received data from it, for the code that tracks its lease.
#[derive(Debug, Clone, Default)]
pub struct LastReceived(Arc<AtomicU64>);

impl LastReceived {
    /// Data was received now.
    pub fn now(&self) {
        self.0.store(Stamp::now().0, Ordering::Relaxed);
    }

    /// The time of the last data; zero if there was none.
    pub fn at(&self) -> Stamp {
        Stamp(self.0.load(Ordering::Relaxed))
    }
}

impl PartialEq for LastReceived {
    /// Two nodes are equal regardless of when data was last received from them.
    fn eq(&self, _: &Self) -> bool {
        true
    }
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
    /// A network interface by its name, for example `can0`: a CAN adapter, or a network adapter with a device
    /// behind it.
    Net(String),
    /// A device on the network.
    Lan {
        /// Its address.
        address: SocketAddr,
        /// When its driver last received data from it.
        last_received: LastReceived,
    },
    /// A simulated device.
    Sim(Arc<SimDevice>),
}

/// One node of one attached device.
#[derive(Debug, Clone, PartialEq)]
pub struct Attachment {
    /// Path of the node in sysfs, unique among attached nodes; it is below the path of its USB
    /// device, by which a removal of either is recognised.
    pub syspath: PathBuf,
    /// The node.
    pub node: DeviceNode,
    /// The device it belongs to.
    pub unit: Unit,
    /// The kernel's driver of it.
    pub driver: Option<Box<KernelDriver>>,
    /// Pixel formats of a capture node, by their V4L2 names; empty if it was not asked (`hotplug::Ask`).
    pub formats: Vec<String>,
}

impl Attachment {
    /// Whether the removal of `syspath` (a node, its USB device, or a hub above) removes this node.
    pub fn is_under(&self, syspath: &Path) -> bool {
        self.syspath.starts_with(syspath)
    }
}

impl DeviceNode {
    /// Whether it is a topic of a recorded episode, which needs no program.
    pub fn is_recording(&self) -> bool {
        matches!(self, Self::Sim(device) if matches!(device.source, SimSource::Replay { .. }))
    }

    /// The node as shown to the user.
    pub fn label(&self) -> String {
        match self {
            Self::Video(path) | Self::Tty(path) | Self::Usb(path) => path.display().to_string(),
            Self::Net(interface) => interface.clone(),
            Self::Lan { address, .. } => address.to_string(),
            Self::Sim(device) => format!("sim:{}", device.name),
        }
    }
}
