//! The doctor on simulated machines, and its judgement on facts.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use insta::assert_snapshot;
use rapid_registry::BUILTIN;

use super::facts::{Interface, Node, User, collect};
use super::*;

/// A machine's /sys, /proc, /etc and /dev below a folder.
struct Tree(tempfile::TempDir);

impl Tree {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn root(&self) -> &Path {
        self.0.path()
    }

    fn write(&self, path: impl AsRef<Path>, text: &str) {
        let path = self.root().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    /// A USB device; `serial` and `product` may be anything.
    fn usb(&self, port: &str, (vid, pid): (&str, &str), mbit: &str, serial: Option<&str>, product: &str) {
        let bus = port.trim_start_matches("usb").split('-').next().unwrap();
        let folder = PathBuf::from("sys/bus/usb/devices").join(port);
        let class = if product.contains("Hub") || port.starts_with("usb") { "09" } else { "ef" };
        for (file, text) in [
            ("busnum", bus),
            ("speed", mbit),
            ("idVendor", vid),
            ("idProduct", pid),
            ("bDeviceClass", class),
            ("product", product),
        ] {
            self.write(folder.join(file), &format!("{text}\n"));
        }
        if let Some(serial) = serial {
            self.write(folder.join("serial"), serial);
        }
        self.write(folder.join("power/control"), "on\n");
    }

    /// A node of the interface of a USB device.
    fn node(&self, subsystem: &str, name: &str, port: &str) {
        let interface = format!("sys/bus/usb/devices/{port}/{port}:1.0");
        let own = format!("{interface}/{subsystem}/{name}");
        self.write(format!("{own}/dev"), "81:0\n");
        symlink(self.root().join(&interface), self.root().join(&own).join("device")).unwrap();
        fs::create_dir_all(self.root().join("sys/class").join(subsystem)).unwrap();
        symlink(self.root().join(&own), self.root().join("sys/class").join(subsystem).join(name)).unwrap();
        self.write(format!("dev/{name}"), "");
    }
}

/// The rig of the repository on one bus, with an unknown device and a duplicate.
fn machine() -> Tree {
    let tree = Tree::new();
    tree.usb("usb1", ("1d6b", "0002"), "480", None, "xHCI Host Controller");
    tree.usb("1-1", ("05e3", "0608"), "480", None, "USB2.0 Hub");
    tree.usb("1-1.2", ("046d", "0825"), "480", Some("CAM00A1"), "Webcam\u{1b}[2J C270");
    tree.usb("1-1.10", ("2bc5", "0501"), "12", Some("TAC00B1"), "Tactile");
    tree.usb("1-2", ("2e8a", "000a"), "12", Some("MOT00C1"), "Pico");
    tree.usb("1-3", ("2e8a", "000a"), "12", Some("MOT00C1"), "Pico");
    tree.usb("usb2", ("1d6b", "0003"), "5000", None, "xHCI Host Controller");
    tree.write("sys/bus/usb/devices/1-1.2/power/control", "auto\n");
    tree.write("sys/bus/usb/devices/1-1.2:1.0/x", "");
    // A device that disappears while it is read.
    tree.write("sys/bus/usb/devices/1-4/idVendor", "1234\n");
    tree.node("video4linux", "video0", "1-1.2");
    tree.node("tty", "ttyACM0", "1-2");
    tree.write("sys/class/tty/tty0/dev", "4:0\n");
    tree.write("sys/class/net/can0/type", "280\n");
    tree.write("sys/class/net/can0/operstate", "down\n");
    tree.write("sys/class/net/eth0/type", "1\n");
    tree.write("etc/udev/rules.d/99-rapid.rules", "# old\n");
    tree.write("run/udev/control", "");
    tree.write(
        "proc/self/limits",
        "Limit                     Soft Limit           Hard Limit           Units     \n\
         Max locked memory         8388608              8388608              bytes     \n\
         Max realtime priority     0                    0                    \n",
    );
    tree.write("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet\n");
    tree.write("sys/module/usbcore/parameters/usbfs_memory_mb", "16\n");
    tree
}

/// Sets the facts that a test machine cannot simulate.
fn settled(mut facts: Facts) -> Facts {
    facts.user = User { is_root: false, groups: vec!["dialout".into()] };
    facts.shared_memory = Some((8 << 30, 256 << 20));
    facts.disk = Some(Disk { folder: "/data/episodes".into(), free: 20 << 30, size: 100 << 30, rate: Ok(18e6) });
    for node in &mut facts.nodes {
        node.group = "video".into();
        node.mode = 0o660;
        node.is_open_to_us = node.subsystem == "tty";
    }
    facts
}

fn reported(facts: &Facts, registry: Result<&Registry, &str>, format: Format) -> (String, bool) {
    let mut out = Vec::new();
    let well = report(facts, registry, format, &mut out).unwrap();
    (String::from_utf8(out).unwrap(), well)
}

#[test]
fn the_report_on_a_machine_with_everything_wrong() {
    let tree = machine();
    let facts = settled(collect(tree.root()));
    let registry = Registry::builtin();
    let (text, well) = reported(&facts, Ok(&registry), Format::Text);
    assert!(!well);
    assert_snapshot!(text);
    let (json, _) = reported(&facts, Ok(&registry), Format::Json);
    assert!(!json.contains('\u{1b}'));
    let lines: Vec<serde_json::Value> = json.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.iter().filter(|line| line["event"] == "usb").count(), 7);
    assert!(lines.iter().any(|line| line["level"] == "bad" && line["about"] == "memory" && line["fix"].is_string()));
}

