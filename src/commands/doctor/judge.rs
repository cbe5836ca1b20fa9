//! From facts about the host to findings, with a fix for each problem.
//!
//! Whether the cameras of one bus fit into its bandwidth: a camera reserves bandwidth for isochronous transfers when it
//! is started; the kernel refuses it if too little is left. The reservation depends on the camera's firmware: it is
//! estimated here by the size of its pictures. For compressed pictures only an upper limit is known.
//!
//! Pure: facts and registry in, findings out.

use std::collections::BTreeMap;
use std::path::PathBuf;

use rapid_core::text;
use rapid_registry::device::{Attachment, DeviceNode, UsbIdentity};
use rapid_registry::{Assigner, DeviceSpec, InputSpec, NodeSpec, Opens, PixelFormat, Registry};

use super::facts::{Facts, Node, UsbDevice};
use super::finding::Finding;
use super::load::{CameraLoad, budget, fitting, taken};
use super::preview;

/// A camera that runs slower than this, Mbit/s, is in the wrong port or on a bad cable.
const SLOWEST: f64 = 480.0;

/// All findings. `rules` are the rules that `rapid artifacts` would write.
pub(super) fn judge(facts: &Facts, registry: Option<&Registry>, rules: Option<&str>) -> Vec<Finding> {
    let entries = registry.map(|registry| registry.devices.as_slice()).unwrap_or_default();
    let plugged = plugged(registry, &facts.usb);
    let mut found = Vec::new();
    found.extend(buses(facts, &plugged));
    found.extend(speeds(&plugged));
    found.extend(serials(&facts.usb, entries));
    found.extend(nodes(facts, entries, &plugged));
    found.extend(inputs(facts, registry));
    found.extend(udev(facts, rules));
    found.extend(suspending(&plugged));
    found.extend(can(facts, entries, &plugged));
    found.extend(limits(facts, registry));
    found.extend(disk(facts, registry));
    found.extend(preview::decoder(facts.has_decoder, entries));
    found
}

/// Entries with the connected USB device that matches, as a rig that starts now would assign them.
pub(super) fn plugged<'a>(
    registry: Option<&'a Registry>,
    usb: &'a [UsbDevice],
) -> Vec<(&'a DeviceSpec, &'a UsbDevice)> {
    let Some(registry) = registry else { return Vec::new() };
    let mut assigner = Assigner::new(registry);
    let mut units: Vec<&UsbDevice> = usb.iter().collect();
    // In the order in which hot-plug reports them at the start.
    units.sort_by(|a, b| a.port.cmp(&b.port));
    for unit in units {
        for mut node in nodes_of(unit) {
            // Which of its nodes has which format is not asked here: the unit is what is looked for.
            node.formats = PixelFormat::WORDS.map(|(word, _)| word.to_owned()).to_vec();
            assigner.attach(&node);
        }
    }
    let matching = |entry: &'a DeviceSpec| {
        // The further streams of a camera are those of its unit.
        let is_of_it = |other: &&DeviceSpec| other.id == entry.id || is_stream_beside(registry, entry, other);
        let mut same = registry.devices.iter().filter(is_of_it);
        let attached = same.find_map(|same| assigner.attached_as(same.id))?;
        Some((entry, usb.iter().find(|unit| unit.port == attached.unit.place())?))
    };
    registry.devices.iter().filter_map(matching).collect()
}

fn is_stream_beside(registry: &Registry, entry: &DeviceSpec, other: &DeviceSpec) -> bool {
    registry.shares_unit(entry) && other.node.opens() == Opens::Video && other.identity == entry.identity
}

