//! What has been told as attached, and what an event or an enumeration changes of it.
//!
//! The kernel numbers its events. A node told by event N cannot be taken away by a removal before
//! N, which only arrived late: kernel and udev speak on two sockets, and each has its own backlog.
//!
//! Invariant: pure; a node known here has been told as `Added` and not since as `Removed`.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::{HotplugEvent, Witness};
use crate::registry::Attachment;
use crate::time::Stamp;

/// A node that is there.
#[derive(Debug, Clone)]
pub(super) struct Present {
    pub(super) attachment: Attachment,
    /// Number the kernel gave the USB device; another after each plug.
    pub(super) device_number: Option<String>,
}

/// Must the devices be enumerated?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    Settled,
    /// The removal may be older than the enumeration that found the node.
    Again,
}

#[derive(Debug)]
struct Node {
    device_number: Option<String>,
    /// The event that told of it; 0 if an enumeration did.
    since: u64,
}

/// See the module's comment.
#[derive(Debug, Default)]
pub(super) struct Known {
    nodes: HashMap<PathBuf, Node>,
    /// The kernel's removal of a path whose udev events are still to come.
    removals: HashMap<PathBuf, u64>,
    /// The newest event before the last enumeration.
    enumerated: u64,
}

impl Known {
    /// Takes what an enumeration found that began after event `sequence`; tells the difference,
    /// removals first.
    pub(super) fn enumerated(&mut self, present: Vec<Present>, sequence: u64, now: Stamp) -> Vec<HotplugEvent> {
        self.enumerated = sequence;
        let is_there = |path: &Path, node: &Node| {
            let same = |found: &Present| found.attachment.syspath == path && found.device_number == node.device_number;
            present.iter().any(same)
        };
        let gone: Vec<_> =
            self.nodes.iter().filter(|(path, node)| !is_there(path, node)).map(|(path, _)| path.clone()).collect();
        let mut events = self.forget(gone, Witness::Enumeration, now);
        events.extend(present.into_iter().filter_map(|present| self.remember(present, 0)));
        events
    }

    /// Takes udev's addition number `sequence`.
    pub(super) fn added(&mut self, present: Present, sequence: u64, now: Stamp) -> Vec<HotplugEvent> {
        let path = &present.attachment.syspath;
        let removed_since = |(removed, number): (&PathBuf, &u64)| path.starts_with(removed) && *number > sequence;
        if self.removals.iter().any(removed_since) {
            return Vec::new();
        }
        let exchanged = self.nodes.get(path).is_some_and(|node| node.device_number != present.device_number);
        let gone = if exchanged { vec![path.clone()] } else { Vec::new() };
        let mut events = self.forget(gone, Witness::Udev, now);
        events.extend(self.remember(present, sequence));
        events
    }

    /// Takes the removal number `sequence` of everything at or below `path`.
    pub(super) fn removed(
        &mut self,
        path: &Path,
        sequence: u64,
        witness: Witness,
        now: Stamp,
    ) -> (Vec<HotplugEvent>, Look) {
        if witness == Witness::Kernel {
            self.removals.insert(path.to_owned(), sequence);
        } else if self.removals.get(path).is_some_and(|kernel| *kernel <= sequence) {
            self.removals.remove(path);
        }
        let taken = |(known, node): (&PathBuf, &Node)| {
            (known.starts_with(path) && node.since <= sequence).then(|| known.clone())
        };
        let gone: Vec<_> = self.nodes.iter().filter_map(taken).collect();
        let look = if !gone.is_empty() && sequence <= self.enumerated { Look::Again } else { Look::Settled };
        (self.forget(gone, witness, now), look)
    }

    fn forget(&mut self, mut gone: Vec<PathBuf>, witness: Witness, now: Stamp) -> Vec<HotplugEvent> {
        gone.sort();
        let tell = |syspath: PathBuf| {
            self.nodes.remove(&syspath);
            HotplugEvent::Removed { syspath, witnessed: now, witness }
        };
        gone.into_iter().map(tell).collect()
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
    use crate::registry::{DeviceNode, UsbIdentity};

    /// A node `port/name` of the device with this number.
    fn node(path: &str, number: u32) -> Present {
        let port = path.split('/').next().unwrap_or_default();
        let usb = UsbIdentity { vid: 1, pid: 2, serial: None, port: port.into(), ..UsbIdentity::default() };
        let attachment =
            Attachment { syspath: path.into(), node: DeviceNode::Tty(path.into()), unit: usb.into(), driver: None };
        Present { attachment, device_number: Some(number.to_string()) }
    }

    enum Step {
        /// What is there, after which event.
        Found(&'static [(&'static str, u32)], u64),
        Added(&'static str, u32, u64),
        Kernel(&'static str, u64),
        Udev(&'static str, u64),
    }
    use Step::{Added, Found, Kernel, Udev};

    fn told(steps: &[Step]) -> Vec<String> {
        let mut known = Known::default();
        let now = Stamp(1);
        let mut told = Vec::new();
        for step in steps {
            let (events, look) = match step {
                Found(nodes, sequence) => {
                    let present = nodes.iter().map(|(path, number)| node(path, *number)).collect();
                    (known.enumerated(present, *sequence, now), Look::Settled)
                }
                Added(path, number, sequence) => (known.added(node(path, *number), *sequence, now), Look::Settled),
                Kernel(path, sequence) => known.removed(Path::new(path), *sequence, Witness::Kernel, now),
                Udev(path, sequence) => known.removed(Path::new(path), *sequence, Witness::Udev, now),
            };
            told.extend(events.iter().map(|event| match event {
                HotplugEvent::Added(attachment) => format!("+{}", attachment.syspath.display()),
                HotplugEvent::Removed { syspath, witness, .. } => format!("-{} {}", syspath.display(), witness.word()),
            }));
            if look == Look::Again {
                told.push("look".into());
            }
        }
        told
    }

    #[test]
    fn each_change_is_told_once_whatever_order_it_comes_in() {
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
            ("told twice", &[Found(&[("1/a", 1)], 5), Added("1/a", 1, 5), Added("1/a", 1, 6)], &["+1/a"]),
        ];
        for (name, steps, expected) in table {
            assert_eq!(told(steps), *expected, "{name}");
        }
    }
}
