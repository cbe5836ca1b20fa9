//! What each reader promises of any bytes.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid::commands;
use rapid::control::can::CanFrame;
use rapid::driver;
use rapid::headless::style::Palette;
use rapid::mask::{MaskRecord, RECORD_LEN};
use rapid::modality::ModalityKind;
use rapid::record::inspect as inspection;
use rapid::record::recover::recover_bytes;
use rapid::registry::artifacts::{ArtifactKind, artifacts};
use rapid::registry::scenario::Scenario;
use rapid::registry::units::{parse_duration, parse_size, show_duration, show_size};
use rapid::registry::{
    Assigner, Assignment, Attachment, CanAdapter, DeviceNode, DeviceSpec, Framing, NodeSpec, Opens, Parse, ProcessSpec,
    Registry, RegistryErrors, SerialSpec, Unit, UsbIdentity,
};
use rapid::text as shown;
use yaml_rust2::{Yaml, YamlLoader};

use crate::rules::{self, Token};

/// Longest input worth reading: beyond it a mutation only makes a case slower.
const LONGEST: usize = 64 << 10;

/// A registry: errors are harmless to a terminal and lie within the text; what follows from a good
/// one is well formed.
pub fn registry(bytes: &[u8]) {
    let Some(text) = text_of(bytes) else { return };
    match Registry::parse(text, None) {
        Ok(loaded) => {
            for warning in &loaded.warnings {
                harmless(&warning.to_string());
            }
            check_artifacts(&loaded.registry);
        }
        Err(errors) => check_errors(&errors, text),
    }
}

/// A scenario, against the registry of the repository.
pub fn scenario(bytes: &[u8]) {
    let Some(text) = text_of(bytes) else { return };
    let registry = Registry::builtin();
    match Scenario::parse(text, None, &registry) {
        Ok(scenario) => {
            let ports: BTreeSet<_> = scenario.devices.iter().map(|device| &device.usb.port).collect();
            assert_eq!(ports.len(), scenario.devices.len(), "two devices in one port");
            let times: Vec<Duration> = scenario.events.iter().map(|event| event.at).collect();
            assert!(times.is_sorted());
        }
        Err(errors) => check_errors(&errors, text),
    }
}

/// Durations and sizes: what is read can be shown and read again.
pub fn units(bytes: &[u8]) {
    let Some(text) = text_of(bytes) else { return };
    if let Some(duration) = parse_duration(text) {
        let again = parse_duration(&show_duration(duration)).expect("what is shown can be read");
        // Read as a floating-point number of 53 bits.
        let slack = Duration::from_nanos(u64::try_from(duration.as_nanos() >> 50).unwrap_or(u64::MAX));
        assert!(again.abs_diff(duration) <= slack, "{duration:?} {again:?}");
    }
    if let Some(size) = parse_size(text) {
        assert!(parse_size(&show_size(size)).is_some(), "{size}");
    }
}

/// A serial line: the messages depend on the bytes alone, not on how they were cut into reads, and
/// no message is longer than permitted.
pub fn serial(bytes: &[u8]) {
    let [kind, parse, channels, cut, stream @ ..] = bytes else { return };
    let channels = usize::from(*channels) % 16 + 1;
    let framing = match kind % 4 {
        0 => Framing::Line,
        1 => Framing::Cobs,
        _ => Framing::Fixed(channels * 4),
    };
    let parse = match parse % 4 {
        0 => Parse::Csv,
        1 => Parse::Json,
        2 => Parse::F32le,
        _ => Parse::Raw,
    };
    let spec = SerialSpec { baud: 115_200, framing, parse, channels };
    let most = 256;
    let whole = driver::serial::decode(&spec, most, [stream]);
    let pieces = driver::serial::decode(&spec, most, stream.chunks(usize::from(*cut) % 7 + 1));
    assert_eq!(whole, pieces, "the messages depend on how the bytes were cut");
    for payload in &whole.0 {
        let permitted = match (parse, framing) {
            (Parse::Raw, Framing::Fixed(length)) => payload.len() == length,
            (Parse::Raw, Framing::Line) => payload.len() <= most + 1,
            (Parse::Raw, Framing::Cobs) => payload.len() <= most + most / 254 + 1,
            _ => payload.len() == channels * 8,
        };
        assert!(permitted, "{} bytes of {spec:?}", payload.len());
    }
}

