//! The machine itself: kernel uevents for removal, udev's processed events for the node to open.
//!
//! The monitors start before the devices are enumerated, so that nothing plugged in meanwhile is missed. A removal is
//! reported by whichever source is first (on the virtual bench the kernel's uevent comes some 50 ms before udev's); an
//! addition only by udev, once rules and permissions are in place.
//!
//! The kernel numbers its events. A removal before event N cannot remove a node reported by N; it only arrived late:
//! kernel and udev send on two sockets, each with its own backlog (`Known`).
//!
//! Invariant: a node in `Known` has been reported as `Added` and not as `Removed` since.
//! Invariant: lost events are never silent: when a socket overflows, devices are enumerated again
//! and the difference is reported.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use futures::Stream;
use rapid_core::provenance::KernelDriver;
use rapid_core::time::Stamp;
use rapid_registry::Registry;
use rapid_registry::device::{Attachment, DeviceNode, UsbIdentity};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use udev::{Device, Enumerator, EventType, MonitorBuilder, MonitorSocket};

use super::{HotplugError, HotplugEvent, UnplugSource};

/// Subsystems whose nodes are opened, in addition to USB devices themselves.
const NODE_SUBSYSTEMS: [&str; 3] = ["video4linux", "tty", "net"];

/// Which capture nodes are asked for the pixel formats that they offer, and how: those of cameras with several streams, which
/// are distinguished by them. No others: asking opens the node.
#[derive(Debug, Clone)]
pub struct Ask {
    /// Vendor and product ids.
    pub models: BTreeSet<(u16, u16)>,
    /// The V4L2 names of a node's formats; none if it does not answer.
    pub formats: fn(&Path) -> Vec<String>,
}

impl Ask {
    /// Nothing is asked.
    pub const NOTHING: Self = Self { models: BTreeSet::new(), formats: |_| Vec::new() };

    /// What a run with these entries asks.
    pub fn from_registry(registry: &Registry, formats: fn(&Path) -> Vec<String>) -> Self {
        let streams = registry.devices.iter().filter(|device| registry.shares_unit(device));
        Self {
            models: streams.filter_map(|device| device.identity.usb()).map(|usb| (usb.vid, usb.pid)).collect(),
            formats,
        }
    }
}

/// See the module's comment.
pub struct UdevMonitor {
    kernel: AsyncFd<MonitorSocket>,
    udev: AsyncFd<MonitorSocket>,
    known: Known,
    queue: VecDeque<HotplugEvent>,
    ask: Ask,
}

impl UdevMonitor {
    /// Starts monitoring, then enumerates the present devices.
    ///
    /// # Errors
    /// When the netlink sockets are not available or sysfs cannot be read.
    pub fn open(ask: Ask) -> Result<Self, HotplugError> {
        let mut monitor = Self {
            kernel: listen(MonitorBuilder::new_kernel())?,
            udev: listen(MonitorBuilder::new())?,
            known: Known::default(),
            queue: VecDeque::new(),
            ask,
        };
        monitor.enumerate()?;
        Ok(monitor)
    }

    /// Reports the difference between the devices that are present and those that are known.
    fn enumerate(&mut self) -> Result<(), HotplugError> {
        // Read before the devices: an event up to this one may concern a device that is gone by now.
        let sequence = newest_event();
        self.queue.extend(self.known.enumerated(attached(&self.ask)?, sequence, Stamp::now()));
        Ok(())
    }

