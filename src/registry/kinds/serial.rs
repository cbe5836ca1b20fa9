//! `node = "serial"`: a serial line, with its table `[device.NAME.tty]`.

use std::fmt;

use rapid_core::modality::ModalityKind;

use super::{Kind, NodeSpec, Settings};
use crate::diagnostic::nearest;
use crate::keys::{About, Key, Own, Words, keys, table, text, whole};
use crate::parse::device::Draft;
use crate::parse::program::Programs;
use crate::section::Section;
use crate::spec::Opens;

pub(crate) const TABLE: Key = table("tty", "A serial line.", || About::Table(&[SerialSpec::KEYS]));
/// Names of the table: the present one, and the one before it.
pub(crate) const TABLES: [&str; 2] = ["tty", "serial"];
const FRAMING: Own<Framing> = text(framing, "`\"line\"`, `\"cobs\"`, `\"fixed N\"` with N bytes");

keys! {
    /// `[device.NAME.tty]`.
    #[derive(Debug, Clone, PartialEq, Eq)]
    pub struct SerialSpec {
        /// Bits a second.
        baud: u32 = whole::<u32>(50, 12_000_000), or 115_200;
        /// How messages are delimited.
        framing: Framing = FRAMING, usually "`\"line\"`", or Framing::Line;
        /// Content of a message.
        parse: Parse = Words(&Parse::WORDS), or Parse::Csv;
        /// Values in a message; 0 with `parse = "raw"`.
        channels: usize = whole::<usize>(1, 1024), usually "needed, unless messages are raw", or 0;
    }
}

/// Message boundaries on a serial line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Framing {
    /// A newline ends a message; a carriage return before it is dropped.
    Line,
    /// Consistent overhead byte stuffing: a zero byte ends a message.
    Cobs,
    /// Messages of exactly this many bytes.
    Fixed(usize),
}

/// Content of a serial message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parse {
    /// Numbers separated by commas.
    Csv,
    /// A JSON array of numbers, or an object whose numeric values are taken in order.
    Json,
    /// Little-endian 32-bit floats.
    F32le,
    /// Not parsed.
    Raw,
}

rapid_core::words! {
    /// Every kind of content and its name.
    Parse, 4: "csv" = Csv, "json" = Json, "f32le" = F32le, "raw" = Raw;
}

impl fmt::Display for Framing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line => f.write_str("line"),
            Self::Cobs => f.write_str("cobs"),
            Self::Fixed(bytes) => write!(f, "fixed {bytes}"),
        }
    }
}

impl Kind for SerialSpec {
    fn modality_kind(&self) -> ModalityKind {
        if self.parse == Parse::Raw { ModalityKind::Bytes } else { ModalityKind::Scalars }
    }

    fn shape(&self) -> Vec<u32> {
        if self.parse == Parse::Raw { Vec::new() } else { vec![u32::try_from(self.channels).unwrap_or(u32::MAX)] }
    }

    fn opens(&self) -> Opens {
        Opens::Tty
    }

    fn format(&self) -> String {
        match self.parse {
            Parse::Raw => format!("{} baud {} raw", self.baud, self.framing),
            parse => format!("{} baud {} {parse} x{}", self.baud, self.framing, self.channels),
        }
    }

    fn descriptor(&self) -> String {
        let Self { baud, framing, parse, channels } = self;
        format!("    baud: {baud}\n    framing: \"{framing}\"\n    parse: \"{parse}\"\n    channels: {channels}\n")
    }

    fn sizes(&self) -> (u64, u64) {
        match (self.parse, self.framing) {
            (Parse::Raw, Framing::Fixed(bytes)) => (bytes as u64, bytes as u64),
            (Parse::Raw, _) => (4096, 1),
            // Numbers travel as 64-bit floats.
            _ => (8 * self.channels as u64, 8 * self.channels as u64),
        }
    }

    fn bytes_per_second(&self, _: usize) -> Option<f64> {
        Some(f64::from(self.baud) / 10.0)
    }
}