#[test]
fn a_machine_without_any_device_is_reported() {
    let tree = Tree::new();
    let facts = collect(tree.root());
    assert_eq!((facts.usb.len(), facts.nodes.len(), facts.can.len()), (0, 0, 0));
    let (text, well) = reported(&facts, Err("no devices.toml"), Format::Text);
    assert!(!well);
    assert!(text.contains("no USB bus") && text.contains("BAD   registry   no devices.toml"), "{text}");
}

#[test]
fn malformed_files_are_read_as_far_as_they_are_valid() {
    let tree = Tree::new();
    tree.usb("1-1", ("zzzz", "0825"), "480", None, "x");
    tree.usb("1-2", ("046d", "0825"), "NaN", None, "x");
    tree.usb("1-3", ("046d", "0825"), "480", Some(&"s".repeat(100_000)), "\u{202e}x");
    tree.usb("99999999999-1", ("046d", "0825"), "480", None, "x");
    fs::write(tree.root().join("sys/bus/usb/devices/1-3/product"), [0xff, 0xfe, b'\n']).unwrap();
    let facts = collect(tree.root());
    assert_eq!(facts.usb.iter().map(|device| device.port.as_str()).collect::<Vec<_>>(), ["1-3"]);
    let (text, _) = reported(&facts, Err("none"), Format::Text);
    assert!(text.lines().all(|line| line.len() < 400), "{text}");
}

/// A machine without problems.
fn well() -> (Registry, Facts) {
    let registry = Registry::parse(BUILTIN, None).unwrap().registry;
    let usb = |port: &str, mbit, ids: (u16, u16), serial: &str| UsbDevice {
        port: port.into(),
        bus: 1,
        mbit,
        vid: ids.0,
        pid: ids.1,
        serial: (!serial.is_empty()).then(|| serial.to_owned()),
        ..UsbDevice::default()
    };
    let node = |path: &str, subsystem, port: &str| Node {
        path: path.into(),
        subsystem,
        port: port.into(),
        is_open_to_us: true,
        group: "video".into(),
        mode: 0o660,
    };
    let rules = artifacts(&registry).swap_remove(0).contents;
    let facts = Facts {
        usb: vec![
            usb("usb1", 480.0, (0x1d6b, 2), ""),
            usb("1-1", 480.0, (0x046d, 0x0825), "CAM00A1"),
            usb("1-2", 480.0, (0x2bc5, 0x0501), "TAC00B1"),
            usb("1-3", 12.0, (0x2e8a, 0x000a), "MOT00C1"),
        ],
        nodes: vec![
            node("/dev/video0", "video4linux", "1-1"),
            node("/dev/video2", "video4linux", "1-2"),
            node("/dev/ttyACM0", "tty", "1-3"),
        ],
        user: User { is_root: false, groups: vec!["dialout".into(), "video".into()] },
        udev_runs: true,
        rules: Some(rules),
        realtime: Some(80),
        locked_memory: Some(u64::MAX),
        shared_memory: Some((8 << 30, 8 << 30)),
        disk: Some(Disk { folder: "/data".into(), free: 1 << 40, size: 1 << 41, rate: Ok(500e6) }),
        clock: Some("tsc".into()),
        can: Vec::new(),
        usbfs_mb: Some(16),
        has_decoder: true,
    };
    (registry, facts)
}

