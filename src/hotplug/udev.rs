//! The machine itself: kernel uevents for removal, udev's processed events for the node to open.
//!
//! The monitors listen before the devices are enumerated, so that nothing plugged in between is
//! missed. A removal is told by whichever witness is first (on the virtual bench the kernel's uevent
//! comes some 50 ms before udev's); an addition only by udev, once rules and permissions are in place.
//!
//! Invariant: lost events are never silent: when a socket overflows, devices are enumerated again
//! and the difference is told.

use std::collections::VecDeque;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use futures::Stream;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use udev::{Device, Enumerator, EventType, MonitorBuilder, MonitorSocket};

use super::known::{Known, Look, Present};
use super::{HotplugError, HotplugEvent, Witness};
use crate::provenance::KernelDriver;
use crate::registry::{Attachment, DeviceNode, UsbIdentity};
use crate::time::Stamp;

/// Subsystems whose nodes are opened, beside the USB devices themselves.
const NODE_SUBSYSTEMS: [&str; 3] = ["video4linux", "tty", "net"];

/// See the module's comment.
pub struct UdevMonitor {
    kernel: AsyncFd<MonitorSocket>,
    udev: AsyncFd<MonitorSocket>,
    known: Known,
    queue: VecDeque<HotplugEvent>,
}

impl std::fmt::Debug for UdevMonitor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("UdevMonitor").field("known", &self.known).finish_non_exhaustive()
    }
}

impl UdevMonitor {
    /// Begins to listen, then enumerates what is there.
    ///
    /// # Errors
    /// When the netlink sockets are not to be had or sysfs cannot be read.
    pub fn open() -> Result<Self, HotplugError> {
        let mut monitor = Self {
            kernel: listen(MonitorBuilder::new_kernel())?,
            udev: listen(MonitorBuilder::new())?,
            known: Known::default(),
            queue: VecDeque::new(),
        };
        monitor.enumerate()?;
        Ok(monitor)
    }

    /// Tells the difference between what is there and what is known.
    fn enumerate(&mut self) -> Result<(), HotplugError> {
        // Read before the devices: an event up to here may tell of a device that is gone by now.
        let sequence = newest_event();
        self.queue.extend(self.known.enumerated(attached()?, sequence, Stamp::now()));
        Ok(())
    }