pub(crate) fn read(entry: &Section<'_>, _: Programs<'_>) -> Option<Settings> {
    if entry.has("camera") {
        let fix = "remove the table, or write node = \"camera\"";
        entry.report("camera", format!("a serial line has no table [{}]", entry.child("camera")), fix);
    }
    let Some(key) = TABLES.into_iter().find(|key| entry.is_table(key)) else {
        let fix = format!("write [{}] with channels = the count of values in a message", entry.child("tty"));
        entry.missing("the table of the serial line", &fix);
        return None;
    };
    if key == "tty" && entry.is_table("serial") {
        let message = format!(
            "[{}] is the old name of [{}], which begins on line {}",
            entry.child("serial"),
            entry.child("tty"),
            entry.line_of("tty")
        );
        entry.report("serial", message, "move its keys there and remove it");
    }
    let table = entry.table(key)?;
    let mut serial = SerialSpec::read(&table);
    if serial.parse == Parse::Raw {
        if table.has("channels") {
            let fix = "remove channels, or write parse = \"csv\", \"json\" or \"f32le\"";
            table.report("channels", "raw messages are not parsed and have no channels", fix);
        }
        serial.channels = 0;
        return Some((NodeSpec::Serial(serial), None));
    }
    table.need("channels", "write channels = the count of values in a message");
    let channels = serial.channels;
    match (serial.parse, serial.framing) {
        // Missing, which was reported.
        _ if channels == 0 => return None,
        (Parse::F32le, Framing::Fixed(bytes)) if bytes != 4 * channels => {
            let message = format!("{channels} channels of f32le take {} bytes, not {bytes}", 4 * channels);
            table.report("framing", message, format!("write framing = \"fixed {}\"", 4 * channels));
        }
        (Parse::F32le, Framing::Line) => {
            let message = "f32le messages cannot be framed by lines: a number may contain a newline";
            table.report("framing", message, format!("write framing = \"fixed {}\" or \"cobs\"", 4 * channels));
        }
        _ => {}
    }
    Some((NodeSpec::Serial(serial), None))
}

/// Warns of tables of serial lines that still have the name that collides with the key of the serial number.
pub(crate) fn warn_of_old_names(drafts: &[Draft<'_>]) {
    let is_old = |section: &&Section<'_>| section.is_table("serial") && !section.is_table("tty");
    for section in drafts.iter().map(|draft| &draft.section).filter(is_old) {
        let (old, new) = (section.child("serial"), section.child("tty"));
        let message = format!("[{old}] is now called [{new}]; the old name is accepted until the next release");
        let fix = format!("write [{new}]; `rapid register` renames it when it next writes this file");
        section.warn_at(section.at_of("serial"), message, fix);
    }
}

fn framing(table: &Section<'_>, key: &str) -> Option<Framing> {
    /// More than any message of the supported devices; bounds the buffer.
    const LONGEST: usize = 65_536;
    let text = table.text(key)?;
    match text.split_once(' ') {
        None if text == "line" => return Some(Framing::Line),
        None if text == "cobs" => return Some(Framing::Cobs),
        Some(("fixed", bytes)) => {
            if let Some(bytes) = bytes.trim().parse().ok().filter(|bytes| (1..=LONGEST).contains(bytes)) {
                return Some(Framing::Fixed(bytes));
            }
            let message = format!("{:?} is not a message length", bytes.trim());
            return table.refuse(key, message, format!("write \"fixed N\" with N from 1 to {LONGEST} bytes"));
        }
        _ => {}
    }
    let word = text.split(' ').next().unwrap_or_default();
    let fix = match nearest(word, ["line", "cobs", "fixed"]) {
        Some("fixed") => "write \"fixed N\" with N bytes a message, for example \"fixed 12\"".to_owned(),
        Some(name) => format!("did you mean \"{name}\"?"),
        None => "write one of: line, cobs, fixed N".to_owned(),
    };
    table.refuse(key, format!("unknown framing {text:?}"), fix)
}
