//! `node = "PROGRAM"`: a program that reads the device and publishes, with its table `[device.NAME.process]`.

use std::path::PathBuf;
use std::time::Duration;

use rapid_core::modality::ModalityKind;
use toml::de::DeValue;

use super::{Kind, NodeSpec, Settings, check_samples, compressed};
use crate::keys::{About, Key, Own, Time, Words, keys, table, texts, whole};
use crate::parse::program::{self, For, Programs};
use crate::section::Section;
use crate::simulation::SimSource;
use crate::spec::{Hook, KINDS, Opens};
use crate::system_files::{Needs, USB, quoted};

pub(crate) const TABLE: Key =
    table("process", "A program that reads the device.", || About::Table(&[ProcessKeys::KEYS]));
/// States that `on_attach` is the program that reads the device.
pub(crate) const PROCESS: &str = "process";
const ARGS: Own<Vec<String>> = texts(args, "a list of texts");

keys! {
    /// `[device.NAME.process]`.
    struct ProcessKeys {
        /// Arguments of the program.
        args: Vec<String> = ARGS, or Vec::new();
        /// Which node of the device it opens.
        opens: Opens = Words(&Opens::WORDS), or Opens::Usb;
        /// Content of its samples.
        kind: ModalityKind = Words(&KINDS), or ModalityKind::Bytes;
        /// Of scalars: values in a sample.
        channels: Option<u32> = whole::<u32>(1, 1024);
        /// Of images: their width, pixels.
        width: Option<u32> = whole::<u32>(1, 8192);
        /// Of images: their height, pixels.
        height: Option<u32> = whole::<u32>(1, 8192);
        /// Silent for this long it is stalled. The default suffices for a program that only checks once a second whether its
        /// device still answers.
        heartbeat: Duration = Time(Duration::from_millis(10), Duration::from_hours(1)), or Duration::from_secs(2);
    }
}

/// `node = "PROGRAM"` with `[device.NAME.process]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessSpec {
    /// The program: an absolute path, or the name as written if nothing is to be run (a
    /// registry read from an episode).
    pub program: PathBuf,
    /// Its arguments, none by default.
    pub args: Vec<String>,
    /// Which node of the device it opens, default [`Opens::Usb`].
    pub opens: Opens,
    /// Content of its samples, default bytes.
    pub kind: ModalityKind,
    /// Image: `[height, width]`. Scalars: `[channels]`. Bytes: empty.
    pub shape: Vec<u32>,
}

impl Kind for ProcessSpec {
    fn modality_kind(&self) -> ModalityKind {
        self.kind
    }

    fn shape(&self) -> Vec<u32> {
        self.shape.clone()
    }

    fn opens(&self) -> Opens {
        self.opens
    }

    fn format(&self) -> String {
        let name = self.program.file_name().unwrap_or(self.program.as_os_str()).display();
        match self.shape.as_slice() {
            [height, width] => format!("{name} {width}x{height}"),
            [channels] => format!("{name} scalars x{channels}"),
            _ => {
                let word = KINDS.iter().find(|(_, kind)| *kind == self.kind).map_or("", |(word, _)| word);
                format!("{name} {word}")
            }
        }
    }

    fn descriptor(&self) -> String {
        let program = quoted(&self.program.file_name().unwrap_or_default().to_string_lossy());
        let shape = match (self.kind, self.shape.as_slice()) {
            (ModalityKind::Image | ModalityKind::Depth, [height, width]) => {
                format!("    width: {width}\n    height: {height}\n")
            }
            (ModalityKind::Scalars, [channels]) => format!("    channels: {channels}\n"),
            _ => String::new(),
        };
        format!("    program: {program}\n{shape}")
    }

    fn sizes(&self) -> (u64, u64) {
        match (self.kind, self.shape.as_slice()) {
            (ModalityKind::Image | ModalityKind::Depth, [height, width]) => {
                (compressed(2 * u64::from(*width) * u64::from(*height)), 1024)
            }
            (ModalityKind::Scalars, [channels]) => (8 * u64::from(*channels), 8 * u64::from(*channels)),
            _ => (64 << 10, 1),
        }
    }

    fn depth(&self) -> u64 {
        // For a camera with 30 pictures a second, and for anything that may be as large.
        if self.kind == ModalityKind::Scalars { 2048 } else { 60 }
    }

    fn bytes_per_second(&self, _: usize) -> Option<f64> {
        None
    }

    fn need(&self, needs: &mut Needs) {
        needs.programs = true;
        if self.opens == Opens::Usb {
            needs.nodes.insert(USB);
        }
    }

    fn only_at_start(&self) -> Option<&'static str> {
        Some("its program needs what a run sets up for programs at its start")
    }

    fn simulated(&self, _: u64) -> SimSource {
        SimSource::Process
    }
}

pub(crate) fn read(entry: &Section<'_>, programs: Programs<'_>) -> Option<Settings> {
    let program = program(entry, programs);
    entry.no_tables(&["camera", "tty", "serial"], "a program", "process");
    if entry.has("stall_after") {
        let fix = format!("write heartbeat in [{}]", entry.child("process"));
        entry.report("stall_after", "a program has a heartbeat instead of stall_after", fix);
    }
    let table = entry.table_or_empty("process");
    let keys = ProcessKeys::read(&table);
    if table.has("args") && program.as_ref().is_some_and(|program| !program.args.is_empty()) {
        table.report("args", "on_attach gives the program arguments already", "keep those of on_attach or these");
    }
    let (shape, Hook { program, mut args }) = (shape(&table, &keys), program?);
    args.extend(keys.args);
    let process = ProcessSpec { program, args, opens: keys.opens, kind: keys.kind, shape };
    Some((NodeSpec::Process(process), Some(keys.heartbeat)))
}

/// Whether `on_attach` is the program that reads the device.
pub(crate) fn attach_is_node(section: &Section<'_>) -> bool {
    section.has("on_attach") && section.word("node") == Some(PROCESS)
}

/// The program that reads the device: named by `node`, or with `node = "process"` by `on_attach`.
fn program(section: &Section<'_>, programs: Programs<'_>) -> Option<Hook> {
    if attach_is_node(section) {
        return program::hook(section, "on_attach", programs);
    }
    let name = section.text("node")?;
    let found = programs.find(For::Node, name);
    let program = found.map_err(|(message, fix)| section.report("node", message, fix)).ok()?;
    Some(Hook { program, args: Vec::new() })
}

fn args(table: &Section<'_>, key: &str) -> Option<Vec<String>> {
    let DeValue::Array(items) = table.field(key)?.get_ref() else {
        let fix = "write args = [\"--rate\", \"100\"]: one text for each argument";
        return table.refuse(key, "args must be a list of texts", fix);
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
    Some(args)
}

/// The shape of a sample, from the keys for its kind.
fn shape(table: &Section<'_>, keys: &ProcessKeys) -> Vec<u32> {
    let word = check_samples(table, keys.kind, &["width", "height"]);
    let own: &[(&str, Option<u32>)] = match keys.kind {
        ModalityKind::Scalars => &[("channels", keys.channels)],
        ModalityKind::Image | ModalityKind::Depth => &[("height", keys.height), ("width", keys.width)],
        ModalityKind::Bytes => &[],
    };
    for (key, _) in own {
        table.need(key, &format!("samples of kind {word:?} need it: write {key} = a whole number"));
    }
    own.iter().map(|(_, value)| value.unwrap_or(1)).collect()
}