    fn take(&mut self, event: &udev::Event, witness: Witness) -> Result<(), HotplugError> {
        let (sequence, now) = (event.sequence_number(), Stamp::now());
        match event.event_type() {
            EventType::Remove => {
                let (gone, look) = self.known.removed(event.syspath(), sequence, witness, now);
                self.queue.extend(gone);
                if look == Look::Again {
                    self.enumerate()?;
                }
            }
            EventType::Add | EventType::Change if witness == Witness::Udev => {
                if let Some(present) = present(event) {
                    self.queue.extend(self.known.added(present, sequence, now));
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Moves what waits on a socket into the queue. Ready when the socket is drained and will wake us.
    fn poll_socket(&mut self, context: &mut Context<'_>, witness: Witness) -> Poll<Result<(), HotplugError>> {
        loop {
            let socket = if witness == Witness::Kernel { &self.kernel } else { &self.udev };
            let mut guard = ready!(socket.poll_read_ready(context))?;
            let Some(event) = socket.get_ref().iter().next() else {
                // Set by the receive that just returned nothing; libudev keeps it.
                let error = std::io::Error::last_os_error();
                match error.raw_os_error() {
                    Some(libc::ENOBUFS) => self.enumerate()?,
                    Some(libc::EAGAIN) => guard.clear_ready(),
                    // A message that is not udev's: the next one may be.
                    _ => {}
                }
                continue;
            };
            drop(guard);
            self.take(&event, witness)?;
        }
    }
}

impl Stream for UdevMonitor {
    type Item = Result<HotplugEvent, HotplugError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if self.queue.is_empty() {
            // The kernel's socket first: its removals are the earlier ones.
            for witness in [Witness::Kernel, Witness::Udev] {
                if let Poll::Ready(Err(error)) = self.poll_socket(context, witness) {
                    return Poll::Ready(Some(Err(error)));
                }
            }
        }
        match self.queue.pop_front() {
            Some(event) => Poll::Ready(Some(Ok(event))),
            None => Poll::Pending,
        }
    }
}

/// What is attached now and could be opened, for `rapid devices`.
///
/// # Errors
/// When sysfs cannot be read.
pub fn enumerate() -> Result<Vec<Attachment>, HotplugError> {
    Ok(attached()?.into_iter().map(|present| present.attachment).collect())
}

fn listen(builder: std::io::Result<MonitorBuilder>) -> Result<AsyncFd<MonitorSocket>, HotplugError> {
    let mut builder = builder?.match_subsystem_devtype("usb", "usb_device")?;
    for subsystem in NODE_SUBSYSTEMS {
        builder = builder.match_subsystem(subsystem)?;
    }
    #[expect(deprecated, reason = "its replacement is unsafe; a MonitorSocket owns its descriptor until it is dropped")]
    Ok(AsyncFd::with_interest(builder.listen()?, Interest::READABLE)?)
}

/// Number of the newest event the kernel has sent; 0 where it does not say.
fn newest_event() -> u64 {
    let number = std::fs::read_to_string("/sys/kernel/uevent_seqnum").ok();
    number.and_then(|number| number.trim().parse().ok()).unwrap_or(0)
}

fn attached() -> Result<Vec<Present>, HotplugError> {
    let mut enumerator = Enumerator::new()?;
    for subsystem in NODE_SUBSYSTEMS {
        enumerator.match_subsystem(subsystem)?;
    }
    enumerator.match_subsystem("usb")?;
    enumerator.match_is_initialized()?;
    let mut found: Vec<_> = enumerator.scan_devices()?.filter_map(|device| present(&device)).collect();
    // In the order of ports, so that a start assigns equal units the same way each time.
    found.sort_by(|a, b| {
        let (a, b) = (&a.attachment, &b.attachment);
        (a.unit.place(), &a.syspath).cmp(&(b.unit.place(), &b.syspath))
    });
    Ok(found)
}

/// The attachment of a node that can be opened; `None` for any other device.
fn present(device: &Device) -> Option<Present> {
    let path = || Some(device.devnode()?.to_owned());
    let node = match device.subsystem()?.to_str()? {
        "video4linux" if captures(device) => DeviceNode::Video(path()?),
        "tty" => DeviceNode::Tty(path()?),
        // An interface has a name and no node.
        "net" => DeviceNode::Net(device.sysname().to_str()?.to_owned()),
        // Of this subsystem, only the devices themselves have a node.
        "usb" => DeviceNode::Usb(path()?),
        _ => return None,
    };
    let usb_device = match &node {
        // Its parent is the hub.
        DeviceNode::Usb(_) => device.clone(),
        _ => device.parent_with_subsystem_devtype("usb", "usb_device").ok()??,
    };
    let text = |name: &str| {
        let value = usb_device.attribute_value(name)?.to_string_lossy().into_owned();
        (!value.is_empty()).then_some(value)
    };
    let number = |name: &str| u16::from_str_radix(&text(name)?, 16).ok();
    let usb = UsbIdentity {
        vid: number("idVendor")?,
        pid: number("idProduct")?,
        serial: text("serial"),
        port: usb_device.sysname().to_string_lossy().into_owned(),
        product: text("product"),
        manufacturer: text("manufacturer"),
        firmware: text("bcdDevice").map(|release| release_number(&release)),
    };
    let attachment = Attachment {
        syspath: device.syspath().to_owned(),
        node,
        unit: usb.into(),
        driver: kernel_driver(device).map(Box::new),
    };
    Some(Present { attachment, device_number: text("devnum") })
}

/// `bcdDevice` as sysfs writes it, four digits (`0418`), the way it is read: `4.18`.
fn release_number(digits: &str) -> String {
    match digits.split_at_checked(2) {
        Some((major, minor)) if digits.len() == 4 => format!("{}.{minor}", major.strip_prefix('0').unwrap_or(major)),
        _ => digits.to_owned(),
    }
}

/// The driver of the nearest interface above a node. Most of them have no version of their own.
fn kernel_driver(device: &Device) -> Option<KernelDriver> {
    let interface = device.parent_with_subsystem_devtype("usb", "usb_interface").ok()??;
    let name = interface.driver()?.to_string_lossy().into_owned();
    let version = std::fs::read_to_string(interface.syspath().join("driver/module/version")).ok();
    let version = version.map(|text| text.trim().to_owned()).filter(|text| !text.is_empty());
    Some(KernelDriver { name, version })
}

/// A UVC camera offers a second video node for metadata, which has no pictures.
fn captures(device: &Device) -> bool {
    match device.property_value("ID_V4L_CAPABILITIES") {
        Some(capabilities) => capabilities.to_string_lossy().contains(":capture:"),
        None => device.attribute_value("index").is_some_and(|index| index == "0"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_release_is_read_as_lsusb_shows_it() {
        for (digits, expected) in [("0418", "4.18"), ("1000", "10.00"), ("0000", "0.00"), ("1", "1"), ("äöü", "äöü")]
        {
            assert_eq!(release_number(digits), expected);
        }
    }
}
