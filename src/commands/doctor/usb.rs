//! The tree of USB devices, as `/sys/bus/usb/devices` has it.
//!
//! Names there: `usb1` is a root hub, `1-2.3` what is plugged into port 3 of the hub in port 2 of bus 1;
//! names with a colon are interfaces.

use std::path::Path;

use super::facts::{names, word};

/// A USB device.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct UsbDevice {
    /// Where it is plugged in: `1-2.3`, of a root hub `usb1`.
    pub(super) port: String,
    /// Bus.
    pub(super) bus: u32,
    /// Speed at which it runs, Mbit/s.
    pub(super) mbit: f64,
    /// Vendor id.
    pub(super) vid: u16,
    /// Product id.
    pub(super) pid: u16,
    /// Product string.
    pub(super) product: Option<String>,
    /// Serial number.
    pub(super) serial: Option<String>,
    /// Others are plugged into it.
    pub(super) is_hub: bool,
    /// The kernel may suspend it when nobody uses it.
    pub(super) autosuspends: bool,
}

impl UsbDevice {
    /// Is it a bus?
    #[must_use]
    pub(super) fn is_root(&self) -> bool {
        self.port.starts_with("usb")
    }

    /// How many hubs lie above it, the root hub not counted.
    #[must_use]
    pub(super) fn depth(&self) -> usize {
        self.port.matches('.').count()
    }

    /// Buses in order, on each the ports as one would count them.
    fn order(&self) -> (u32, Vec<u32>) {
        let ports = self.port.split_once('-').map_or("", |(_, ports)| ports);
        (self.bus, ports.split('.').filter_map(|port| port.parse().ok()).collect())
    }
}

/// All devices below `root`, in the order of their ports.
pub(super) fn devices(root: &Path) -> Vec<UsbDevice> {
    let folder = root.join("sys/bus/usb/devices");
    let mut found: Vec<_> =
        names(&folder).iter().filter(|name| !name.contains(':')).filter_map(|name| device(&folder, name)).collect();
    found.sort_by_key(UsbDevice::order);
    found
}

fn device(folder: &Path, name: &str) -> Option<UsbDevice> {
    let read = |file: &str| word(&folder.join(name).join(file));
    let id = |file: &str| u16::from_str_radix(&read(file)?, 16).ok();
    Some(UsbDevice {
        port: name.to_owned(),
        bus: read("busnum")?.parse().ok()?,
        mbit: read("speed")?.parse().ok().filter(|mbit: &f64| mbit.is_finite())?,
        vid: id("idVendor")?,
        pid: id("idProduct")?,
        product: read("product"),
        serial: read("serial"),
        // USB 2.0, table 11-15.
        is_hub: read("bDeviceClass").as_deref() == Some("09"),
        autosuspends: read("power/control").as_deref() == Some("auto"),
    })
}