/// The problems: levels and subjects.
fn wrong(facts: &Facts, registry: &Registry) -> Vec<String> {
    let rules = artifacts(registry).swap_remove(0).contents;
    judge::judge(facts, Some(registry), Some(&rules))
        .iter()
        .filter(|finding| finding.level != Level::Ok)
        .map(|finding| {
            assert!(finding.fix.as_ref().is_some_and(|fix| !fix.is_empty()), "{finding:?}");
            format!("{:?} {}: {}", finding.level, finding.about, finding.what)
        })
        .collect()
}

fn can(state: &str) -> Interface {
    let (name, state) = ("can0".to_owned(), state.to_owned());
    Interface { name, state, bitrate: Some(500_000), bus_off: false, queue: None, port: None }
}

type Change = fn(&mut Facts);

#[test]
fn one_problem_is_one_finding() {
    let (registry, facts) = well();
    assert_eq!(wrong(&facts, &registry), Vec::<String>::new());
    let cases: [(Change, &str); 20] = [
        (|facts| facts.usb[1].mbit = 12.0, "Bad speed: [device.cam_wrist] runs at 12 Mbit/s"),
        (|facts| facts.usb[2].autosuspends = true, "Warn suspend: [device.tactile_tip]"),
        (
            |facts| {
                let twin = UsbDevice { port: "1-4".into(), ..facts.usb[3].clone() };
                facts.usb.push(twin);
            },
            "Bad serials: 2 units of 2e8a:000a have the serial number \"MOT00C1\", at ports 1-3, 1-4",
        ),
        (
            |facts| {
                let stranger = UsbDevice { vid: 1, ..facts.usb[3].clone() };
                facts.usb.push(UsbDevice { port: "1-5".into(), ..stranger.clone() });
                facts.usb.push(UsbDevice { port: "1-6".into(), ..stranger });
            },
            "Warn serials: 2 units of 0001:000a",
        ),
        (
            |facts| drop(facts.nodes.remove(0)),
            "Bad nodes: [device.cam_wrist] is plugged in at port 1-1 and has no video4linux",
        ),
        (
            |facts| facts.nodes[2].is_open_to_us = false,
            "Bad nodes: /dev/ttyACM0 of [device.motor_state] may not be opened",
        ),
        (|facts| facts.user.groups.clear(), "Warn groups: this user is not in the group dialout, video"),
        (|facts| facts.udev_runs = false, "Bad udev: no udev daemon"),
        (|facts| facts.rules = None, "Warn udev: the udev rules are not installed"),
        (|facts| facts.rules = Some("# other".into()), "Warn udev: the installed udev rules differ from those"),
        (|facts| facts.realtime = Some(0), "Warn limits: real-time priority is not permitted"),
        (|facts| facts.shared_memory = Some((64 << 20, 64 << 20)), "Bad memory: /dev/shm has 67.1 MB free"),
        (|facts| facts.clock = Some("acpi_pm".into()), "Warn clock: the kernel's clock source is acpi_pm"),
        (|facts| facts.disk.as_mut().unwrap().rate = Ok(1e6), "Warn disk: /data took 1.0 MB/s"),
        (
            |facts| facts.disk.as_mut().unwrap().rate = Err("read-only".into()),
            "Bad disk: /data cannot be written to: read-only",
        ),
        (|facts| facts.disk.as_mut().unwrap().free = 10 << 30, "Warn disk: 9.7 GB free besides the reserve"),
        (|facts| facts.disk.as_mut().unwrap().free = 1 << 29, "Bad disk: 0 B free"),
        (
            |facts| {
                let port = Some("1-3".into());
                facts.can.push(Interface { queue: Some(1000), port, ..can("down") });
            },
            "Warn can: can0 is down",
        ),
        (
            |facts| {
                let port = Some("1-3".into());
                facts.can.push(Interface { queue: Some(10), port, ..can("up") });
            },
            "Warn can: can0 queues 10 frames",
        ),
        (
            |facts| {
                let port = Some("1-3".into());
                facts.can.push(Interface { bus_off: true, port, ..can("up") });
            },
            "Bad can: can0 has left the bus",
        ),
    ];
    for (change, expected) in cases {
        let mut changed = facts.clone();
        change(&mut changed);
        let found: Vec<String> =
            wrong(&changed, &registry).into_iter().filter(|found| !found.starts_with("Warn bandwidth")).collect();
        assert_eq!(found.len(), 1, "{expected}: {found:?}");
        assert!(found[0].starts_with(expected), "{found:?} for {expected:?}");
    }
    let buttons = "[stop.pedal]\nkind = \"enabling\"\nkey = { device = \"a pedal\", code = \"KEY_B\" }\n\
                   [button.pedal]\nkey = { device = \"a pedal\", code = \"KEY_A\" }\npress = \"toggle\"\n\
                   [button.go]\nserial = { path = \"/dev/ttyUSB7\", line = \"go\" }\npress = \"start\"\n";
    let buttons = Registry::parse(&format!("{}{buttons}", registry.text), None).unwrap().registry;
    let rules = artifacts(&buttons).swap_remove(0).contents;
    let found = wrong(&Facts { rules: Some(rules), ..facts.clone() }, &buttons);
    let expected = "Warn groups: this user is not in the group input, which reads stop pedal, button pedal";
    assert!(found.iter().any(|found| found == expected), "{found:?}");
    assert!(!found.iter().any(|found| found.contains("button go")), "{found:?}");
    let root = User { is_root: true, groups: Vec::new() };
    assert_eq!(wrong(&Facts { user: root, realtime: Some(0), ..facts }, &registry), Vec::<String>::new());
}