    fn handle_event(&mut self, event: &udev::Event, source: UnplugSource) -> Result<(), HotplugError> {
        let (sequence, now) = (event.sequence_number(), Stamp::now());
        match event.event_type() {
            EventType::Remove => {
                let (gone, look) = self.known.removed(event.syspath(), sequence, source, now);
                self.queue.extend(gone);
                if look == Look::Again {
                    self.enumerate()?;
                }
            }
            EventType::Add | EventType::Change if source == UnplugSource::Udev => {
                if let Some(present) = present(event, &self.ask) {
                    self.queue.extend(self.known.added(present, sequence, now));
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Moves pending events of a socket into the queue. Ready when the socket is drained and registered for a wake-up.
    fn poll_socket(&mut self, context: &mut Context<'_>, source: UnplugSource) -> Poll<Result<(), HotplugError>> {
        loop {
            let socket = if source == UnplugSource::Kernel { &self.kernel } else { &self.udev };
            let mut guard = ready!(socket.poll_read_ready(context))?;
            let Some(event) = socket.get_ref().iter().next() else {
                // Set by the receive that just returned nothing; libudev keeps it.
                let error = std::io::Error::last_os_error();
                match error.raw_os_error() {
                    Some(libc::ENOBUFS) => self.enumerate()?,
                    Some(libc::EAGAIN) => guard.clear_ready(),
                    // A message that is not from udev; the next one may be.
                    _ => {}
                }
                continue;
            };
            drop(guard);
            self.handle_event(&event, source)?;
        }
    }
}

impl Stream for UdevMonitor {
    type Item = Result<HotplugEvent, HotplugError>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if self.queue.is_empty() {
            // The kernel's socket first: it reports removals earlier.
            for source in [UnplugSource::Kernel, UnplugSource::Udev] {
                if let Poll::Ready(Err(error)) = self.poll_socket(context, source) {
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

/// The devices attached now that could be opened, for `rapid devices`.
///
/// # Errors
/// When sysfs cannot be read.
pub fn enumerate(ask: &Ask) -> Result<Vec<Attachment>, HotplugError> {
    Ok(attached(ask)?.into_iter().map(|present| present.attachment).collect())
}

fn listen(builder: std::io::Result<MonitorBuilder>) -> Result<AsyncFd<MonitorSocket>, HotplugError> {
    let mut builder = builder?.match_subsystem_devtype("usb", "usb_device")?;
    for subsystem in NODE_SUBSYSTEMS {
        builder = builder.match_subsystem(subsystem)?;
    }
    #[expect(deprecated, reason = "its replacement is unsafe; a MonitorSocket owns its descriptor until it is dropped")]
    Ok(AsyncFd::with_interest(builder.listen()?, Interest::READABLE)?)
}

/// Number of the newest event the kernel has sent; 0 where it is unknown.
fn newest_event() -> u64 {
    let number = std::fs::read_to_string("/sys/kernel/uevent_seqnum").ok();
    number.and_then(|number| number.trim().parse().ok()).unwrap_or(0)
}

fn attached(ask: &Ask) -> Result<Vec<Present>, HotplugError> {
    let mut enumerator = Enumerator::new()?;
    for subsystem in NODE_SUBSYSTEMS {
        enumerator.match_subsystem(subsystem)?;
    }
    enumerator.match_subsystem("usb")?;
    enumerator.match_is_initialized()?;
    let mut found: Vec<_> = enumerator.scan_devices()?.filter_map(|device| present(&device, ask)).collect();
    // Sorted by port, so that identical units are assigned the same way at each start.
    found.sort_by(|a, b| {
        let (a, b) = (&a.attachment, &b.attachment);
        (a.unit.place(), &a.syspath).cmp(&(b.unit.place(), &b.syspath))
    });
    Ok(found)
}

/// The attachment of a node that can be opened; `None` for any other device.
fn present(device: &Device, ask: &Ask) -> Option<Present> {
    let path = || Some(device.devnode()?.to_owned());
    let node = match device.subsystem()?.to_str()? {
        "video4linux" if captures(device) => DeviceNode::Video(path()?),
        "tty" => DeviceNode::Tty(path()?),
        // An interface has a name but no node.
        "net" => DeviceNode::Net(device.sysname().to_str()?.to_owned()),
        // In this subsystem, only the devices themselves have a node.
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
    let formats = match &node {
        DeviceNode::Video(path) if ask.models.contains(&(usb.vid, usb.pid)) => (ask.formats)(path),
        _ => Vec::new(),
    };
    let attachment = Attachment {
        syspath: device.syspath().to_owned(),
        node,
        unit: usb.into(),
        driver: kernel_driver(device).map(Box::new),
        formats,
    };
    Some(Present { attachment, device_number: text("devnum") })
}

/// `bcdDevice` as sysfs prints it, four digits (`0418`), in its usual form: `4.18`.
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

/// A UVC camera has a second video node for metadata, which has no pictures.
fn captures(device: &Device) -> bool {
    match device.property_value("ID_V4L_CAPABILITIES") {
        Some(capabilities) => capabilities.to_string_lossy().contains(":capture:"),
        None => device.attribute_value("index").is_some_and(|index| index == "0"),
    }
}

/// A node that is present.
#[derive(Debug, Clone)]
pub(super) struct Present {
    pub(super) attachment: Attachment,
    /// Number the kernel gave the USB device; it changes with each plug.
    pub(super) device_number: Option<String>,
}

/// Whether the devices must be enumerated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    Settled,
    /// The removal may be older than the enumeration that found the node.
    Again,
}

#[derive(Debug)]
struct Node {
    device_number: Option<String>,
    /// The event that reported it; 0 if it was an enumeration.
    since: u64,
}

/// The nodes reported as attached, and how events and enumerations change them. Pure.
#[derive(Debug, Default)]
struct Known {
    nodes: HashMap<PathBuf, Node>,
    /// Paths that the kernel removed and whose udev events are still to come.
    removals: HashMap<PathBuf, u64>,
    /// The newest event before the last enumeration.
    enumerated: u64,
}

impl Known {
    /// Applies an enumeration that began after event `sequence`; reports the difference, removals first.
    pub(super) fn enumerated(&mut self, present: Vec<Present>, sequence: u64, now: Stamp) -> Vec<HotplugEvent> {
        self.enumerated = sequence;
        let is_there = |path: &Path, node: &Node| {
            let same = |found: &Present| found.attachment.syspath == path && found.device_number == node.device_number;
            present.iter().any(same)
        };
        let gone: Vec<_> =
            self.nodes.iter().filter(|(path, node)| !is_there(path, node)).map(|(path, _)| path.clone()).collect();
        let mut events = self.forget(gone, UnplugSource::Enumeration, now);
        events.extend(present.into_iter().filter_map(|present| self.remember(present, 0)));
        events
    }

    /// Applies udev's addition number `sequence`.
    pub(super) fn added(&mut self, present: Present, sequence: u64, now: Stamp) -> Vec<HotplugEvent> {
        let path = &present.attachment.syspath;
        let removed_since = |(removed, number): (&PathBuf, &u64)| path.starts_with(removed) && *number > sequence;
        if self.removals.iter().any(removed_since) {
            return Vec::new();
        }
        let exchanged = self.nodes.get(path).is_some_and(|node| node.device_number != present.device_number);
        let gone = if exchanged { vec![path.clone()] } else { Vec::new() };
        let mut events = self.forget(gone, UnplugSource::Udev, now);
        events.extend(self.remember(present, sequence));
        events
    }

    /// Applies the removal number `sequence` of everything at or below `path`.
    pub(super) fn removed(
        &mut self,
        path: &Path,
        sequence: u64,
        source: UnplugSource,
        now: Stamp,
    ) -> (Vec<HotplugEvent>, Look) {
        if source == UnplugSource::Kernel {
            self.removals.insert(path.to_owned(), sequence);
        } else if self.removals.get(path).is_some_and(|kernel| *kernel <= sequence) {
            self.removals.remove(path);
        }
        let taken = |(known, node): (&PathBuf, &Node)| {
            (known.starts_with(path) && node.since <= sequence).then(|| known.clone())
        };
        let gone: Vec<_> = self.nodes.iter().filter_map(taken).collect();
        let look = if !gone.is_empty() && sequence <= self.enumerated { Look::Again } else { Look::Settled };
        (self.forget(gone, source, now), look)
    }

    fn forget(&mut self, mut gone: Vec<PathBuf>, source: UnplugSource, now: Stamp) -> Vec<HotplugEvent> {
        gone.sort();
        let removal = |syspath: PathBuf| {
            self.nodes.remove(&syspath);
            HotplugEvent::Removed { syspath, noticed: now, source }
        };
        gone.into_iter().map(removal).collect()
    }

    /// `None` when the node is known.
    fn remember(&mut self, present: Present, since: u64) -> Option<HotplugEvent> {
        let Present { attachment, device_number } = present;
        if self.nodes.contains_key(&attachment.syspath) {
            return None;
        }
        self.nodes.insert(attachment.syspath.clone(), Node { device_number, since });
        Some(HotplugEvent::Added(attachment))
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

#[cfg(test)]
mod known_tests {
    use rapid_registry::device::{DeviceNode, UsbIdentity};

    use super::*;

    /// A node `port/name` of the device with this number.
    fn node(path: &str, number: u32) -> Present {
        let port = path.split('/').next().unwrap_or_default();
        let usb = UsbIdentity { vid: 1, pid: 2, serial: None, port: port.into(), ..UsbIdentity::default() };
        let attachment = Attachment {
            syspath: path.into(),
            node: DeviceNode::Tty(path.into()),
            unit: usb.into(),
            driver: None,
            formats: Vec::new(),
        };
        Present { attachment, device_number: Some(number.to_string()) }
    }

    enum Step {
        /// The nodes found, and the event after which they were enumerated.
        Found(&'static [(&'static str, u32)], u64),
        Added(&'static str, u32, u64),
        Kernel(&'static str, u64),
        Udev(&'static str, u64),
    }
    use Step::{Added, Found, Kernel, Udev};

    fn events_of(steps: &[Step]) -> Vec<String> {
        let mut known = Known::default();
        let now = Stamp(1);
        let mut reported = Vec::new();
        for step in steps {
            let (events, look) = match step {
                Found(nodes, sequence) => {
                    let present = nodes.iter().map(|(path, number)| node(path, *number)).collect();
                    (known.enumerated(present, *sequence, now), Look::Settled)
                }
                Added(path, number, sequence) => (known.added(node(path, *number), *sequence, now), Look::Settled),
                Kernel(path, sequence) => known.removed(Path::new(path), *sequence, UnplugSource::Kernel, now),
                Udev(path, sequence) => known.removed(Path::new(path), *sequence, UnplugSource::Udev, now),
            };
            reported.extend(events.iter().map(|event| match event {
                HotplugEvent::Added(attachment) => format!("+{}", attachment.syspath.display()),
                HotplugEvent::Removed { syspath, source, .. } => format!("-{} {}", syspath.display(), source.word()),
            }));
            if look == Look::Again {
                reported.push("look".into());
            }
        }
        reported
    }

    #[test]
    fn each_change_is_reported_once_in_any_order() {
        let table: &[(&str, &[Step], &[&str])] = &[
            (
                "the kernel first",
                &[Found(&[("1/a", 1)], 5), Kernel("1/a", 6), Udev("1/a", 6)],
                &["+1/a", "-1/a kernel"],
            ),
            ("udev first", &[Added("1/a", 1, 5), Udev("1/a", 6), Kernel("1/a", 6)], &["+1/a", "-1/a udev"]),
            (
                "the kernel's removal comes after the replug it precedes",
                &[Added("1/a", 1, 5), Udev("1/a", 6), Added("1/a", 2, 7), Kernel("1/a", 6)],
                &["+1/a", "-1/a udev", "+1/a"],
            ),
            (
                "an addition comes after the removal that follows it",
                &[Kernel("1", 9), Added("1/a", 1, 8), Udev("1", 9), Added("1/a", 2, 12)],
                &["+1/a"],
            ),
            (
                "a device takes its nodes along, and no other port's",
                &[Found(&[("1/a", 1), ("1/b", 1), ("1.2/a", 2)], 5), Kernel("1", 6)],
                &["+1/a", "+1/b", "+1.2/a", "-1/a kernel", "-1/b kernel"],
            ),
            (
                "overflow: one gone, one exchanged at its path, one new, one as it was",
                &[Found(&[("1/a", 1), ("2/a", 2), ("3/a", 3)], 5), Found(&[("2/a", 7), ("3/a", 3), ("4/a", 8)], 20)],
                &["+1/a", "+2/a", "+3/a", "-1/a enumeration", "-2/a enumeration", "+2/a", "+4/a"],
            ),
            (
                "overflow: an old removal waits behind it, the addition was lost",
                &[Found(&[("1/a", 2)], 20), Kernel("1/a", 12), Found(&[("1/a", 2)], 21)],
                &["+1/a", "-1/a kernel", "look", "+1/a"],
            ),
            (
                "the removal was lost and the addition not",
                &[Added("1/a", 1, 5), Added("1/a", 2, 9)],
                &["+1/a", "-1/a udev", "+1/a"],
            ),
            ("reported twice", &[Found(&[("1/a", 1)], 5), Added("1/a", 1, 5), Added("1/a", 1, 6)], &["+1/a"]),
        ];
        for (name, steps, expected) in table {
            assert_eq!(events_of(steps), *expected, "{name}");
        }
    }
}
