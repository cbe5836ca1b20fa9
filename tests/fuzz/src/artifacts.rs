//! What follows from a registry, read back by readers that are not ours: rules, descriptors and unit.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::net::{Ipv4Addr, Ipv6Addr};
use std::path::Path;
use std::time::Duration;

use rapid_core::modality::ModalityKind;
use rapid_registry::system_files::{SystemFileKind, system_files};
use rapid_registry::{
    ButtonSpec, CanProtocol, CanSpec, DeviceSpec, Hook, InputSpec, InterlockSpec, LanFind, LanProtocol, LanSpec,
    NodeSpec, ProcessSpec, Registry,
};
use yaml_rust2::{Yaml, YamlLoader};

use crate::rules::{self, Token};

/// All of them.
pub(crate) fn check(registry: &Registry) {
    // A harmless registry whose entries have as much to open: of all that is in a registry only that, and the name of the
    // rig, may change a unit.
    let mut harmless = Registry::builtin();
    harmless.devices = registry.devices.iter().map(harmless_device).collect();
    harmless.stops = registry.stops.iter().map(harmless_stop).collect();
    harmless.buttons = registry.buttons.iter().map(harmless_button).collect();
    harmless.rig.name.clone_from(&registry.rig.name);
    let harmless = system_files(&harmless);
    for file in system_files(registry) {
        let text = &file.contents;
        match file.kind {
            SystemFileKind::Rules => check_rules(registry, text),
            SystemFileKind::Unit => {
                let expected = harmless.iter().find(|other| other.path == file.path).expect("the same units");
                assert_eq!(*text, expected.contents, "{} has more of the registry", file.path.display());
            }
            SystemFileKind::Descriptor => check_descriptor(registry, &file.path, text),
            SystemFileKind::Layout => check_layout(registry, text),
        }
    }
}

/// The layout is JSON, and has the topic of every camera.
fn check_layout(registry: &Registry, text: &str) {
    let layout: serde_json::Value = serde_json::from_str(text).expect("JSON");
    let text = layout["configById"].to_string();
    for device in registry.devices.iter().filter(|device| device.modality().kind == ModalityKind::Image) {
        let topic = serde_json::Value::from(device.topic.as_str()).to_string();
        assert!(text.contains(topic.trim_matches('"')), "{}: not in the layout", device.name);
    }
}

/// A stop that opens the same kind of node as `stop`, and has nothing else in common with it.
fn harmless_stop(stop: &InterlockSpec) -> InterlockSpec {
    let mut harmless = stop.clone();
    "x".clone_into(&mut harmless.name);
    harmless.actuators = Vec::new();
    make_harmless(&mut harmless.input);
    harmless
}

/// A button, likewise.
fn harmless_button(button: &ButtonSpec) -> ButtonSpec {
    let mut harmless = button.clone();
    "x".clone_into(&mut harmless.name);
    make_harmless(&mut harmless.input);
    harmless
}

fn make_harmless(input: &mut InputSpec) {
    match input {
        InputSpec::Key(key) => "x".clone_into(&mut key.device),
        InputSpec::Gpio(gpio) => gpio.chip = "/dev/gpiochip0".into(),
        // Whether it is a port of the board may change the unit.
        InputSpec::Serial(line) if line.path.starts_with("/dev/serial") => line.path = "/dev/serial/x".into(),
        InputSpec::Serial(line) => line.path = "/dev/x".into(),
        InputSpec::Field(field) => "x".clone_into(&mut field.device),
    }
}

