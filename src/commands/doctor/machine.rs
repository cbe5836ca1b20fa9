//! What is judged of the machine itself: udev, limits, clock, memory, disk, buses of their own.
//!
//! Pure.

use super::bandwidth::Wish;
use super::facts::Facts;
use super::judge::{Finding, megabytes};
use super::usb::UsbDevice;
use crate::registry::{DeviceSpec, NodeSpec, Opens, Registry};
use crate::text;

pub(super) fn udev(facts: &Facts, rules: Option<&str>) -> Vec<Finding> {
    const INSTALL: &str = "sudo rapid artifacts --install";
    let mut found = Vec::new();
    if !facts.udev_runs {
        let what = "no udev daemon runs: plugged devices are not seen";
        found.push(Finding::bad("udev", what, "sudo systemctl start systemd-udevd"));
    }
    match (&facts.rules, rules) {
        (_, None) => {}
        (None, Some(_)) => {
            let what = "the udev rules are not installed: no stable names /dev/rapid/NAME";
            found.push(Finding::warn("udev", what, INSTALL));
        }
        (Some(installed), Some(rules)) if installed != rules => {
            found.push(Finding::warn("udev", "the installed udev rules are not those of this registry", INSTALL));
        }
        (Some(_), Some(_)) => found.push(Finding::ok("udev", "the udev rules are those of this registry")),
    }
    found
}

/// CAN interfaces: up, and with a queue that takes a burst.
pub(super) fn can(facts: &Facts, entries: &[DeviceSpec], plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    /// A burst of commands to a whole arm; the kernel's default of 10 loses some of it (ENOBUFS).
    const LEAST_QUEUE: u64 = 64;
    let mut found = Vec::new();
    for interface in &facts.can {
        let entry =
            plugged.iter().find(|(_, device)| Some(&device.port) == interface.port.as_ref()).map(|(entry, _)| entry);
        let bitrate =
            entry.and_then(|entry| if let NodeSpec::Can(can) = &entry.node { Some(can.bitrate) } else { None });
        let name = &interface.name;
        if entry.is_none() && !entries.is_empty() {
            continue;
        }
        if interface.bus_off {
            let what = format!("{name} has left the bus after too many errors");
            let fix = format!("check wiring, termination and bit rate; then sudo ip link set {name} type can restart");
            found.push(Finding::bad("can", what, fix));
        } else if interface.state == "down" {
            let fix = format!("sudo ip link set {name} up type can bitrate {}", bitrate.unwrap_or(1_000_000));
            found.push(Finding::warn(
                "can",
                format!("{name} is down; rapid brings it up only if it is permitted to"),
                fix,
            ));
        } else if let (Some(own), Some(wished)) = (interface.bitrate, bitrate)
            && own != wished
        {
            let what = format!("{name} runs at {own} bit/s, and its entry says {wished}");
            let fix = format!(
                "sudo ip link set {name} down && sudo ip link set {name} up type can bitrate {wished}; or correct the entry"
            );
            found.push(Finding::bad("can", what, fix));
        } else {
            found.push(Finding::ok("can", format!("{name} is up")));
        }
        if let Some(queue) = interface.queue.filter(|queue| *queue < LEAST_QUEUE) {
            let what = format!("{name} queues {queue} frames at most: a burst of commands does not fit");
            found.push(Finding::warn("can", what, format!("sudo ip link set {name} txqueuelen 256")));
        }
    }
    found
}