/// A CAN adapter that speaks slcan: what it says depends on the bytes alone, and a frame that is sent
/// again comes back as it was.
pub fn slcan(bytes: &[u8]) {
    use driver::can::slcan::{Decoder, Event, encode};
    let Some((cut, stream)) = short(bytes).and_then(<[u8]>::split_first) else { return };
    let decode = |pieces: &mut dyn Iterator<Item = &[u8]>| {
        let (mut decoder, mut events) = (Decoder::default(), Vec::new());
        for mut piece in pieces {
            while !piece.is_empty() {
                let (taken, event) = decoder.feed(piece);
                piece = &piece[taken..];
                events.extend(event);
            }
        }
        events
    };
    let whole = decode(&mut std::iter::once(stream));
    assert_eq!(whole, decode(&mut stream.chunks(usize::from(*cut) % 7 + 1)), "how the bytes were cut");
    for event in &whole {
        let Event::Frame(frame, _) = event else { continue };
        legal_frame(frame);
        assert_eq!(decode(&mut std::iter::once(encode(frame).bytes())), [Event::Frame(*frame, None)]);
    }
}

/// Damiao's CAN adapter: what it says depends on the bytes alone, and every byte of it is of a message or
/// was passed over.
pub fn damiao_serial(bytes: &[u8]) {
    use driver::can::damiao_serial::{Decoder, Kind, RECEIVED, encode};
    let Some((cut, stream)) = short(bytes).and_then(<[u8]>::split_first) else { return };
    let decode = |pieces: &mut dyn Iterator<Item = &[u8]>| {
        let (mut decoder, mut messages) = (Decoder::default(), Vec::new());
        for mut piece in pieces {
            while !piece.is_empty() {
                let (taken, message) = decoder.feed(piece);
                piece = &piece[taken..];
                messages.extend(message);
            }
        }
        (messages, decoder.skipped())
    };
    let whole = decode(&mut std::iter::once(stream));
    assert_eq!(whole, decode(&mut stream.chunks(usize::from(*cut) % 7 + 1)), "how the bytes were cut");
    let used = whole.0.len() * RECEIVED + usize::try_from(whole.1).expect("a count of bytes");
    assert!((stream.len().saturating_sub(RECEIVED)..=stream.len()).contains(&used), "{used} of {}", stream.len());
    for message in whole.0.iter().filter(|message| message.kind == Kind::Received) {
        legal_frame(&message.frame);
        assert!(encode(&message.frame).is_some());
    }
}

fn legal_frame(frame: &CanFrame) {
    assert!(frame.len <= 8 && frame.id <= if frame.extended { 0x1fff_ffff } else { 0x7ff }, "{frame:?}");
    assert!(!frame.error && frame.data[usize::from(frame.len)..].iter().all(|byte| *byte == 0), "{frame:?}");
}

/// One recorded message, of each schema.
pub fn message(bytes: &[u8]) {
    for schema in ["foxglove.CompressedImage", "foxglove.RawImage", "rapid.Scalars", "rapid.Bytes"] {
        if let Some((payload, width, _)) = driver::replay::decode(schema, bytes) {
            // Padding of rows is taken away; nothing is added.
            assert!(payload.len() <= bytes.len(), "{schema} grew");
            assert!(schema != "rapid.Scalars" || payload.len() == width as usize * 8);
        }
    }
}

/// A file as `rapid inspect` reads it: whatever it holds, a report that is harmless to a terminal.
pub fn inspect(bytes: &[u8]) {
    let Some(report) = short(bytes).and_then(inspection::inspect_bytes) else { return };
    harmless(&inspection::render(&report, 100, inspection::Paint::Plain));
    harmless(&shown::json(&report).expect("a report has a form in JSON"));
    assert!(report.unread_bytes <= report.bytes);
    assert!(report.seconds.is_finite() && report.seconds >= 0.0, "{} s", report.seconds);
}

/// A file as `rapid recover` reads it: what is made of it needs no second repair.
pub fn recover(bytes: &[u8]) {
    let Some(whole) = short(bytes).and_then(recover_bytes) else { return };
    let report = inspection::inspect_bytes(&whole).expect("a repaired file is an MCAP file");
    assert_eq!((report.end, report.damaged_chunks, report.unread_bytes), (inspection::FileEnd::Finished, 0, 0));
}

