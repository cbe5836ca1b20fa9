//! Facts gathered about the host.
//!
//! Invariant: collecting reads files below a root folder (`/` except in tests) and opens no device.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

#[cfg(feature = "motors")]
use rapid_devices::driver::can::netlink;

use super::preview;

/// Facts about the host. Those that cannot be read are `None` or missing.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Facts {
    /// USB devices, root hubs included, in the order of their ports.
    pub(super) usb: Vec<UsbDevice>,
    /// Nodes of USB devices that programs open.
    pub(super) nodes: Vec<Node>,
    pub(super) user: User,
    pub(super) udev_runs: bool,
    /// The installed rules, if there are any.
    pub(super) rules: Option<String>,
    /// Highest permitted real-time priority.
    pub(super) realtime: Option<u64>,
    /// Memory that may be locked, bytes; `u64::MAX` without a limit.
    pub(super) locked_memory: Option<u64>,
    /// Shared memory: size and free space, bytes.
    pub(super) shared_memory: Option<(u64, u64)>,
    /// Where episodes would be written.
    pub(super) disk: Option<Disk>,
    /// The kernel's clock source.
    pub(super) clock: Option<String>,
    pub(super) can: Vec<Interface>,
    /// Memory that all programs together may use for transfers through usbfs, MB.
    pub(super) usbfs_mb: Option<u64>,
    /// There is a program that decodes the preview of a GoPro.
    pub(super) has_decoder: bool,
}

/// A node of a USB device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Node {
    /// `/dev/video0`
    pub(super) path: PathBuf,
    /// `video4linux` or `tty`
    pub(super) subsystem: &'static str,
    /// The USB device, by its port.
    pub(super) port: String,
    /// Whether the user may read and write it.
    pub(super) is_open_to_us: bool,
    /// Its group, by name or number.
    pub(super) group: String,
    pub(super) mode: u32,
}

/// The user of this process.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct User {
    pub(super) is_root: bool,
    pub(super) groups: Vec<String>,
}

/// The disk of the folder for episodes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Disk {
    /// The folder that was tested.
    pub(super) folder: PathBuf,
    /// Free space, bytes.
    pub(super) free: u64,
    /// Its size, bytes.
    pub(super) size: u64,
    /// Measured write rate, bytes per second; or why it could not be measured.
    pub(super) rate: Result<f64, String>,
}

/// A CAN interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Interface {
    /// `can0`
    pub(super) name: String,
    /// `up`, `down` or `unknown`
    pub(super) state: String,
    /// Bits per second; not in sysfs, see [`query_can`].
    pub(super) bitrate: Option<u32>,
    /// It left the bus after too many errors.
    pub(super) bus_off: bool,
    /// Length of the kernel's transmit queue, frames.
    pub(super) queue: Option<u64>,
    /// The USB device, by its port.
    pub(super) port: Option<String>,
}

/// Reads everything except the disk, whose rate must be measured.
pub(super) fn collect(root: &Path) -> Facts {
    let usb = devices(root);
    let groups = groups(root);
    let (realtime, locked_memory) = limits(root);
    let mut nodes = nodes(root, "video4linux", &usb, &groups);
    nodes.extend(self::nodes(root, "tty", &usb, &groups));
    nodes.sort_by(|a, b| a.path.cmp(&b.path));
    Facts {
        can: interfaces(root, &usb),
        nodes,
        usb,
        user: user(&groups),
        udev_runs: root.join("run/udev/control").exists(),
        rules: fs::read_to_string(root.join("etc/udev/rules.d/99-rapid.rules")).ok(),
        realtime,
        locked_memory,
        shared_memory: space(&root.join("dev/shm")),
        disk: None,
        clock: word(&root.join("sys/devices/system/clocksource/clocksource0/current_clocksource")),
        has_decoder: preview::is_on(std::env::var_os("PATH").as_deref()),
        usbfs_mb: word(&root.join("sys/module/usbcore/parameters/usbfs_memory_mb")).and_then(|mb| mb.parse().ok()),
    }
}

/// The first line of a file, if it is text.
pub(super) fn word(path: &Path) -> Option<String> {
    let text = fs::read(path).ok()?;
    let line = String::from_utf8_lossy(text.get(..4096).unwrap_or(&text)).lines().next()?.trim().to_owned();
    (!line.is_empty()).then_some(line)
}

/// Size and free space of the file system at `path`, bytes.
pub(super) fn space(path: &Path) -> Option<(u64, u64)> {
    let stat = rustix::fs::statvfs(path).ok()?;
    Some((stat.f_blocks.saturating_mul(stat.f_frsize), stat.f_bavail.saturating_mul(stat.f_frsize)))
}