/// A device of which the system is asked the same as of `device`, and that has nothing else in common with it.
fn harmless_device(device: &DeviceSpec) -> DeviceSpec {
    let mut harmless = Registry::builtin().devices.swap_remove(0);
    let program = || std::path::PathBuf::from("/usr/bin/true");
    match &device.node {
        NodeSpec::Process(process) => {
            harmless.node = NodeSpec::Process(ProcessSpec {
                program: program(),
                args: Vec::new(),
                opens: process.opens,
                kind: ModalityKind::Bytes,
                shape: Vec::new(),
            });
        }
        // Motors have a guard, and what is read of them is in no unit.
        NodeSpec::Can(_) => harmless.node = device.node.clone(),
        NodeSpec::Lan(lan) => {
            let hosts = [Ipv4Addr::LOCALHOST.into(), Ipv6Addr::LOCALHOST.into()];
            let find = match (&lan.find, lan.find.families()) {
                (LanFind::Mdns { .. }, _) => LanFind::Mdns { service: "_x._tcp".to_owned(), instance: None },
                (_, [_, true]) => LanFind::Adapter { host: Some(hosts[1]) },
                _ => LanFind::Adapter { host: Some(hosts[0]) },
            };
            harmless.node =
                NodeSpec::Lan(LanSpec { protocol: LanProtocol::Udp { port: 1 }, find, lease: Duration::from_secs(3) });
        }
        NodeSpec::Camera(_) | NodeSpec::Serial(_) => {}
    }
    if !device.hooks.is_empty() {
        harmless.hooks.attach = Some(Hook { program: program(), args: Vec::new() });
    }
    harmless
}

/// At most one rule a device, with the keys we know and no others, that matches its serial number
/// and not another.
fn check_rules(registry: &Registry, text: &str) {
    const KEYS: [&str; 6] = ["SUBSYSTEM==", "SYMLINK+=", "GROUP=", "MODE=", "TAG+=", "RUN{builtin}+="];
    // Of the device itself, or of one above it.
    const OF_USB: [&str; 5] = ["ENV{DEVTYPE}==", "ATTR{idVendor}==", "ATTR{idProduct}==", "ATTR{serial}==", "KERNEL=="];
    const OF_OTHERS: [&str; 5] =
        ["ATTR{index}==", "ATTRS{idVendor}==", "ATTRS{idProduct}==", "ATTRS{serial}==", "KERNELS=="];
    let rules = rules::parse(text).unwrap_or_else(|line| panic!("udev cannot read {line:?} in:\n{text}"));
    let mut named = BTreeSet::new();
    for rule in &rules {
        let value = |key: &str| rule.iter().find(|token| token.key == key).map(|token| token.value.as_str());
        if value("RUN").is_some() {
            check_commands(registry, rule);
            continue;
        }
        if value("SUBSYSTEM") == Some("gpio") {
            check_chip(registry, rule);
            continue;
        }
        let Some(link) = value("SYMLINK") else {
            // The streams of a camera have one identity: access, and no name.
            assert_eq!(value("SUBSYSTEM"), Some("video4linux"), "every other rule gives a name");
            assert!(registry.devices.iter().any(|device| registry.shares_unit(device)), "{rule:?}");
            continue;
        };
        assert!(named.insert(link.to_owned()), "two rules for {link}");
        let device = registry.devices.iter().find(|device| format!("rapid/{}", device.name) == link);
        let device = device.unwrap_or_else(|| panic!("a rule for {link}, which is not a device"));
        let (own, serial_key) =
            if value("SUBSYSTEM") == Some("usb") { (OF_USB, "ATTR{serial}") } else { (OF_OTHERS, "ATTRS{serial}") };
        for Token { key, operator, .. } in rule {
            let match_or_set = format!("{key}{operator}");
            let known = KEYS.contains(&match_or_set.as_str()) || own.contains(&match_or_set.as_str());
            assert!(known, "{match_or_set} in a rule");
        }
        let keys: BTreeSet<_> = rule.iter().map(|token| &token.key).collect();
        assert_eq!(keys.len(), rule.len(), "a key twice in {rule:?}");
        assert_eq!(value("RUN{builtin}"), Some("uaccess"));
        let serial = device.identity.serial();
        assert_eq!(value(serial_key).is_some(), serial.is_some());
        if let (Some(pattern), Some(serial)) = (value(serial_key), serial) {
            assert!(rules::matches(pattern, serial), "{pattern:?} does not match {serial:?}");
            for other in
                [format!("{serial}x"), format!("x{serial}"), serial.replace(['*', '?', '['], "x"), String::new()]
            {
                assert!(other == serial || !rules::matches(pattern, &other), "{pattern:?} matches {other:?}");
            }
        }
    }
}