/// A file as `rapid replay` reads it. It reads files, so one is written.
pub fn replay(bytes: &[u8]) {
    thread_local! {
        static FILE: RefCell<Option<Scratch>> = const { RefCell::new(None) };
    }
    let Some(bytes) = short(bytes) else { return };
    driver::replay::read_bytes(bytes);
    FILE.with_borrow_mut(|file| {
        let file = file.get_or_insert_with(Scratch::new);
        file.fill(bytes);
        if let Ok(replayed) = driver::replay::scenario(&file.0) {
            assert!(replayed.scenario.devices.len() <= replayed.registry.devices.len());
        }
    });
}

/// A file in shared memory, removed with its thread.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Self {
        let thread: String =
            format!("{:?}", std::thread::current().id()).chars().filter(char::is_ascii_digit).collect();
        Self(PathBuf::from(format!("/dev/shm/rapid-fuzz-{}-{thread}.mcap", std::process::id())))
    }

    fn fill(&self, bytes: &[u8]) {
        let file = std::fs::File::create(&self.0).and_then(|mut file| file.write_all(bytes));
        file.unwrap_or_else(|error| panic!("{}: {error}", self.0.display()));
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// The published mask: a record that is one is written back as it was, and shown.
pub fn mask(bytes: &[u8]) {
    let Some((record, names)) = bytes.split_first_chunk::<RECORD_LEN>() else { return };
    let Ok(read) = MaskRecord::from_bytes(record) else { return };
    assert_eq!(read.to_bytes(), *record);
    let names = commands::mask::layout(&String::from_utf8_lossy(names));
    check_mask(&read, names.as_deref());
}

/// The JSON file beside the mask, which names the bits.
pub fn layout(bytes: &[u8]) {
    let Some(text) = text_of(bytes) else { return };
    let names = commands::mask::layout(text);
    let record = MaskRecord {
        device_count: 3,
        generation: 2,
        mask: rapid::mask::PhysicalMask(u64::MAX),
        realtime_ns: 1,
        sequence: 1,
    };
    check_mask(&record, names.as_deref());
}

fn check_mask(record: &MaskRecord, names: Option<&commands::mask::Layout>) {
    harmless(&commands::mask::render(record, names, u64::MAX / 2, Palette::Plain));
    harmless(&commands::mask::render_json(record, names, u64::MAX / 2).expect("a mask has a form in JSON"));
}

/// What a USB device calls itself: a registry may hold it or refuse it; nothing that follows from the
/// registry says more than it says without, and the device is matched by exactly these characters.
pub fn strings(bytes: &[u8]) {
    // As hotplug does with what lies in sysfs.
    let Some(serial) = short(bytes).map(String::from_utf8_lossy) else { return };
    let text = text_with(&serial);
    let device = |serial: &str| Attachment {
        syspath: PathBuf::from("/sys/devices/1-1/1-1:1.0/video4linux/video0"),
        node: DeviceNode::Video(PathBuf::from("/dev/video0")),
        driver: None,
        unit: Unit::Usb(UsbIdentity {
            firmware: None,
            manufacturer: None,
            vid: 1,
            pid: 1,
            serial: Some(serial.to_owned()),
            port: "1-1".to_owned(),
            product: Some(serial.to_owned()),
        }),
    };
    let registry = match Registry::parse(&text, None) {
        Ok(loaded) => loaded.registry,
        Err(errors) => return check_errors(&errors, &text),
    };
    check_artifacts(&registry);
    let matched = |serial: &str| matches!(Assigner::new(&registry).attach(&device(serial)), Assignment::Entry(_));
    assert!(matched(&serial), "a registered unit is not matched");
    assert!(!matched(&format!("{serial}x")) && !matched(&format!(" {serial}")), "another unit is matched");
    let reasons = Assigner::new(&registry).explain(&device("other")).reasons;
    reasons.iter().for_each(|reason| harmless(reason));
}

/// A registry with one camera of this serial number beside one without.
fn text_with(serial: &str) -> String {
    let serial = toml::Value::String(serial.to_owned());
    format!(
        "[device.one]\nvid = \"0001\"\npid = \"0001\"\nserial = {serial}\nnode = \"camera\"\n\
         [device.two]\nvid = \"0002\"\npid = \"0002\"\nnode = \"camera\"\n"
    )
}

/// Text for people: nothing that moves a cursor, and no more columns than asked.
pub fn text(bytes: &[u8]) {
    let Some(bytes) = short(bytes) else { return };
    let text = String::from_utf8_lossy(bytes);
    let plain = shown::plain(&text);
    harmless(&plain);
    assert!(!plain.contains('\n'));
    for columns in [0, 1, 7, 80] {
        assert!(shown::width(&shown::cut(&plain, columns, "…")) <= columns);
        assert_eq!(shown::width(&shown::left(&plain, columns, "…")), columns);
        assert_eq!(shown::width(&shown::right(&plain, columns, "…")), columns);
    }
    let json = shown::json(&text).expect("a text has a form in JSON");
    harmless(&json);
    assert!(!json.contains('\n'));
    assert_eq!(serde_json::from_str::<String>(&json).expect("JSON"), text);
    assert!(shown::ascii(&text).is_ascii());
}

fn short(bytes: &[u8]) -> Option<&[u8]> {
    (bytes.len() <= LONGEST).then_some(bytes)
}

fn text_of(bytes: &[u8]) -> Option<&str> {
    std::str::from_utf8(short(bytes)?).ok()
}

/// Nothing in it moves a cursor or reorders a line.
fn harmless(text: &str) {
    let moves = |c: char| {
        (c.is_control() && c != '\n')
            || matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
    };
    assert!(!text.contains(moves), "harmful to a terminal: {text:?}");
}

fn check_errors(errors: &RegistryErrors, text: &str) {
    assert!(!errors.diagnostics.is_empty());
    let lines = text.lines().count().max(1) + 1;
    for diagnostic in &errors.diagnostics {
        assert!(diagnostic.line <= lines, "line {} of {lines}", diagnostic.line);
        assert!(!diagnostic.message.is_empty());
    }
    harmless(&errors.to_string());
}

/// The rules, descriptors and unit of a registry, read back by readers that are not ours.
fn check_artifacts(registry: &Registry) {
    let unit_without_names = |text: &str| text.replace(&registry.rig.name, "");
    // A harmless registry that has as much to open: of all that is in a registry only that may change the unit.
    let mut harmless = Registry::builtin();
    let on_usb =
        |device: &DeviceSpec| matches!(&device.node, NodeSpec::Process(program) if program.opens == Opens::Usb);
    if let (true, Some(first)) = (registry.devices.iter().any(on_usb), harmless.devices.first_mut()) {
        first.node = NodeSpec::Process(ProcessSpec {
            program: "/usr/bin/true".into(),
            args: Vec::new(),
            opens: Opens::Usb,
            kind: ModalityKind::Bytes,
            shape: Vec::new(),
        });
    }
    let bus = |device: &DeviceSpec| {
        matches!(&device.node, NodeSpec::Can(can) if can.adapter == CanAdapter::SocketCan).then(|| device.node.clone())
    };
    if let (Some(bus), Some(last)) = (registry.devices.iter().find_map(bus), harmless.devices.last_mut()) {
        last.node = bus;
    }
    let expected = unit_without_names(&text_of_unit(&harmless).replace(&harmless.rig.name, ""));
    for artifact in artifacts(registry) {
        let text = &artifact.contents;
        match artifact.kind {
            ArtifactKind::Rules => check_rules(registry, text),
            ArtifactKind::Unit => assert_eq!(unit_without_names(text), expected, "the unit says more than its name"),
            ArtifactKind::Descriptor => check_descriptor(registry, &artifact.path, text),
        }
    }
}

fn text_of_unit(registry: &Registry) -> String {
    artifacts(registry).into_iter().find(|artifact| artifact.kind == ArtifactKind::Unit).expect("a unit").contents
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
        if let Some(command) = value("RUN") {
            check_command(registry, rule, command);
            continue;
        }
        let link = value("SYMLINK").expect("every rule gives a name");
        assert!(named.insert(link.to_owned()), "two rules for {link}");
        let device = registry.devices.iter().find(|device| format!("rapid/{}", device.name) == link);
        let device = device.unwrap_or_else(|| panic!("a rule for {link}, which is no device"));
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

/// A CAN interface is brought up, and nothing else: the words are ours and a number of the registry.
fn check_command(registry: &Registry, rule: &[Token], command: &str) {
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
    let commands = registry.devices.iter().filter_map(|device| {
        let NodeSpec::Can(can) = &device.node else { return None };
        Some(format!("/usr/sbin/ip link set dev $name up type can bitrate {} restart-ms 100", can.bitrate))
    });
    assert!(commands.into_iter().any(|known| known == command), "udev would run {command:?}");
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
