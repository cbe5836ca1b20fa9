//! The settings of a node: `[device.NAME.camera]`, `[device.NAME.tty]`, `[device.NAME.can]` and
//! `[device.NAME.process]`, and the sizes derived from them.

use std::time::Duration;

use rapid_core::modality::ModalityKind;
use toml::de::DeValue;

use super::device::Draft;
use super::motors;
use crate::diagnostic::nearest;
use crate::section::Section;
use crate::spec::KINDS;
use crate::spec::{
    CAN_BATCH, CAN_RECORD, CanAdapter, CanProtocol, CanSpec, Framing, Hook, LanProtocol, LanSpec, NodeSpec, Opens,
    Parse, ProcessSpec, SLCAN_BITRATES, SerialSpec,
};

/// Names of the table of a serial line: the present one, and the one before it.
pub(super) const TTY: [&str; 2] = ["tty", "serial"];

pub(super) fn serial(section: &Section<'_>) -> Option<SerialSpec> {
    if section.has("camera") {
        let fix = "remove the table, or write node = \"camera\"";
        section.report("camera", format!("a serial line has no table [{}]", section.child("camera")), fix);
    }
    let Some(key) = TTY.into_iter().find(|key| section.is_table(key)) else {
        let fix = format!("write [{}] with channels = the count of numbers in a message", section.child("tty"));
        section.missing("the table of the serial line", &fix);
        return None;
    };
    if key == "tty" && section.is_table("serial") {
        let message = format!(
            "[{}] is the old name of [{}], which begins on line {}",
            section.child("serial"),
            section.child("tty"),
            section.line_of("tty")
        );
        section.report("serial", message, "move its keys there and remove it");
    }
    let table = section.table(key)?;
    table.allow(&["baud", "framing", "parse", "channels"]);
    let baud = table.integer("baud", 50..=12_000_000).unwrap_or(115_200);
    let framing = framing(&table).unwrap_or(Framing::Line);
    let parse = table.choice("parse", &Parse::WORDS).unwrap_or(Parse::Csv);
    let channels = table.integer("channels", 1..=1024);
    if parse == Parse::Raw {
        if table.has("channels") {
            let fix = "remove channels, or write parse = \"csv\", \"json\" or \"f32le\"";
            table.report("channels", "raw messages are not parsed and have no channels".to_owned(), fix);
        }
        return Some(SerialSpec { baud, framing, parse, channels: 0 });
    }
    table.need("channels", "write channels = the count of numbers in a message");
    let channels = channels?;
    if let (Parse::F32le, Framing::Fixed(bytes)) = (parse, framing)
        && bytes != 4 * channels
    {
        let message = format!("{channels} channels of f32le take {} bytes, not {bytes}", 4 * channels);
        table.report("framing", message, format!("write framing = \"fixed {}\"", 4 * channels));
    }
    if let (Parse::F32le, Framing::Line) = (parse, framing) {
        let message = "f32le messages cannot be framed by lines: a number may contain a newline".to_owned();
        table.report("framing", message, format!("write framing = \"fixed {}\" or \"cobs\"", 4 * channels));
    }
    Some(SerialSpec { baud, framing, parse, channels })
}