/// A node of each kind, whether or not the device has it.
fn nodes_of(unit: &UsbDevice) -> [Attachment; 4] {
    let usb = UsbIdentity {
        vid: unit.vid,
        pid: unit.pid,
        serial: unit.serial.clone(),
        port: unit.port.clone(),
        ..UsbIdentity::default()
    };
    let folder = PathBuf::from("/usb").join(&unit.port);
    let node = |kind: &str, node: fn(PathBuf) -> DeviceNode| {
        let syspath = folder.join(kind);
        Attachment { node: node(syspath.clone()), syspath, unit: usb.clone().into(), driver: None, formats: Vec::new() }
    };
    [
        node("video", DeviceNode::Video),
        node("tty", DeviceNode::Tty),
        node("usb", DeviceNode::Usb),
        node("net", |path| DeviceNode::Net(path.display().to_string())),
    ]
}

/// The subsystem of the node that an entry opens, and its group.
fn subsystem(entry: &DeviceSpec) -> Option<(&'static str, &'static str)> {
    match entry.node.opens() {
        Opens::Video => Some(("video4linux", "video")),
        Opens::Tty => Some(("tty", "dialout")),
        Opens::Usb => Some(("usb", "plugdev")),
        Opens::Net => None,
    }
}

/// A rate as text.
pub(super) fn megabytes(bytes: f64) -> String {
    format!("{:.1} MB/s", bytes / 1e6)
}

/// The cameras of each bus, and whether their bandwidth fits.
fn buses(facts: &Facts, plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let mut found = Vec::new();
    let roots = facts.usb.iter().filter(|device| device.is_root());
    for root in roots {
        // Slower devices have their own finding, and use little bandwidth behind their hub.
        let of_the_bus = |device: &UsbDevice| device.bus == root.bus && device.mbit >= SLOWEST;
        let loads: Vec<CameraLoad> = plugged
            .iter()
            .filter(|(_, device)| of_the_bus(device))
            .filter_map(|(entry, _)| {
                let NodeSpec::Camera(camera) = &entry.node else { return None };
                Some(CameraLoad { name: entry.name.clone(), camera: camera.clone(), max_bytes: entry.max_bytes })
            })
            .collect();
        if !loads.is_empty() {
            found.push(bus(root.bus, root.mbit, &loads));
        }
    }
    found
}

fn bus(bus: u32, mbit: f64, loads: &[CameraLoad]) -> Finding {
    let names = loads.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let estimated = loads.iter().any(CameraLoad::is_estimated);
    let most = if estimated { "at most (estimated from the largest MJPG pictures) " } else { "" };
    let (taken, budget) = (taken(loads, mbit), budget(mbit));
    let what = format!("bus {bus} carries {names}: {most}{} of {}", megabytes(taken), megabytes(budget));
    let lower = fitting(loads, mbit);
    let fix = match &lower {
        Some(lower) if lower.is_empty() => return Finding::ok("bandwidth", what),
        Some(lower) => {
            let lower = lower.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            format!("use {lower}; or plug one of them into a port of another bus")
        }
        None => "plug one of them into a port of another bus".to_owned(),
    };
    // An estimate is an upper limit: it may still fit.
    if estimated { Finding::warn("bandwidth", what, fix) } else { Finding::bad("bandwidth", what, fix) }
}

/// Cameras at a USB speed too slow for pictures.
fn speeds(plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let slow =
        plugged.iter().filter(|(entry, device)| matches!(entry.node, NodeSpec::Camera(_)) && device.mbit < SLOWEST);
    let finding = |(entry, device): &(&DeviceSpec, &UsbDevice)| {
        let what = format!("[device.{}] runs at {} Mbit/s, too slow for pictures", entry.name, device.mbit);
        Finding::bad("speed", what, format!("use another cable, port or hub: it is at port {}", device.port))
    };
    slow.map(finding).collect()
}