pub(super) fn limits(facts: &Facts, registry: Option<&Registry>) -> Vec<Finding> {
    /// libusb programs with cameras need more than the kernel's default of 16 MB.
    const USBFS_MB: u64 = 64;
    /// Of the sources that x86 and ARM machines have, those that are read without a trap into the kernel.
    const FAST_CLOCKS: [&str; 4] = ["tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page"];
    let mut found = Vec::new();
    match facts.realtime {
        Some(0) if !facts.user.is_root => {
            let what = "real-time priority is not permitted: under load the mask's beat of 2 ms becomes uneven";
            let fix = "echo \"$USER - rtprio 80\" | sudo tee /etc/security/limits.d/rapid.conf, and log in again";
            found.push(Finding::warn("limits", what, fix));
        }
        Some(_) => found.push(Finding::ok("limits", "real-time priority is permitted")),
        None => {}
    }
    if let Some(locked) = facts.locked_memory {
        let shown = if locked == u64::MAX { "no limit".to_owned() } else { text::size(locked) };
        found.push(Finding::ok("limits", format!("memory that may be locked: {shown}; rapid locks none")));
    }
    if let (Some((size, free)), Some(registry)) = (facts.shared_memory, registry) {
        let wanted = registry.rig.memory_budget;
        let what = format!(
            "/dev/shm has {} free of {}, and memory_budget is {}",
            text::size(free),
            text::size(size),
            text::size(wanted)
        );
        found.push(if free < wanted {
            let size = (wanted + (size - free.min(size))).div_ceil(1 << 20) + 64;
            Finding::bad(
                "memory",
                what,
                format!("sudo mount -o remount,size={size}M /dev/shm; or lower memory_budget under [rig]"),
            )
        } else {
            Finding::ok("memory", what)
        });
    }
    if let Some(clock) = &facts.clock {
        found.push(if FAST_CLOCKS.contains(&clock.as_str()) {
            Finding::ok("clock", format!("the kernel's clock source is {clock}"))
        } else {
            let what = format!("the kernel's clock source is {clock}, slow to read");
            Finding::warn("clock", what, "see `journalctl -k -b | grep -i clocksource` for why it is not tsc")
        });
    }
    let programs = registry.is_some_and(|registry| {
        registry
            .devices
            .iter()
            .any(|entry| matches!(&entry.node, NodeSpec::Process(process) if process.opens == Opens::Usb))
    });
    if let Some(mb) = facts.usbfs_mb.filter(|mb| programs && *mb != 0 && *mb < USBFS_MB) {
        let what = format!("programs that read USB devices themselves share {mb} MB for transfers");
        let fix = "echo 256 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb";
        found.push(Finding::warn("usbfs", what, fix));
    }
    found
}

/// Does the disk take what the devices may send?
pub(super) fn disk(facts: &Facts, registry: Option<&Registry>) -> Vec<Finding> {
    /// Shorter than a session.
    const SHORT: f64 = 1800.0;
    let Some(disk) = &facts.disk else { return Vec::new() };
    let folder = text::plain(&disk.folder.display().to_string()).into_owned();
    let mut found = Vec::new();
    let entries = registry.map(|registry| registry.devices.as_slice()).unwrap_or_default();
    // The sum of none is -0.0.
    let wanted = entries.iter().filter_map(most).fold(0.0, |sum, most| sum + most);
    let unknown = entries.iter().filter(|entry| most(entry).is_none());
    let unknown = unknown.map(|entry| format!("[device.{}]", entry.name)).collect::<Vec<_>>().join(", ");
    match &disk.rate {
        Err(error) => {
            found.push(Finding::bad(
                "disk",
                format!("{folder} cannot be written to: {error}"),
                "choose another folder with --out",
            ));
        }
        Ok(rate) => {
            let (took, wanted_said) = (megabytes(*rate), megabytes(wanted));
            let what = if unknown.is_empty() {
                format!("{folder} took {took}; the devices send at most {wanted_said} (estimated)")
            } else {
                format!("{folder} took {took}; the devices send {wanted_said} (estimated) and what {unknown} may send")
            };
            found.push(if *rate < wanted {
                Finding::warn("disk", what, "record on a faster disk: --out DIR")
            } else {
                Finding::ok("disk", what)
            });
        }
    }
    let usual = (1_u64 << 30).min(disk.size / 20);
    let reserve = registry.and_then(|registry| registry.rig.disk_reserve).unwrap_or(usual);
    let room = disk.free.saturating_sub(reserve);
    let seconds = if wanted > 0.0 { room as f64 / wanted } else { f64::INFINITY };
    let lasts = match seconds.is_finite() {
        true if unknown.is_empty() => format!(", {:.0} min of everything at most", seconds / 60.0),
        true => format!(", {:.0} min without {unknown}", seconds / 60.0),
        false => String::new(),
    };
    let what = format!("{} free besides the reserve of {}{lasts}", text::size(room), text::size(reserve));
    found.push(if room == 0 {
        Finding::bad("disk", what, "remove or move recordings, or choose another folder with --out")
    } else if seconds < SHORT {
        Finding::warn("disk", what, "remove or move recordings, or choose another folder with --out")
    } else {
        Finding::ok("disk", what)
    });
    found
}

/// Bytes a second that a device sends at the most; `None` where only the device, or its program, knows how often it
/// sends.
fn most(entry: &DeviceSpec) -> Option<f64> {
    match &entry.node {
        NodeSpec::Camera(camera) => {
            let wish = Wish { name: String::new(), camera: camera.clone(), max_bytes: entry.max_bytes };
            Some(wish.bytes_per_second())
        }
        NodeSpec::Serial(serial) => Some(f64::from(serial.baud) / 10.0),
        NodeSpec::Can(can) => Some(f64::from(can.bitrate) / 8.0),
        NodeSpec::Lan(lan) => Some(lan.rate()? * entry.max_bytes as f64),
        NodeSpec::Process(_) => None,
    }
}