/// Names of the entries of a folder, sorted.
pub(super) fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// The USB device that a node of sysfs belongs to, by its port: the last part of its path that is one.
fn port_of(node: &Path, usb: &[UsbDevice]) -> Option<String> {
    let device = fs::canonicalize(node.join("device")).ok()?;
    let parts: Vec<String> = device.iter().map(|part| part.to_string_lossy().into_owned()).collect();
    parts.into_iter().rev().find(|part| usb.iter().any(|device| device.port == *part))
}

fn nodes(root: &Path, subsystem: &'static str, usb: &[UsbDevice], groups: &BTreeMap<u32, String>) -> Vec<Node> {
    let class = root.join("sys/class").join(subsystem);
    let node = |name: &String| {
        let port = port_of(&class.join(name), usb)?;
        let path = root.join("dev").join(name);
        let found = fs::metadata(&path).ok()?;
        let read_and_write = rustix::fs::Access::READ_OK | rustix::fs::Access::WRITE_OK;
        Some(Node {
            is_open_to_us: rustix::fs::access(&path, read_and_write).is_ok(),
            path: Path::new("/dev").join(name),
            subsystem,
            port,
            group: groups.get(&found.gid()).cloned().unwrap_or_else(|| found.gid().to_string()),
            mode: found.mode() & 0o777,
        })
    };
    names(&class).iter().filter_map(node).collect()
}

/// Names of groups by number.
fn groups(root: &Path) -> BTreeMap<u32, String> {
    let text = fs::read_to_string(root.join("etc/group")).unwrap_or_default();
    let group = |line: &str| {
        let mut parts = line.split(':');
        let name = parts.next()?.to_owned();
        Some((parts.nth(1)?.parse().ok()?, name))
    };
    text.lines().filter_map(group).collect()
}

fn user(names: &BTreeMap<u32, String>) -> User {
    let mut ids: Vec<u32> = rustix::process::getgroups().unwrap_or_default().iter().map(|id| id.as_raw()).collect();
    ids.push(rustix::process::getegid().as_raw());
    let mut groups: Vec<String> = ids.iter().filter_map(|id| names.get(id).cloned()).collect();
    groups.sort();
    groups.dedup();
    User { is_root: rustix::process::geteuid().is_root(), groups }
}

/// Limits of this process, as `/proc/self/limits` lists them: real-time priority, locked memory.
fn limits(root: &Path) -> (Option<u64>, Option<u64>) {
    let text = fs::read_to_string(root.join("proc/self/limits")).unwrap_or_default();
    let soft = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        match line.split_whitespace().next()? {
            "unlimited" => Some(u64::MAX),
            number => number.parse().ok(),
        }
    };
    (soft("Max realtime priority"), soft("Max locked memory"))
}

/// Queries the kernel for properties of CAN interfaces that are not in sysfs.
#[cfg(feature = "motors")]
pub(super) fn query_can(interfaces: &mut [Interface]) {
    for interface in interfaces {
        if let Ok(seen) = netlink::read_interface(&interface.name) {
            (interface.bitrate, interface.bus_off) = (seen.bitrate, seen.bus_off);
        }
    }
}

fn interfaces(root: &Path, usb: &[UsbDevice]) -> Vec<Interface> {
    /// `ARPHRD_CAN` of `linux/if_arp.h`.
    const CAN: &str = "280";
    let class = root.join("sys/class/net");
    let can = |name: &String| {
        let folder = class.join(name);
        (word(&folder.join("type")).as_deref() == Some(CAN)).then(|| Interface {
            name: name.clone(),
            state: word(&folder.join("operstate")).unwrap_or_else(|| "unknown".to_owned()),
            bitrate: None,
            bus_off: false,
            queue: word(&folder.join("tx_queue_len")).and_then(|frames| frames.parse().ok()),
            port: port_of(&folder, usb),
        })
    };
    names(&class).iter().filter_map(can).collect()
}

/// A USB device of `/sys/bus/usb/devices`. Names there: `usb1` is a root hub, `1-2.3` the device in port 3 of the hub
/// in port 2 of bus 1; names with a colon are interfaces.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct UsbDevice {
    /// Its port: `1-2.3`, or `usb1` for a root hub.
    pub(super) port: String,
    pub(super) bus: u32,
    /// Negotiated speed, Mbit/s.
    pub(super) mbit: f64,
    pub(super) vid: u16,
    pub(super) pid: u16,
    pub(super) product: Option<String>,
    pub(super) serial: Option<String>,
    pub(super) is_hub: bool,
    /// The kernel may suspend it while it is unused.
    pub(super) autosuspends: bool,
}

impl UsbDevice {
    /// Whether it is a root hub, that is a bus.
    pub(super) fn is_root(&self) -> bool {
        self.port.starts_with("usb")
    }

    /// Number of hubs above it, without the root hub.
    pub(super) fn depth(&self) -> usize {
        self.port.matches('.').count()
    }

    /// Sort key: bus, then the numbers of its ports.
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
