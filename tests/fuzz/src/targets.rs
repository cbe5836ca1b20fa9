//! What each reader promises of any bytes.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::io::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use rapid::commands;
use rapid_core::mask::{MaskRecord, RECORD_LEN};
use rapid_core::text as shown;
use rapid_devices::driver;
use rapid_episode::record::inspect as inspection;
use rapid_episode::recover::recover_bytes;
use rapid_registry::device::{Attachment, DeviceNode, Unit, UsbIdentity};
use rapid_registry::scenario::Scenario;
use rapid_registry::units::{parse_duration, parse_size, show_duration, show_size};
use rapid_registry::{Assigner, Assignment, Framing, Parse, Registry, RegistryErrors, SerialSpec};
use rapid_status::palette::Palette;

use crate::artifacts;

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
            artifacts::check(&loaded.registry);
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
        assert_eq!(parse_duration(&show_duration(duration)), Some(duration), "what is shown can be read again");
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

/// One recorded message, of each schema.
pub fn message(bytes: &[u8]) {
    for schema in ["foxglove.CompressedImage", "foxglove.RawImage", "rapid.Scalars", "rapid.Bytes"] {
        if let Some((payload, width, _)) = rapid_episode::decode(schema, bytes) {
            // Padding of rows is taken away; nothing is added.
            assert!(payload.len() <= bytes.len(), "{schema} grew");
            assert!(schema != "rapid.Scalars" || payload.len() == width as usize * 8);
        }
    }
}

/// A file as `rapid inspect` reads it: whatever it holds, a report that is harmless to a terminal.
pub fn inspect(bytes: &[u8]) {
    let Some(report) = short(bytes).and_then(inspection::inspect_bytes) else { return };
    harmless(&inspection::render(&report, 100, Palette::Plain));
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
        mask: rapid_core::mask::PhysicalMask(u64::MAX),
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
/// registry gives more than it gives without, and the device is matched by exactly these characters.
pub fn strings(bytes: &[u8]) {
    // As hotplug does with what lies in sysfs.
    let Some(serial) = short(bytes).map(String::from_utf8_lossy) else { return };
    let text = text_with(&serial);
    let device = |serial: &str| Attachment {
        formats: Vec::new(),
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
    artifacts::check(&registry);
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
    }
    let json = shown::json(&text).expect("a text has a form in JSON");
    harmless(&json);
    assert!(!json.contains('\n'));
    assert_eq!(serde_json::from_str::<String>(&json).expect("JSON"), text);
    assert!(shown::ascii(&text).is_ascii());
}

pub(crate) fn short(bytes: &[u8]) -> Option<&[u8]> {
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