/// Units with the same serial number cannot be distinguished by it.
fn serials(usb: &[UsbDevice], entries: &[DeviceSpec]) -> Vec<Finding> {
    let mut found = Vec::new();
    for (at, device) in usb.iter().enumerate().filter(|(_, device)| !device.is_hub) {
        let Some(serial) = &device.serial else { continue };
        let same = |other: &&UsbDevice| {
            (other.vid, other.pid) == (device.vid, device.pid) && other.serial.as_ref() == Some(serial)
        };
        if usb.iter().take(at).any(|other| same(&other)) {
            continue;
        }
        let ports: Vec<&str> = usb.iter().filter(same).map(|device| device.port.as_str()).collect();
        if ports.len() < 2 {
            continue;
        }
        let what = format!(
            "{} units of {:04x}:{:04x} have the serial number {serial:?}, at ports {}",
            ports.len(),
            device.vid,
            device.pid,
            ports.join(", ")
        );
        let entry = entries.iter().find(|entry| {
            let usb = entry.identity.usb();
            usb.is_some_and(|usb| (usb.vid, usb.pid) == (device.vid, device.pid) && usb.serial.as_ref() == Some(serial))
        });
        found.push(match entry {
            Some(entry) => {
                let fix =
                    format!("in [device.{}] write port = {:?} instead of the serial number", entry.name, device.port);
                Finding::bad("serials", what, fix)
            }
            None => Finding::warn("serials", what, "identify them by their ports: rapid register --port"),
        });
    }
    found
}

/// Whether the nodes of connected entries can be opened.
fn nodes(facts: &Facts, entries: &[DeviceSpec], plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let mut found = Vec::new();
    let mut open = 0;
    for (entry, device) in plugged {
        let Some((subsystem, group)) = subsystem(entry).filter(|(subsystem, _)| *subsystem != "usb") else { continue };
        let own: Vec<&Node> =
            facts.nodes.iter().filter(|node| node.port == device.port && node.subsystem == subsystem).collect();
        if own.is_empty() {
            let what =
                format!("[device.{}] is plugged in at port {} and has no {subsystem} node", entry.name, device.port);
            found.push(Finding::bad("nodes", what, "see `journalctl -k -b | tail -50` for the kernel's reason"));
        }
        for node in own {
            if node.is_open_to_us {
                open += 1;
                continue;
            }
            let what = format!(
                "{} of [device.{}] may not be opened: group {}, mode {:03o}",
                node.path.display(),
                entry.name,
                node.group,
                node.mode
            );
            let fix = format!("sudo usermod -aG {group} $USER, and log in again; or sudo rapid artifacts --install");
            found.push(Finding::bad("nodes", what, fix));
        }
    }
    if open > 0 {
        let open = text::counted(open, "node");
        found.push(Finding::ok("nodes", format!("{open} of registered devices may be opened")));
    }
    let missing = entries.iter().filter(|entry| !plugged.iter().any(|(other, _)| other.name == entry.name));
    let missing: Vec<String> = missing
        .filter(|entry| entry.identity.usb().is_some())
        .map(|entry| format!("[device.{}]", entry.name))
        .collect();
    if !missing.is_empty() {
        found.push(Finding::ok("nodes", format!("not plugged in: {}", missing.join(", "))));
    }
    if facts.user.is_root {
        return found;
    }
    let mut wanted: Vec<&str> = entries.iter().filter_map(|entry| Some(subsystem(entry)?.1)).collect();
    wanted.sort_unstable();
    wanted.dedup();
    let lacking: Vec<&str> =
        wanted.into_iter().filter(|group| !facts.user.groups.iter().any(|own| own == group)).collect();
    if !lacking.is_empty() {
        let what = format!(
            "this user is not in the group {}: only a user with a local session may open the devices",
            lacking.join(", ")
        );
        found.push(Finding::warn(
            "groups",
            what,
            format!("sudo usermod -aG {} $USER, and log in again", lacking.join(",")),
        ));
    }
    found
}

