//! The device events of the kernel and udev, as a bare listener receives them.
//!
//! Both send on one netlink protocol, in two groups. The kernel's message is `ACTION@PATH` and `KEY=VALUE` lines, each
//! ended by a zero byte; udev's has a binary header before such lines (`struct udev_monitor_netlink_header`, systemd,
//! `src/libsystemd/sd-device/device-monitor.c`).
//! Invariant: a message that is neither is skipped; it never ends the listener.

use std::os::fd::OwnedFd;

use rustix::io::Errno;
use rustix::net::netlink::{KOBJECT_UEVENT, SocketAddrNetlink};
use rustix::net::sockopt::set_socket_recv_buffer_size;
use rustix::net::{AddressFamily, RecvFlags, SocketType, bind, recv, socket};
use serde_json::{Value, json};

use crate::emu::log::{Log, Moment};

/// Group 1 is the kernel's, group 2 udev's.
const GROUPS: u32 = 0b11;
const UDEV_HEAD: &[u8] = b"libudev\0";
/// The header is the prefix and eight words of 32 bits; the third is the offset of its properties.
const PROPERTIES_AT: usize = UDEV_HEAD.len() + 2 * 4;
/// More than the longest message: the kernel's limit is 2 KiB, udev adds its own properties.
const ROOM: usize = 16 * 1024;
const INBOX: usize = 1 << 20;

/// One message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Uevent {
    /// Reported by udev after its rules; otherwise by the kernel.
    pub processed: bool,
    properties: Vec<(String, String)>,
}

impl Uevent {
    /// Reads a message.
    pub fn parse(message: &[u8]) -> Option<Self> {
        let processed = message.starts_with(UDEV_HEAD);
        let lines = if processed {
            let at = message.get(PROPERTIES_AT..PROPERTIES_AT + 4)?.try_into().map(u32::from_ne_bytes).ok()?;
            message.get(usize::try_from(at).ok()?..)?
        } else {
            message
        };
        let pair = |line: &[u8]| {
            let line = String::from_utf8_lossy(line);
            line.split_once('=').map(|(key, value)| (key.to_owned(), value.to_owned()))
        };
        let properties = lines.split(|byte| *byte == 0).filter_map(pair).collect();
        let event = Self { processed, properties };
        (!event.get("ACTION").is_empty()).then_some(event)
    }

    /// A property; empty if it is absent.
    pub fn get(&self, key: &str) -> &str {
        self.properties.iter().find(|(found, _)| found == key).map_or("", |(_, value)| value)
    }

    /// The node, with its path, of a camera that has just become ready for opening.
    pub fn camera_added(&self) -> Option<String> {
        let is_camera = self.get("SUBSYSTEM") == "video4linux" && self.get("ID_V4L_CAPABILITIES").contains(":capture:");
        (self.processed && is_camera && self.get("ACTION") == "add").then(|| self.get("DEVNAME").to_owned())
    }

    fn describe(&self) -> Value {
        json!({
            "by": if self.processed { "udev" } else { "kernel" },
            "event": self.get("ACTION"),
            "subsystem": self.get("SUBSYSTEM"),
            "node": self.get("DEVNAME").trim_start_matches("/dev/"),
            "path": self.get("DEVPATH"),
            "captures": self.get("ID_V4L_CAPABILITIES").contains(":capture:"),
        })
    }
}

/// A socket that receives both.
#[derive(Debug)]
pub struct Listener {
    socket: OwnedFd,
    room: Vec<u8>,
}

impl Listener {
    /// Starts listening.
    pub fn open() -> Result<Self, Errno> {
        let socket = socket(AddressFamily::NETLINK, SocketType::DGRAM, Some(KOBJECT_UEVENT))?;
        set_socket_recv_buffer_size(&socket, INBOX)?;
        bind(&socket, &SocketAddrNetlink::new(0, GROUPS))?;
        Ok(Self { socket, room: vec![0; ROOM] })
    }

    /// Waits for the next message; returns it with its arrival time.
    pub fn receive(&mut self) -> Result<(Uevent, Moment), Errno> {
        loop {
            let (length, _) = recv(&self.socket, &mut self.room[..], RecvFlags::empty())?;
            let moment = Moment::now();
            if let Some(event) = self.room.get(..length).and_then(Uevent::parse) {
                return Ok((event, moment));
            }
        }
    }
}

/// Prints `uevent` lines for USB devices, nodes of cameras and serial lines, and network interfaces, endlessly.
pub fn watch(log: &Log) -> Result<(), Errno> {
    let mut listener = Listener::open()?;
    loop {
        let (event, moment) = listener.receive()?;
        if matches!(event.get("SUBSYSTEM"), "usb" | "video4linux" | "tty" | "net") {
            log.write("uevent", moment, event.describe());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINES: &[u8] =
        b"ACTION=add\0DEVPATH=/devices/x\0SUBSYSTEM=video4linux\0DEVNAME=/dev/video0\0ID_V4L_CAPABILITIES=:capture:\0";

    fn by_udev() -> Vec<u8> {
        let head = [0xfeed_cafe_u32.to_be(), 40, 40, LINES.len() as u32, 0, 0, 0, 0].map(u32::to_ne_bytes).concat();
        [UDEV_HEAD, &head, LINES].concat()
    }

    #[test]
    fn parses_kernel_events() {
        let event = Uevent::parse(b"remove@/devices/x\0ACTION=remove\0DEVPATH=/devices/x\0SUBSYSTEM=usb\0").unwrap();
        assert!(!event.processed);
        assert_eq!([event.get("ACTION"), event.get("SUBSYSTEM"), event.get("DEVNAME")], ["remove", "usb", ""]);
        assert_eq!(event.camera_added(), None);
    }

    #[test]
    fn parses_udev_events() {
        let event = Uevent::parse(&by_udev()).unwrap();
        assert!(event.processed);
        assert_eq!(event.camera_added().as_deref(), Some("/dev/video0"));
    }

    #[test]
    fn skips_malformed_events() {
        let whole = by_udev();
        for length in 0..whole.len() {
            let _neither_panics_nor_matters = Uevent::parse(&whole[..length]);
        }
        assert_eq!(Uevent::parse(b"hello"), None);
        assert_eq!(Uevent::parse(&whole[..20]), None);
    }
}
