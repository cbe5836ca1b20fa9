//! The settings of a node: `[device.NAME.camera]`, `[device.NAME.serial]`, and the sizes that follow
//! from them.

use std::time::Duration;

use crate::modality::ModalityKind;
use crate::registry::diagnostic::nearest;
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{CAN_BATCH, CAN_RECORD, CameraSpec, Framing, NodeSpec, Parse, PixelFormat, SerialSpec};

pub(super) fn camera(section: &Section<'_>, problems: &mut Problems<'_>) -> CameraSpec {
    if section.is_table("serial") {
        let fix = "remove the table, or write node = \"serial\"";
        section.report(problems, "serial", format!("a camera has no table [{}]", section.child("serial")), fix);
    }
    let mut camera = CameraSpec { width: 640, height: 480, fps: 30, format: PixelFormat::Mjpg, controls: Vec::new() };
    let Some(table) = section.table(problems, "camera") else { return camera };
    table.allow(problems, &["width", "height", "fps", "format", "controls"]);
    let mut integer = |key, most, default| {
        table.integer(problems, key, 1..=most).and_then(|found| u32::try_from(found.value).ok()).unwrap_or(default)
    };
    camera.width = integer("width", 8192, camera.width);
    camera.height = integer("height", 8192, camera.height);
    camera.fps = integer("fps", 1000, camera.fps);
    camera.format = table.choice(problems, "format", &PixelFormat::WORDS).unwrap_or(camera.format);
    if let Some(controls) = table.table(problems, "controls") {
        for (_, name, _) in controls.fields() {
            if let Some(value) = controls.integer(problems, name, i64::MIN..=i64::MAX) {
                camera.controls.push((name.to_owned(), value.value));
            }
        }
    }
    camera
}

pub(super) fn serial(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<SerialSpec> {
    if section.has("camera") {
        let fix = "remove the table, or write node = \"camera\"";
        section.report(problems, "camera", format!("a serial line has no table [{}]", section.child("camera")), fix);
    }
    if !section.is_table("serial") {
        let fix = format!("write [{}] with channels = the count of numbers in a message", section.child("serial"));
        section.missing(problems, "the table of the serial line", &fix);
        return None;
    }
    let table = section.table(problems, "serial")?;
    table.allow(problems, &["baud", "framing", "parse", "channels"]);
    let baud =
        table.integer(problems, "baud", 50..=12_000_000).map_or(Some(115_200), |baud| baud.value.try_into().ok());
    let framing = framing(&table, problems).unwrap_or(Framing::Line);
    let parse = table.choice(problems, "parse", &Parse::WORDS).unwrap_or(Parse::Csv);
    let channels = table.integer(problems, "channels", 1..=1024).and_then(|count| usize::try_from(count.value).ok());
    if parse == Parse::Raw {
        if table.has("channels") {
            let fix = "remove channels, or write parse = \"csv\", \"json\" or \"f32le\"";
            table.report(problems, "channels", "raw messages are not looked into and have no channels".to_owned(), fix);
        }
        return Some(SerialSpec { baud: baud?, framing, parse, channels: 0 });
    }
    if !table.has("channels") {
        table.missing(problems, "channels", "write channels = the count of numbers in a message");
    }
    let channels = channels?;
    if let (Parse::F32le, Framing::Fixed(bytes)) = (parse, framing)
        && bytes != 4 * channels
    {
        let message = format!("{channels} channels of f32le take {} bytes, not {bytes}", 4 * channels);
        table.report(problems, "framing", message, format!("write framing = \"fixed {}\"", 4 * channels));
    }
    if let (Parse::F32le, Framing::Line) = (parse, framing) {
        let message = "f32le messages cannot be framed by lines: a number may contain a newline".to_owned();
        table.report(problems, "framing", message, format!("write framing = \"fixed {}\" or \"cobs\"", 4 * channels));
    }
    Some(SerialSpec { baud: baud?, framing, parse, channels })
}

fn framing(table: &Section<'_>, problems: &mut Problems<'_>) -> Option<Framing> {
    /// More than any message of the devices this is for; bounds the buffer.
    const LONGEST: usize = 65_536;
    let text = table.text(problems, "framing")?.value;
    match text.split_once(' ') {
        None if text == "line" => return Some(Framing::Line),
        None if text == "cobs" => return Some(Framing::Cobs),
        Some(("fixed", bytes)) => {
            if let Some(bytes) = bytes.trim().parse().ok().filter(|bytes| (1..=LONGEST).contains(bytes)) {
                return Some(Framing::Fixed(bytes));
            }
            let message = format!("{:?} is not a message length", bytes.trim());
            table.report(problems, "framing", message, format!("write \"fixed N\" with N from 1 to {LONGEST} bytes"));
            return None;
        }
        _ => {}
    }
    let word = text.split(' ').next().unwrap_or_default();
    let fix = match nearest(word, ["line", "cobs", "fixed"]) {
        Some("fixed") => "write \"fixed N\" with N bytes a message, for example \"fixed 12\"".to_owned(),
        Some(name) => format!("did you mean \"{name}\"?"),
        None => "write one of: line, cobs, fixed N".to_owned(),
    };
    table.report(problems, "framing", format!("unknown framing {text:?}"), fix);
    None
}

/// Half a second, or ten periods of a slow camera; a serial line's rate is not known.
pub(super) fn default_stall(node: Option<&NodeSpec>) -> Duration {
    const LEAST: Duration = Duration::from_millis(500);
    match node {
        Some(NodeSpec::Camera(camera)) => (Duration::from_secs(10) / camera.fps.max(1)).max(LEAST),
        Some(NodeSpec::Lan(lan)) => lan.stall(LEAST),
        _ => LEAST,
    }
}

pub(super) fn max_bytes(section: &Section<'_>, node: Option<&NodeSpec>, problems: &mut Problems<'_>) -> u64 {
    /// A JPEG picture of a small, noisy scene with its tables can exceed two bytes a pixel.
    const SMALLEST_JPEG: u64 = 64 << 10;
    let (default, least) = match node {
        Some(NodeSpec::Camera(camera)) => {
            let pixels = u64::from(camera.width) * u64::from(camera.height);
            match camera.format {
                PixelFormat::Mjpg => ((2 * pixels).max(SMALLEST_JPEG), 1024),
                PixelFormat::Yuyv => (2 * pixels, 2 * pixels),
                PixelFormat::Grey => (pixels, pixels),
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
            (ModalityKind::Image, [height, width]) => {
                ((2 * u64::from(*width) * u64::from(*height)).max(SMALLEST_JPEG), 1024)
            }
            (ModalityKind::Scalars, [channels]) => (8 * u64::from(*channels), 8 * u64::from(*channels)),
            _ => (64 << 10, 1),
        },
        None => (1, 1),
    };
    section.size(problems, "max_bytes", least..=256 << 20).unwrap_or(default)
}

/// About two seconds of pictures; a serial line may send a thousand samples a second.
pub(super) fn default_depth(node: Option<&NodeSpec>) -> u64 {
    match node {
        Some(NodeSpec::Camera(camera)) => (2 * u64::from(camera.fps)).clamp(16, 1024),
        Some(NodeSpec::Lan(lan)) => lan.depth(),
        // Of a camera with 30 pictures a second, and of what may be as large.
        Some(NodeSpec::Process(process)) if process.kind != ModalityKind::Scalars => 60,
        _ => 2048,
    }
}