/// Whether this user may read what stops and buttons are read from.
fn inputs(facts: &Facts, registry: Option<&Registry>) -> Vec<Finding> {
    let mut lacking: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for (user, input) in registry.filter(|_| !facts.user.is_root).into_iter().flat_map(Registry::inputs) {
        let group = match input {
            InputSpec::Key(_) => "input",
            InputSpec::Gpio(_) => "gpio",
            InputSpec::Serial(_) => "dialout",
            InputSpec::Field(_) => continue,
        };
        if !facts.user.groups.iter().any(|own| own == group) {
            lacking.entry(group).or_default().push(user);
        }
    }
    let finding = |(group, users): (&str, Vec<String>)| {
        let what = format!("this user is not in the group {group}, which reads {}", users.join(", "));
        Finding::warn("groups", what, format!("sudo usermod -aG {group} $USER, and log in again"))
    };
    lacking.into_iter().map(finding).collect()
}

fn suspending(plugged: &[(&DeviceSpec, &UsbDevice)]) -> Vec<Finding> {
    let mut seen = Vec::new();
    let mut found = Vec::new();
    for (entry, device) in plugged.iter().filter(|(_, device)| device.autosuspends) {
        if seen.contains(&&device.port) {
            continue;
        }
        seen.push(&device.port);
        let what =
            format!("[device.{}] may be suspended by the kernel while it is not read, and wakes up late", entry.name);
        let fix = format!("echo on | sudo tee /sys/bus/usb/devices/{}/power/control", device.port);
        found.push(Finding::warn("suspend", what, fix));
    }
    found
}

pub(super) fn udev(facts: &Facts, rules: Option<&str>) -> Vec<Finding> {
    const INSTALL: &str = "sudo rapid artifacts --install";
    let mut found = Vec::new();
    if !facts.udev_runs {
        let what = "no udev daemon runs: plugged devices are not detected";
        found.push(Finding::bad("udev", what, "sudo systemctl start systemd-udevd"));
    }
    match (&facts.rules, rules) {
        (_, None) => {}
        (None, Some(_)) => {
            let what = "the udev rules are not installed: no stable names /dev/rapid/NAME";
            found.push(Finding::warn("udev", what, INSTALL));
        }
        (Some(installed), Some(rules)) if installed != rules => {
            found.push(Finding::warn("udev", "the installed udev rules differ from those of this registry", INSTALL));
        }
        (Some(_), Some(_)) => found.push(Finding::ok("udev", "the udev rules are those of this registry")),
    }
    found
}

/// CAN interfaces: up, and with a queue that holds a burst.
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
        } else if let (Some(own), Some(declared)) = (interface.bitrate, bitrate)
            && own != declared
        {
            let what = format!("{name} runs at {own} bit/s, and its entry declares {declared}");
            let fix = format!(
                "sudo ip link set {name} down && sudo ip link set {name} up type can bitrate {declared}; or correct the entry"
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
    /// Clock sources of x86 and ARM machines that are read without a system call.
    const FAST_CLOCKS: [&str; 4] = ["tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page"];
    let mut found = Vec::new();
    match facts.realtime {
        Some(0) if !facts.user.is_root => {
            let what = "real-time priority is not permitted: under load the mask's period of 2 ms becomes irregular";
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

/// Whether the disk is fast and large enough for the devices.
pub(super) fn disk(facts: &Facts, registry: Option<&Registry>) -> Vec<Finding> {
    /// Shorter than a session.
    const SHORT: f64 = 1800.0;
    let Some(disk) = &facts.disk else { return Vec::new() };
    let folder = text::plain(&disk.folder.display().to_string()).into_owned();
    let mut found = Vec::new();
    let entries = registry.map(|registry| registry.devices.as_slice()).unwrap_or_default();
    // `sum` of no terms is -0.0.
    let most = |entry: &DeviceSpec| entry.node.bytes_per_second(entry.max_bytes);
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
            let (took, needed) = (megabytes(*rate), megabytes(wanted));
            let what = if unknown.is_empty() {
                format!("{folder} took {took}; the devices send at most {needed} (estimated)")
            } else {
                format!("{folder} took {took}; the devices send {needed} (estimated) and what {unknown} may send")
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
