//! The machine itself: kernel uevents for removal, udev's processed events for the node to open.
//!
//! The monitors listen before the devices are enumerated, so that nothing plugged in between is
//! missed. A removal is told by whichever witness is first (on the virtual bench the kernel's uevent
//! comes some 50 ms before udev's); an addition only by udev, once rules and permissions are in place.
//!
//! Invariant: a node of `known` has been told as `Added` and not since as `Removed`.
//! Invariant: lost events are never silent: when a socket overflows, devices are enumerated again
//! and the difference is told.

use std::collections::{HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use futures::Stream;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use udev::{Device, Enumerator, EventType, MonitorBuilder, MonitorSocket};

use super::{HotplugError, HotplugEvent, Witness};
use crate::registry::{Attachment, DeviceNode, UsbIdentity};
use crate::time::Stamp;

/// Subsystems whose nodes are opened.
const NODE_SUBSYSTEMS: [&str; 2] = ["video4linux", "tty"];

/// See the module's comment.
pub struct UdevMonitor {
    kernel: AsyncFd<MonitorSocket>,
    udev: AsyncFd<MonitorSocket>,
    known: HashMap<PathBuf, Node>,
    /// Sequence number of the kernel's removal of a path whose udev events are still to come.
    removals: HashMap<PathBuf, u64>,
    queue: VecDeque<HotplugEvent>,
}

/// What is remembered of a node to notice that it was exchanged while events were lost.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Node {
    /// Number the kernel gave the USB device at this enumeration; another after each plug.
    device_number: Option<String>,
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
            known: HashMap::new(),
            removals: HashMap::new(),
            queue: VecDeque::new(),
        };
        monitor.enumerate()?;
        Ok(monitor)
    }

    /// Tells the difference between what is there and what is known.
    fn enumerate(&mut self) -> Result<(), HotplugError> {
        let present = attached()?;
        let now = Stamp::now();
        let gone = self.known.iter().filter(|(path, node)| {
            !present.iter().any(|(attachment, found)| attachment.syspath == **path && found == *node)
        });
        for path in gone.map(|(path, _)| path.clone()).collect::<Vec<_>>() {
            self.known.remove(&path);
            let witness = Witness::Enumeration;
            self.queue.push_back(HotplugEvent::Removed { syspath: path, witnessed: now, witness });
        }
        for (attachment, node) in present {
            if self.known.insert(attachment.syspath.clone(), node).is_none() {
                self.queue.push_back(HotplugEvent::Added(attachment));
            }
        }
        Ok(())
    }

    fn take(&mut self, event: &udev::Event, witness: Witness) {
        match event.event_type() {
            EventType::Remove => self.removed(event.syspath(), event.sequence_number(), witness),
            EventType::Add | EventType::Change if witness == Witness::Udev => self.added(event),
            _ => {}
        }
    }

    fn added(&mut self, event: &udev::Event) {
        let Some((attachment, node)) = attachment(event) else { return };
        let path = &attachment.syspath;
        let removed_since = self
            .removals
            .iter()
            .any(|(removed, sequence)| path.starts_with(removed) && *sequence > event.sequence_number());
        if removed_since || self.known.contains_key(path) {
            return;
        }
        self.known.insert(path.clone(), node);
        self.queue.push_back(HotplugEvent::Added(attachment));
    }

    fn removed(&mut self, path: &Path, sequence: u64, witness: Witness) {
        if witness == Witness::Kernel {
            self.removals.insert(path.to_owned(), sequence);
        } else if self.removals.get(path).is_some_and(|kernel| *kernel <= sequence) {
            self.removals.remove(path);
        }
        let before = self.known.len();
        self.known.retain(|known, _| !known.starts_with(path));
        if self.known.len() < before {
            let (syspath, witnessed) = (path.to_owned(), Stamp::now());
            self.queue.push_back(HotplugEvent::Removed { syspath, witnessed, witness });
        }
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
            self.take(&event, witness);
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
    Ok(attached()?.into_iter().map(|(attachment, _)| attachment).collect())
}

fn listen(builder: std::io::Result<MonitorBuilder>) -> Result<AsyncFd<MonitorSocket>, HotplugError> {
    let mut builder = builder?.match_subsystem_devtype("usb", "usb_device")?;
    for subsystem in NODE_SUBSYSTEMS {
        builder = builder.match_subsystem(subsystem)?;
    }
    #[expect(deprecated, reason = "its replacement is unsafe; a MonitorSocket owns its descriptor until it is dropped")]
    Ok(AsyncFd::with_interest(builder.listen()?, Interest::READABLE)?)
}

fn attached() -> Result<Vec<(Attachment, Node)>, HotplugError> {
    let mut enumerator = Enumerator::new()?;
    for subsystem in NODE_SUBSYSTEMS {
        enumerator.match_subsystem(subsystem)?;
    }
    enumerator.match_is_initialized()?;
    let mut found: Vec<_> = enumerator.scan_devices()?.filter_map(|device| attachment(&device)).collect();
    // In the order of ports, so that a start assigns equal units the same way each time.
    found.sort_by(|(a, _), (b, _)| (&a.usb.port, &a.syspath).cmp(&(&b.usb.port, &b.syspath)));
    Ok(found)
}

/// The attachment of a node that can be opened; `None` for any other device.
fn attachment(device: &Device) -> Option<(Attachment, Node)> {
    let path = device.devnode()?.to_owned();
    let node = match device.subsystem()?.to_str()? {
        "video4linux" if captures(device) => DeviceNode::Video(path),
        "tty" => DeviceNode::Tty(path),
        _ => return None,
    };
    let usb_device = device.parent_with_subsystem_devtype("usb", "usb_device").ok()??;
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
    };
    let known = Node { device_number: text("devnum") };
    Some((Attachment { syspath: device.syspath().to_owned(), node, usb }, known))
}

/// A UVC camera offers a second video node for metadata, which has no pictures.
fn captures(device: &Device) -> bool {
    match device.property_value("ID_V4L_CAPABILITIES") {
        Some(capabilities) => capabilities.to_string_lossy().contains(":capture:"),
        None => device.attribute_value("index").is_some_and(|index| index == "0"),
    }
}