#[test]
fn a_preview_without_its_decoder_is_reported() {
    let (_, facts) = well();
    let entry =
        "[device.gopro]\nnode = \"lan\"\nbit = 5\n[device.gopro.lan]\nprotocol = \"gopro\"\nhost = \"127.0.0.1\"\n";
    let without = Registry::parse(&[BUILTIN, entry].concat(), None).unwrap().registry;
    let with = Registry::parse(&[BUILTIN, entry, "stream = \"preview\"\n"].concat(), None).unwrap().registry;
    let lacking = Facts { has_decoder: false, ..facts.clone() };
    let about = |facts: &Facts, registry: &Registry| {
        let rules = artifacts(registry).swap_remove(0).contents;
        let facts = Facts { rules: Some(rules), ..facts.clone() };
        wrong(&facts, registry)
    };
    assert_eq!(about(&lacking, &without), about(&facts, &without));
    assert_eq!(about(&facts, &with), about(&facts, &without));
    let found = about(&lacking, &with);
    let wanted =
        "Warn preview: the preview of [device.gopro] needs ffmpeg, which is not on PATH: only clips are recorded";
    assert!(found.iter().any(|finding| finding == wanted), "{found:?}");
    // In any folder of the path, and only as a file.
    let folder = tempfile::tempdir().unwrap();
    let path = std::env::join_paths([std::path::Path::new("/nowhere"), folder.path()]).unwrap();
    assert!(!preview::is_on(Some(&path)) && !preview::is_on(None));
    std::fs::create_dir(folder.path().join("ffmpeg")).unwrap();
    assert!(!preview::is_on(Some(&path)));
    std::fs::remove_dir(folder.path().join("ffmpeg")).unwrap();
    std::fs::write(folder.path().join("ffmpeg"), "").unwrap();
    assert!(preview::is_on(Some(&path)));
}