/// The chip of a stop, a button or a brake becomes that of our group, and nothing else happens to it.
fn check_chip(registry: &Registry, rule: &[Token]) {
    let [subsystem, kernel, group, mode] = rule else { panic!("{} words for a chip", rule.len()) };
    let words = |token: &Token| format!("{}{}{}", token.key, token.operator, token.value);
    assert_eq!([subsystem, group, mode].map(words), ["SUBSYSTEM==gpio", "GROUP=gpio", "MODE=0660"]);
    let chip = Path::new("/dev").join(&kernel.value);
    let is_its = |input: &InputSpec| matches!(input, InputSpec::Gpio(gpio) if gpio.chip == chip);
    let has_brake = |device: &DeviceSpec| match &device.node {
        NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(bus), .. }) => {
            bus.motors.iter().filter_map(|motor| motor.brake.as_ref()).any(|brake| brake.chip == chip)
        }
        _ => false,
    };
    let is_ours = registry.inputs().any(|(_, input)| is_its(input)) || registry.devices.iter().any(has_brake);
    assert!(kernel.key == "KERNEL" && is_ours, "a rule for {}", chip.display());
    assert!(kernel.value.bytes().all(|byte| byte.is_ascii_alphanumeric()), "{}", kernel.value);
}

/// A CAN interface is brought up, and nothing else: the words are ours and a number of the registry.
fn check_commands(registry: &Registry, rule: &[Token]) {
    const KEYS: [&str; 8] = [
        "ACTION==",
        "SUBSYSTEM==",
        "ATTR{type}==",
        "ATTRS{idVendor}==",
        "ATTRS{idProduct}==",
        "ATTRS{serial}==",
        "KERNELS==",
        "RUN+=",
    ];
    for Token { key, operator, .. } in rule {
        assert!(KEYS.contains(&format!("{key}{operator}").as_str()), "{key}{operator} in a rule");
    }
    let bitrates = registry.devices.iter().filter_map(|device| {
        let NodeSpec::Can(can) = &device.node else { return None };
        Some(can.bitrate)
    });
    let known: Vec<_> = bitrates
        .map(|bitrate| {
            [
                "/usr/sbin/ip link set dev $name type can restart-ms 100".to_owned(),
                format!("/usr/sbin/ip link set dev $name up type can bitrate {bitrate}"),
            ]
        })
        .collect();
    let commands: Vec<_> = rule.iter().filter(|token| token.key == "RUN").map(|token| &token.value).collect();
    assert!(known.iter().any(|known| commands.iter().copied().eq(known)), "udev would run {commands:?}");
}

/// One document with the keys we know, and the values of the registry.
fn check_descriptor(registry: &Registry, path: &Path, text: &str) {
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    let device = registry.named(&name).expect("a descriptor of a device");
    let documents = YamlLoader::load_from_str(text).unwrap_or_else(|error| panic!("{error} in:\n{text}"));
    let [document] = documents.as_slice() else { panic!("{} documents in:\n{text}", documents.len()) };
    let keys = |yaml: &Yaml| {
        let mut line = String::new();
        for key in yaml.as_hash().expect("a map").keys() {
            let _ = write!(line, "{} ", key.as_str().expect("a text"));
        }
        line
    };
    assert_eq!(keys(document), "module slot sensors bring_up identity path topic bit ");
    if device.identity.usb().is_none() {
        assert_eq!(document["identity"], Yaml::Null, "of a device on the network");
    } else {
        assert_eq!(keys(&document["identity"]), "vid pid serial port ");
    }
    assert_eq!(document["identity"]["serial"].as_str(), device.identity.serial());
    assert_eq!(document["topic"].as_str(), Some(device.topic.as_str()));
    assert_eq!(document["module"].as_str(), Some(device.name.as_str()));
}