/// Warns of tables of serial lines that still have the name that collides with the key of the serial number.
pub(super) fn warn_of_old_names(drafts: &[Draft<'_>]) {
    let is_old = |section: &&Section<'_>| section.is_table("serial") && !section.is_table("tty");
    for section in drafts.iter().map(|draft| &draft.section).filter(is_old) {
        let (old, new) = (section.child("serial"), section.child("tty"));
        let message = format!("[{old}] is now called [{new}]; the old name is accepted until the next release");
        let fix = format!("write [{new}]; `rapid register` renames it when it next writes this file");
        section.warn_at(section.at_of("serial"), message, fix);
    }
}

fn framing(table: &Section<'_>) -> Option<Framing> {
    /// More than any message of the supported devices; bounds the buffer.
    const LONGEST: usize = 65_536;
    let text = table.text("framing")?;
    match text.split_once(' ') {
        None if text == "line" => return Some(Framing::Line),
        None if text == "cobs" => return Some(Framing::Cobs),
        Some(("fixed", bytes)) => {
            if let Some(bytes) = bytes.trim().parse().ok().filter(|bytes| (1..=LONGEST).contains(bytes)) {
                return Some(Framing::Fixed(bytes));
            }
            let message = format!("{:?} is not a message length", bytes.trim());
            return table.refuse("framing", message, format!("write \"fixed N\" with N from 1 to {LONGEST} bytes"));
        }
        _ => {}
    }
    let word = text.split(' ').next().unwrap_or_default();
    let fix = match nearest(word, ["line", "cobs", "fixed"]) {
        Some("fixed") => "write \"fixed N\" with N bytes a message, for example \"fixed 12\"".to_owned(),
        Some(name) => format!("did you mean \"{name}\"?"),
        None => "write one of: line, cobs, fixed N".to_owned(),
    };
    table.refuse("framing", format!("unknown framing {text:?}"), fix)
}

/// Half a second, or ten periods of a slow camera; a serial line's rate is unknown.
pub(super) fn default_stall(node: Option<&NodeSpec>) -> Duration {
    const LEAST: Duration = Duration::from_millis(500);
    match node.and_then(NodeSpec::picture) {
        // Its state is read every 3 s.
        _ if node.is_some_and(is_gopro) => Duration::from_secs(10),
        Some(picture) => (Duration::from_secs(10) / picture.fps.max(1)).max(LEAST),
        None => LEAST,
    }
}

/// Bytes of its largest sample unless the entry states otherwise, and the least that may be written.
pub(super) fn sizes(node: Option<&NodeSpec>) -> (u64, u64) {
    /// A JPEG picture of a small, noisy scene with its tables can exceed two bytes a pixel.
    const SMALLEST_JPEG: u64 = 64 << 10;
    match node {
        Some(NodeSpec::Camera(camera)) => {
            let pixels = u64::from(camera.width) * u64::from(camera.height);
            match camera.format.encoding().pixel_bytes() {
                Some(bytes) => (bytes as u64 * pixels, bytes as u64 * pixels),
                None => ((2 * pixels).max(SMALLEST_JPEG), 1024),
            }
        }
        Some(NodeSpec::Serial(serial)) => match (serial.parse, serial.framing) {
            (Parse::Raw, Framing::Fixed(bytes)) => (bytes as u64, bytes as u64),
            (Parse::Raw, _) => (4096, 1),
            // Numbers travel as 64-bit floats.
            _ => (8 * serial.channels as u64, 8 * serial.channels as u64),
        },
        Some(NodeSpec::Can(can)) => match can.channels() {
            0 => ((CAN_BATCH * CAN_RECORD) as u64, (CAN_BATCH * CAN_RECORD) as u64),
            channels => (8 * channels as u64, 8 * channels as u64),
        },
        Some(NodeSpec::Lan(lan)) => lan.max_bytes(),
        Some(NodeSpec::Process(process)) => match (process.kind, process.shape.as_slice()) {
            (ModalityKind::Image | ModalityKind::Depth, [height, width]) => {
                ((2 * u64::from(*width) * u64::from(*height)).max(SMALLEST_JPEG), 1024)
            }
            (ModalityKind::Scalars, [channels]) => (8 * u64::from(*channels), 8 * u64::from(*channels)),
            _ => (64 << 10, 1),
        },
        None => (1, 1),
    }
}

/// About two seconds of pictures, and a second of a LiDAR's packets; a serial line may send 1000 samples a second.
pub(super) fn default_depth(node: Option<&NodeSpec>) -> u64 {
    match node {
        Some(node) if is_gopro(node) => 16,
        // For a camera with 30 pictures a second, and for anything that may be as large.
        Some(NodeSpec::Process(process)) if process.kind != ModalityKind::Scalars => 60,
        Some(node) if is_remote(node) && node.modality_kind() == ModalityKind::Bytes => 60,
        node => node.and_then(NodeSpec::picture).map_or(2048, |picture| (2 * u64::from(picture.fps)).clamp(16, 1024)),
    }
}

/// Whether its samples are the states of a GoPro.
pub(super) fn is_gopro(node: &NodeSpec) -> bool {
    matches!(node, NodeSpec::Lan(LanSpec { protocol: LanProtocol::Gopro { preview: None, .. }, .. }))
}

pub(super) fn is_remote(node: &NodeSpec) -> bool {
    matches!(node, NodeSpec::Lan(LanSpec { protocol: LanProtocol::Remote { .. }, .. }))
}

const PROCESS_KEYS: [&str; 7] = ["args", "opens", "kind", "channels", "width", "height", "heartbeat"];
/// Sufficient for a program that only checks once a second whether its device still answers.
const DEFAULT_HEARTBEAT: Duration = Duration::from_secs(2);

/// How an entry's `program` is run and how long it may be silent; `None` if a problem with it was reported.
pub(super) fn process(section: &Section<'_>, program: Option<Hook>) -> Option<(ProcessSpec, Duration)> {
    section.no_tables(&["camera", "tty", "serial"], "a program", "process");
    if section.has("stall_after") {
        let fix = format!("write heartbeat in [{}]", section.child("process"));
        section.report("stall_after", "a program has a heartbeat instead of stall_after".to_owned(), fix);
    }
    let bare = |Hook { program, args }| ProcessSpec {
        program,
        args,
        opens: Opens::Usb,
        kind: ModalityKind::Bytes,
        shape: Vec::new(),
    };
    let Some(table) = section.table("process") else { return Some((bare(program?), DEFAULT_HEARTBEAT)) };
    table.allow(&PROCESS_KEYS);
    let given = args(&table);
    if table.has("args") && program.as_ref().is_some_and(|program| !program.args.is_empty()) {
        let fix = "keep those of on_attach or these".to_owned();
        table.report("args", "on_attach gives the program arguments already".to_owned(), fix);
    }
    let opens = table.choice("opens", &Opens::WORDS).unwrap_or(Opens::Usb);
    let kind = table.choice("kind", &KINDS).unwrap_or(ModalityKind::Bytes);
    let shape = shape(&table, kind);
    let range = Duration::from_millis(10)..=Duration::from_hours(1);
    let heartbeat = table.duration("heartbeat", range).unwrap_or(DEFAULT_HEARTBEAT);
    let mut process = ProcessSpec { opens, kind, shape, ..bare(program?) };
    process.args.extend(given);
    Some((process, heartbeat))
}

fn args(table: &Section<'_>) -> Vec<String> {
    let Some(value) = table.field("args") else { return Vec::new() };
    let DeValue::Array(items) = value.get_ref() else {
        let fix = "write args = [\"--rate\", \"100\"]: one text for each argument";
        table.report("args", "args must be a list of texts".to_owned(), fix);
        return Vec::new();
    };
    let mut args = Vec::new();
    for item in items {
        let at = item.span().start;
        match item.get_ref() {
            DeValue::String(text) if !text.contains('\0') => args.push(text.clone().into_owned()),
            DeValue::String(_) => {
                table.report_at(at, "an argument cannot contain the character U+0000", "leave it out");
            }
            _ => table.report_at(at, "an argument must be text", "put it in double quotes"),
        }
    }
    args
}

/// The shape of a sample, from the keys for its kind.
fn shape(table: &Section<'_>, kind: ModalityKind) -> Vec<u32> {
    let (word, keys): (&str, &[(&str, i64)]) = match kind {
        ModalityKind::Scalars => ("scalars", &[("channels", 1024)]),
        ModalityKind::Image => ("image", &[("height", 8192), ("width", 8192)]),
        ModalityKind::Depth => ("depth", &[("height", 8192), ("width", 8192)]),
        ModalityKind::Bytes => ("bytes", &[]),
    };
    for key in ["channels", "width", "height"] {
        if table.has(key) && !keys.iter().any(|(own, _)| *own == key) {
            let owner = if key == "channels" { "scalars" } else { "image" };
            let message = format!("samples of kind {word:?} have no {key}");
            table.report(key, message, format!("remove {key}, or write kind = {owner:?}"));
        }
    }
    let mut shape = Vec::new();
    for (key, most) in keys {
        table.need(key, &format!("samples of kind {word:?} need it: write {key} = a whole number"));
        shape.push(table.integer(key, 1..=*most).unwrap_or(1));
    }
    shape
}

const CAN_KEYS: [&str; 9] =
    ["adapter", "bitrate", "protocol", "hz", "deadman", "disable_after", "timeout", "silent_after", "motors"];
/// Keys that only a bus of motors has.
const OF_MOTORS: [&str; 6] = ["motors", "hz", "deadman", "disable_after", "timeout", "silent_after"];

/// What can be on a bus, by its keyword: motors, or not.
const PROTOCOLS: [(&str, bool); 2] = [("raw", false), ("damiao", true)];

/// Reads the table; `None` if a problem with it was reported.
pub(super) fn can(section: &Section<'_>) -> Option<CanSpec> {
    section.no_tables(&["camera", "tty", "serial", "lan"], "a CAN adapter", "can");
    let default = CanSpec { adapter: CanAdapter::SocketCan, bitrate: 1_000_000, protocol: CanProtocol::Raw };
    if !section.has("can") {
        return Some(default);
    }
    let table = section.table("can")?;
    table.allow(&CAN_KEYS);
    let adapter = table.choice("adapter", &CanAdapter::WORDS).unwrap_or(default.adapter);
    let bitrate = table.integer("bitrate", 10_000..=1_000_000).unwrap_or(default.bitrate);
    check_bitrate(&table, adapter, bitrate);
    let has_motors = table.choice("protocol", &PROTOCOLS);
    if has_motors == Some(true) {
        return Some(CanSpec { adapter, bitrate, protocol: CanProtocol::Damiao(motors::damiao(&table)?) });
    }
    // An unknown word has been reported; the intended protocol is unknown.
    if has_motors.is_some() || !table.has("protocol") {
        no_motors(&table);
    }
    Some(CanSpec { adapter, bitrate, protocol: CanProtocol::Raw })
}

fn no_motors(table: &Section<'_>) {
    if let Some(key) = OF_MOTORS.into_iter().find(|key| table.has(key)) {
        let message = format!("a bus whose frames are recorded as they are has no {key}");
        table.report(key, message, "write protocol = \"damiao\" for a bus of motors, or remove it");
    }
}

fn check_bitrate(table: &Section<'_>, adapter: CanAdapter, bitrate: u32) {
    let (message, fix) = match adapter {
        CanAdapter::Slcan if !SLCAN_BITRATES.contains(&bitrate) => {
            let known: Vec<String> = SLCAN_BITRATES.iter().map(ToString::to_string).collect();
            (format!("slcan has no name for {bitrate} bits a second"), format!("write one of: {}", known.join(", ")))
        }
        CanAdapter::Damiao if bitrate != 1_000_000 => (
            "rapid does not set the bit rate of Damiao's adapter".to_owned(),
            "remove bitrate; the adapter is set up with its maker's program, and its motors talk at 1000000".to_owned(),
        ),
        _ => return,
    };
    table.report("bitrate", message, fix);
}