#[test]
fn an_exact_unit_is_not_assigned_to_an_entry_that_matches_any() {
    let entry = |name: &str, bit: u8, more: &str| {
        format!("[device.{name}]\nvid = \"1\"\npid = \"2\"\nnode = \"camera\"\nbit = {bit}\n{more}\n")
    };
    let text = entry("any", 0, "") + &entry("exact", 1, "serial = \"S1\"");
    let registry = Registry::parse(&text, None).unwrap().registry;
    let unit = |port: &str, serial: Option<&str>| UsbDevice {
        port: port.into(),
        vid: 1,
        pid: 2,
        serial: serial.map(str::to_owned),
        ..UsbDevice::default()
    };
    let usb = [unit("1-1", Some("S1")), unit("1-2", Some("S2"))];
    let plugged = judge::plugged(Some(&registry), &usb);
    let plugged: Vec<_> = plugged.iter().map(|(entry, unit)| (entry.name.as_str(), unit.port.as_str())).collect();
    assert_eq!(plugged, [("any", "1-2"), ("exact", "1-1")]);
}

#[test]
fn a_can_adapter_on_a_serial_line_is_checked_as_one() {
    let text =
        "[device.arm]\nvid = \"1\"\npid = \"2\"\nnode = \"can\"\nbit = 0\n[device.arm.can]\nadapter = \"slcan\"\n";
    let registry = Registry::parse(text, None).unwrap().registry;
    let usb = UsbDevice { port: "1-1".into(), bus: 1, mbit: 12.0, vid: 1, pid: 2, ..UsbDevice::default() };
    let node = Node {
        path: "/dev/ttyACM0".into(),
        subsystem: "tty",
        port: "1-1".into(),
        is_open_to_us: false,
        group: "dialout".into(),
        mode: 0o660,
    };
    let facts = Facts { usb: vec![usb], nodes: vec![node], ..Facts::default() };
    let found: Vec<String> =
        judge::judge(&facts, Some(&registry), None).into_iter().map(|finding| finding.what).collect();
    assert!(found.iter().any(|what| what.starts_with("/dev/ttyACM0 of [device.arm] may not be opened")), "{found:?}");
    assert!(found.iter().any(|what| what.contains("not in the group dialout")), "{found:?}");
}

#[test]
fn a_rate_that_only_the_device_knows_is_not_reported_as_the_maximum() {
    let camera = "[device.cam]\nnode = \"lan\"\nbit = 0\nmax_bytes = \"100KiB\"\n[device.cam.lan]\nprotocol = \"mjpeg\"\nhost = \"192.0.2.1\"\nfps = 10\n";
    let lidar = "[device.lidar]\nnode = \"lan\"\nbit = 1\n[device.lidar.lan]\nprotocol = \"udp\"\nhost = \"192.0.2.2\"\nport = 2368\n";
    let disk = Some(Disk { folder: "/data".into(), free: 10 << 30, size: 20 << 30, rate: Ok(500e6) });
    let facts = Facts { disk, ..Facts::default() };
    let disk_findings = |text: &str| -> Vec<String> {
        let registry = Registry::parse(text, None).unwrap().registry;
        let found = judge::judge(&facts, Some(&registry), None).into_iter();
        found.filter(|finding| finding.about == "disk").map(|finding| finding.what).collect()
    };
    let none = judge::judge(&facts, None, None).into_iter().find(|finding| finding.about == "disk").unwrap();
    assert!(none.what.contains("at most 0.0 MB/s"), "{}", none.what);
    let known = disk_findings(camera);
    assert_eq!(known[0], "/data took 500.0 MB/s; the devices send at most 1.0 MB/s (estimated)");
    assert!(known[1].ends_with("min of everything at most"), "{known:?}");
    let unknown = disk_findings(&format!("{camera}{lidar}"));
    assert_eq!(
        unknown[0],
        "/data took 500.0 MB/s; the devices send 1.0 MB/s (estimated) and what [device.lidar] may send"
    );
    assert!(unknown[1].ends_with("min without [device.lidar]"), "{unknown:?}");
}

#[test]
fn cameras_over_the_bandwidth_get_a_suggested_format() {
    let entry = |at: usize| {
        format!(
            "[device.cam{at}]\nvid = \"1\"\npid = \"2\"\nport = \"1-{at}\"\nnode = \"camera\"\nbit = {at}\n[device.cam{at}.camera]\nformat = \"YUYV\"\n"
        )
    };
    let text: String = (1..4).map(entry).collect();
    let registry = Registry::parse(&text, None).unwrap().registry;
    let camera = |at: usize, bus: u32| UsbDevice {
        port: format!("1-{at}"),
        bus,
        mbit: 480.0,
        vid: 1,
        pid: 2,
        ..UsbDevice::default()
    };
    let root = |bus: u32| UsbDevice { port: format!("usb{bus}"), bus, mbit: 480.0, ..UsbDevice::default() };
    let judged = |usb: Vec<UsbDevice>| -> Vec<String> {
        let facts =
            Facts { usb, udev_runs: true, user: User { is_root: true, groups: Vec::new() }, ..Facts::default() };
        let found = judge::judge(&facts, Some(&registry), None);
        let found = found.into_iter().filter(|finding| finding.about == "bandwidth");
        found
            .map(|finding| format!("{:?} {} {}", finding.level, finding.what, finding.fix.unwrap_or_default()))
            .collect()
    };
    let together = judged(vec![root(1), camera(1, 1), camera(2, 1), camera(3, 1)]);
    assert_eq!(together.len(), 1);
    assert!(together[0].starts_with("Bad bus 1 carries [device.cam1] 640x480@30 YUYV, "), "{together:?}");
    assert!(together[0].contains("55.3 MB/s of 46.3 MB/s"), "{together:?}");
    assert!(together[0].contains("use [device.cam1] 640x480@25 YUYV, [device.cam2] 640x480@25"), "{together:?}");
    let apart = judged(vec![root(1), camera(1, 1), camera(2, 1), root(2), camera(3, 2)]);
    assert!(apart.len() == 2 && apart.iter().all(|found| found.starts_with("Ok")), "{apart:?}");
}

#[test]
fn the_disk_is_tested_and_no_file_is_left_behind() {
    let folder = tempfile::tempdir().unwrap();
    let disk = disk(&folder.path().join("episodes/that/are/not/there")).unwrap();
    assert_eq!(disk.folder, folder.path());
    assert!(disk.rate.is_ok_and(|rate| rate > 0.0));
    assert!(disk.size >= disk.free && disk.size > 0);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn a_bus_at_another_bitrate_than_configured_is_bad() {
    let text = "[device.arm]\nvid = \"1\"\npid = \"2\"\nnode = \"can\"\nbit = 0\n[device.arm.can]\nbitrate = 1000000\n";
    let registry = Registry::parse(text, None).unwrap().registry;
    let usb = UsbDevice { port: "1-1".into(), bus: 1, mbit: 12.0, vid: 1, pid: 2, ..UsbDevice::default() };
    for (bitrate, state, expected) in [
        (Some(1_000_000), "up", "Ok: can0 is up"),
        (None, "up", "Ok: can0 is up"),
        (Some(500_000), "up", "Bad: can0 runs at 500000 bit/s, and its entry declares 1000000"),
        (Some(500_000), "down", "Warn: can0 is down"),
    ] {
        let interface = Interface { bitrate, port: Some("1-1".into()), ..can(state) };
        let facts = Facts { usb: vec![usb.clone()], can: vec![interface], ..Facts::default() };
        let found = judge::judge(&facts, Some(&registry), None);
        let found = found.iter().find(|finding| finding.about == "can").unwrap();
        let finding = format!("{:?}: {}", found.level, found.what);
        assert!(finding.starts_with(expected), "{finding}");
    }
}
