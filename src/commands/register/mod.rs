//! `rapid register` and `rapid unregister`: entries of `devices.toml` for connected devices.
//!
//! Missing values are requested on a terminal.
//!
//! Invariant: nothing is written that the parser rejects.
//! Invariant: the file is replaced atomically, and only if it has not changed since it was read.

mod fields;
mod import;

use std::io::{self, BufRead, Write};
use std::path::Path;
use std::time::Duration;

use rapid_core::sample::Encoding;
use rapid_core::text;
use rapid_devices::driver::serial::Serial;
use rapid_devices::driver::{Driver, DriverError};
use rapid_registry::candidate::unregistered;
use rapid_registry::device::{Attachment, DeviceNode};
use rapid_registry::edit::{self, EditError, NewEntry, Setting};
use rapid_registry::{DeviceSpec, Framing, NodeSpec, Parse, Registry, RegistryErrors, SerialSpec};
use serde::Serialize;
use tokio::time::{Instant, timeout_at};

use self::fields::{Selection, choose, identity, name, node, settings, slot};
use super::artifacts::ArtifactsError;
use super::modules::{self, ModulesError};
use super::{Format, artifacts};
use crate::cli::{RegisterArgs, UnregisterArgs};
use crate::registration::settings::lines_look_like;
use crate::registration::{Target, WriteError, comments, free_bit};

pub use import::ImportError;

/// Why nothing was registered.
#[derive(Debug, thiserror::Error)]
pub enum RegisterError {
    /// The new text would not be a registry.
    #[error("{0}\nnothing was written; the lines are those of the file with the new entry")]
    Refused(RegistryErrors),
    /// A key cannot be written.
    #[error("{0}")]
    Edit(#[from] EditError),
    /// A value is missing and there is no terminal to ask on.
    #[error("{} must be given: there is no terminal to ask on", .0.join(", "))]
    Missing(Vec<&'static str>),
    /// Every connected device has an entry.
    #[error("no device without an entry is plugged in: plug it in, or describe it with --vid, --pid and --name")]
    NothingNew,
    /// Several units match.
    #[error("several connected units match: name one with --serial or --port{}", .0.iter().flat_map(|unit| ["\n  ", unit]).collect::<String>())]
    Several(Vec<String>),
    /// The input ended before an answer.
    #[error("no answer: nothing was written")]
    Ended,
    /// The bit of another entry would change.
    #[error(
        "removing [device.{name}] would move {moved}, and a policy is trained on bits\n    fix: give these \
         entries a `bit` first (`rapid check` lists those without)"
    )]
    BitsMove {
        /// The entry.
        name: String,
        /// Which entries, and their bits.
        moved: String,
    },
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The registry is written, its system files are not.
    #[error("the registry is written, its system files are not: {0}")]
    Artifacts(#[from] ArtifactsError),
    /// The type of module.
    #[error(transparent)]
    Module(#[from] ModulesError),
    /// The registry has a module of this name.
    #[error("[module.{0}] is in the registry already: give the new one another name with --name")]
    HasModule(String),
    /// Each of its sensors needs a unit of its own.
    #[error("module {name} has {} sensors without an entry ({}): register each, then the module", sensors.len(), sensors.join(", "))]
    SeveralSensors {
        /// The type of module.
        name: String,
        /// Their names.
        sensors: Vec<String>,
    },
    /// Nothing of a unit is registered.
    #[error(
        "module {0} has no sensor that needs an entry: leave out what is given of a unit (--vid, --serial, --bit ...)"
    )]
    NoSensor(String),
    /// It is a part of another entry.
    #[error("[device.{0}] is a further stream of a camera: remove its table [device.CAMERA.stream.NAME] in {1}")]
    IsStream(String, String),
    /// The file to import.
    #[error(transparent)]
    Import(#[from] ImportError),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

impl RegisterError {
    /// Whether the arguments are at fault.
    pub const fn is_bad_argument(&self) -> bool {
        !matches!(self, Self::Ended | Self::Write(_) | Self::Artifacts(_) | Self::Output(_))
    }
}

/// Registers a device from `args` and the answers.
///
/// # Errors
/// When a value is missing or the parser rejects the entry; nothing is written then.
pub async fn register(
    target: &Target,
    attached: &[Attachment],
    args: &RegisterArgs,
    mut talk: Option<Dialogue<'_>>,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), RegisterError> {
    let units = unregistered(target.registry.as_ref(), attached);
    if let Some(file) = &args.import {
        let entries = import::read(file, args.layout.as_deref(), args.node.as_deref(), attached, target)?;
        return commit(target, &entries, &[], talk.as_mut(), args, format, out);
    }
    let module = args.module.as_deref().map(|name| Mounting::new(name, args, target)).transpose()?;
    let module = match module {
        Some(Mounting { entry: None, text, .. }) => {
            return commit(target, &[], &[text], talk.as_mut(), args, format, out);
        }
        module => module,
    };
    let args = module.as_ref().and_then(|module| module.entry.as_ref()).unwrap_or(args);
    let parts: Vec<String> = module.iter().map(|module| module.text.clone()).collect();
    let unit = match choose(&units, args, talk.as_mut(), format, out)? {
        Selection::Nothing => return Ok(()),
        Selection::NotPlugged => None,
        Selection::Unit(unit) => Some(unit),
    };
    let unit = unit.as_deref();
    let name = name(target.registry.as_ref(), unit, args, talk.as_mut())?;
    let node = node(unit, args, talk.as_mut())?;
    let mut entry = NewEntry { name, comments: comments(unit), keys: Vec::new(), held_back: None };
    let text = |key: &str, value: String| (key.to_owned(), Setting::Text(value));
    let (vid, pid) = (unit.map(|unit| unit.usb.vid).or(args.vid), unit.map(|unit| unit.usb.pid).or(args.pid));
    entry.keys.extend(vid.map(|vid| text("vid", format!("{vid:04x}"))));
    entry.keys.extend(pid.map(|pid| text("pid", format!("{pid:04x}"))));
    entry.keys.extend(identity(unit, args, talk.as_mut())?.into_iter().map(|(key, value)| text(key, value)));
    entry.keys.push(text("node", node.clone()));
    entry.keys.extend(slot(args, talk.as_mut())?.map(|slot| text("slot", slot)));
    let bit = args.bit.or_else(|| free_bit(target.registry.as_ref(), &[]));
    entry.keys.extend(bit.map(|bit| ("bit".to_owned(), Setting::Whole(bit.into()))));
    entry.keys.extend(settings(unit, &node, args, talk.as_mut()).await?);
    // `serial.` is the old name of that table.
    let named = |key: &str| key.strip_prefix("serial.").map_or_else(|| key.to_owned(), |key| format!("tty.{key}"));
    entry.keys.extend(args.set.iter().map(|(key, value)| (named(key), Setting::Typed(value.clone()))));
    if let Some(node) = unit.and_then(|unit| unit.node(&node).or_else(|| unit.nodes.first()))
        && (args.test || talk.is_some())
    {
        let parsed = target.parse(&edit::append(&target.base(), std::slice::from_ref(&entry))?);
        let parsed = parsed.map_err(RegisterError::Refused)?;
        if let Some(spec) = parsed.registry.named(&entry.name) {
            let report = read(spec, &node.node).await;
            match (talk.as_mut(), format) {
                (Some(talk), _) => talk.print(&report)?,
                (None, Format::Text) => writeln!(out, "{}", text::plain(&report))?,
                (None, Format::Json) => {}
            }
        }
    }
    commit(target, &[entry], &parts, talk.as_mut(), args, format, out)
}

/// A module that is to be added.
struct Mounting {
    /// The arguments by which an entry is made for its sensor; `None` if it has none, or all of them have entries.
    entry: Option<RegisterArgs>,
    /// The lines of its table.
    text: String,
}

impl Mounting {
    /// Of this type. `--name` is the name of the module and of its sensor.
    fn new(name: &str, args: &RegisterArgs, target: &Target) -> Result<Self, RegisterError> {
        let descriptor = modules::descriptor(name)?;
        let registry = target.registry.as_ref();
        let module = args.name.clone().unwrap_or_else(|| descriptor.name.clone());
        if registry.is_some_and(|registry| registry.modules.iter().any(|other| other.name == module)) {
            return Err(RegisterError::HasModule(module));
        }
        let is_new = |sensor: &str| registry.is_none_or(|registry| registry.named(sensor).is_none());
        let new: Vec<_> =
            descriptor.sensors.iter().filter(|(sensor, _)| args.name.is_some() || is_new(sensor)).collect();
        let (mut devices, mut transforms) = (descriptor.devices.clone(), descriptor.transforms.clone());
        let entry = match new.as_slice() {
            [] => {
                let is_of_unit =
                    args.vid.is_some() || args.pid.is_some() || args.serial.is_some() || args.port.is_some();
                if is_of_unit || args.bit.is_some() || !args.set.is_empty() || args.test {
                    return Err(RegisterError::NoSensor(descriptor.name));
                }
                None
            }
            [(sensor, keys)] => {
                let own = args.name.clone().unwrap_or_else(|| sensor.clone());
                let placed = transforms.iter_mut().map(|(device, _)| device);
                let named = devices.iter_mut().chain(placed).filter(|device| *device == sensor);
                named.for_each(|device| device.clone_from(&own));
                let node = keys.iter().find_map(|(key, value)| match value {
                    Setting::Text(node) if key == "node" => Some(node.clone()),
                    _ => None,
                });
                let set = keys.iter().filter(|(key, _)| key != "node").map(|(key, value)| (key.clone(), value.typed()));
                let set = set.chain(args.set.iter().cloned()).collect();
                let slot = Some(descriptor.mount.to_string());
                Some(RegisterArgs { name: Some(own), node, slot, set, ..args.clone() })
            }
            several => {
                let sensors = several.iter().map(|(sensor, _)| sensor.clone()).collect();
                return Err(RegisterError::SeveralSensors { name: descriptor.name, sensors });
            }
        };
        let text = edit::module(&module, descriptor.mount.word(), (&descriptor.tags, &devices), &transforms)?;
        Ok(Self { entry, text })
    }
}

/// Removes an entry.
///
/// # Errors
/// When there is no such entry, or the rest would not be a valid registry.
pub fn unregister(
    target: &Target,
    args: &UnregisterArgs,
    talk: Option<Dialogue<'_>>,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), RegisterError> {
    let is_known = target.registry.as_ref().is_some_and(|registry| registry.named(&args.name).is_some());
    let new = match edit::remove(&edit::renamed(&target.text), &args.name) {
        Err(EditError::NoEntry(name)) if is_known => {
            return Err(RegisterError::IsStream(name, target.path.display().to_string()));
        }
        new => new?,
    };
    let left = target.parse(&new).map_err(RegisterError::Refused)?.registry;
    let before = target.registry.as_ref().map(|registry| registry.devices.as_slice()).unwrap_or_default();
    let moved: Vec<String> = before
        .iter()
        .filter_map(|entry| Some((entry, left.named(&entry.name)?)))
        .filter(|(entry, now)| entry.id != now.id)
        .map(|(entry, now)| format!("[device.{}] from bit {} to bit {}", entry.name, entry.id.bit(), now.id.bit()))
        .collect();
    // Its further streams are modalities of their own.
    let is_gone = |entry: &&DeviceSpec| entry.name != args.name && left.named(&entry.name).is_none();
    let streams: Vec<&str> = before.iter().filter(is_gone).map(|entry| entry.name.as_str()).collect();
    if !moved.is_empty() {
        return Err(RegisterError::BitsMove { name: args.name.clone(), moved: moved.join(", ") });
    }
    if let Some(mut talk) = talk.filter(|_| !args.yes && !args.dry_run)
        && !talk.agrees(&format!("Remove [device.{}]{} from {}", args.name, with(&streams), target.path.display()))?
    {
        talk.print("Nothing was written.")?;
        return Ok(());
    }
    let mut written_files = Vec::new();
    if !args.dry_run {
        write(target, &new, &left, &mut written_files)?;
    }
    match format {
        Format::Json => {
            let file = target.path.to_string_lossy();
            let line = serde_json::json!({ "event": "unregistered", "name": args.name, "file": file, "dry_run": args.dry_run });
            writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)?;
        }
        Format::Text if args.dry_run => out.write_all(new.as_bytes())?,
        Format::Text => {
            out.write_all(&written_files)?;
            writeln!(out, "removed [device.{}]{}", args.name, with(&streams))?;
        }
    }
    Ok(())
}

fn with(streams: &[&str]) -> String {
    if streams.is_empty() { String::new() } else { format!(" with its streams {}", streams.join(", ")) }
}

/// Parses, shows, asks, writes.
fn commit(
    target: &Target,
    entries: &[NewEntry],
    more: &[String],
    talk: Option<&mut Dialogue<'_>>,
    args: &RegisterArgs,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), RegisterError> {
    let mut written: Vec<String> = entries.iter().map(edit::written).collect::<Result<_, _>>()?;
    written.extend_from_slice(more);
    let new = edit::append_lines(&target.base(), &written);
    let parsed = target.parse(&new).map_err(RegisterError::Refused)?;
    let shown = written.join("\n");
    if let Some(talk) = talk.filter(|_| !args.yes && !args.dry_run) {
        talk.print(&format!("\n{shown}"))?;
        if !talk.agrees(&format!("Add this to {}", target.path.display()))? {
            talk.print("Nothing was written.")?;
            return Ok(());
        }
    } else if format == Format::Text {
        for line in shown.lines() {
            writeln!(out, "{}", text::plain(line))?;
        }
    }
    let mut written_files = Vec::new();
    if !args.dry_run {
        write(target, &new, &parsed.registry, &mut written_files)?;
    }
    if format == Format::Text {
        out.write_all(&written_files)?;
        if !args.dry_run {
            let is_taken_over = |entry: &NewEntry| {
                let node = parsed.registry.named(&entry.name).map(|device| &device.node);
                matches!(node, Some(NodeSpec::Camera(_) | NodeSpec::Serial(_) | NodeSpec::Lan(_)))
            };
            if entries.iter().all(is_taken_over) {
                writeln!(out, "a running rapid takes it over: rapid reload")?;
            } else {
                writeln!(out, "a running rapid takes it over when it is started again")?;
            }
            writeln!(out, "for stable device names, install the udev rules: rapid artifacts --help")?;
        }
        return Ok(());
    }
    for (entry, text) in entries.iter().zip(&written) {
        let spec = parsed.registry.named(&entry.name);
        let line = Registered {
            event: if entry.held_back.is_some() { "held_back" } else { "registered" },
            name: &entry.name,
            bit: spec.map(|spec| spec.id.bit()),
            file: target.path.to_string_lossy().into_owned(),
            entry: text,
            dry_run: args.dry_run,
        };
        writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)?;
    }
    for module in more {
        let line = serde_json::json!({ "event": "registered_module", "file": target.path.to_string_lossy(),
            "entry": module, "dry_run": args.dry_run });
        writeln!(out, "{}", text::json(&line).map_err(io::Error::from)?)?;
    }
    Ok(())
}

/// An entry that was added, as JSON.
#[derive(Serialize)]
struct Registered<'a> {
    event: &'static str,
    name: &'a str,
    bit: Option<u8>,
    file: String,
    entry: &'a str,
    dry_run: bool,
}

/// A dialogue in plain lines: works on any terminal, over ssh, and in a test.
pub struct Dialogue<'a> {
    /// Answers.
    pub input: &'a mut dyn BufRead,
    /// Questions.
    pub out: &'a mut dyn Write,
}

impl Dialogue<'_> {
    /// Prints one or several lines.
    fn print(&mut self, line: &str) -> io::Result<()> {
        for line in line.split('\n') {
            writeln!(self.out, "{}", text::plain(line))?;
        }
        self.out.flush()
    }

    /// Asks until `take` accepts the answer; an empty line is the default.
    fn ask<T>(
        &mut self,
        question: &str,
        default: Option<&str>,
        mut take: impl FnMut(&str) -> Result<T, String>,
    ) -> Result<T, RegisterError> {
        /// Longer than any answer.
        const LONGEST: u64 = 4096;
        loop {
            let shown = default.map_or_else(String::new, |default| format!(" [{default}]"));
            write!(self.out, "{}{}: ", text::plain(question), text::plain(&shown))?;
            self.out.flush()?;
            let mut line = Vec::new();
            if io::Read::take(&mut *self.input, LONGEST).read_until(b'\n', &mut line)? == 0 {
                writeln!(self.out)?;
                return Err(RegisterError::Ended);
            }
            let line = String::from_utf8_lossy(&line);
            let answer = match (line.trim(), default) {
                ("", Some(default)) => default,
                (answer, _) => answer,
            };
            match take(answer) {
                Ok(taken) => return Ok(taken),
                Err(why) => self.print(&format!("  {why}"))?,
            }
        }
    }

    /// Yes or no; an empty line is yes.
    fn agrees(&mut self, question: &str) -> Result<bool, RegisterError> {
        self.ask(question, Some("y"), |answer| match answer.to_lowercase().as_str() {
            "y" | "yes" => Ok(true),
            "n" | "no" => Ok(false),
            _ => Err("enter y or n".to_owned()),
        })
    }
}

/// Writes this text to the file, and the system files beside it.
fn write(target: &Target, new: &str, registry: &Registry, out: &mut dyn Write) -> Result<(), RegisterError> {
    let parent = target.write(new)?;
    writeln!(out, "wrote {}", target.path.display())?;
    Ok(artifacts::write(registry, &parent.join("udev"), out)?)
}

/// How long a device is read.
const READING: Duration = Duration::from_secs(2);
/// A device that takes longer to open has failed.
const OPENING: Duration = Duration::from_secs(5);
/// Number of samples that is enough.
const ENOUGH: u32 = 200;
/// Lines of a serial device that are examined.
const LINES: usize = 20;

/// Opens the device as a rig would, reads for up to 2 s and describes the samples.
async fn read(spec: &DeviceSpec, node: &DeviceNode) -> String {
    if let NodeSpec::Process(_) = spec.node {
        return "Test: skipped, the program of the entry reads it; test it with `rapid --headless`.".to_owned();
    }
    let opened = tokio::time::timeout(OPENING, Driver::open(spec, node)).await;
    let mut driver = match opened.unwrap_or_else(|_| Err(DriverError::Retry("it does not open".to_owned()))) {
        Ok(driver) => driver,
        Err(error) => return format!("Test: {}: {error}", node.label()),
    };
    let description = driver.description();
    let begun = Instant::now();
    let mut stats = SampleStats::default();
    while stats.samples < ENOUGH {
        match timeout_at(begun + READING, driver.read()).await {
            Err(_) => break,
            Ok(Ok(reading)) => stats.add(reading.encoding, reading.bytes, (reading.width, reading.height)),
            Ok(Err(error)) => return format!("Test: {description}: {error}"),
        }
    }
    format!("Test: {description}: {}", stats.describe(begun.elapsed()))
}

#[derive(Default)]
struct SampleStats {
    samples: u32,
    bytes: u64,
    first: String,
}

impl SampleStats {
    fn add(&mut self, encoding: Encoding, bytes: &[u8], (width, height): (u32, u32)) {
        if self.samples == 0 {
            self.first = match encoding {
                Encoding::F64 => {
                    let (numbers, _) = bytes.as_chunks::<8>();
                    let shown: Vec<_> =
                        numbers.iter().take(6).map(|n| format!("{:.4}", f64::from_le_bytes(*n))).collect();
                    let more = if numbers.len() > shown.len() { ", ..." } else { "" };
                    format!("first values {}{more}", shown.join(", "))
                }
                Encoding::Bytes => {
                    format!("first bytes {:?}", String::from_utf8_lossy(bytes.get(..40).unwrap_or(bytes)))
                }
                _ => format!("{width}x{height} pixels"),
            };
        }
        self.samples += 1;
        self.bytes += bytes.len() as u64;
    }

    fn describe(&self, elapsed: Duration) -> String {
        if self.samples == 0 {
            return format!("it sent nothing in {}", text::about(elapsed));
        }
        let hz = f64::from(self.samples) / elapsed.as_secs_f64().max(1e-3);
        let size = text::size(self.bytes / u64::from(self.samples));
        let samples = text::counted(u64::from(self.samples), "sample");
        format!("{samples}, {} per second, {size} each, {}", text::hertz(hz), self.first)
    }
}

/// Listens to a serial device for up to 2 s; returns the settings to parse its lines, if it sends lines.
async fn listen(path: &Path, baud: u32) -> Result<Option<Vec<(String, Setting)>>, DriverError> {
    /// Long enough for a line of a thousand numbers.
    const LONGEST_LINE: usize = 16 << 10;
    let raw = SerialSpec { baud, framing: Framing::Line, parse: Parse::Raw, channels: 0 };
    let opened = tokio::time::timeout(OPENING, Serial::open(&raw, path, LONGEST_LINE)).await;
    let mut driver = opened.unwrap_or_else(|_| Err(DriverError::Retry("it does not open".to_owned())))?;
    let end = Instant::now() + READING;
    let mut lines = Vec::new();
    while lines.len() < LINES {
        match timeout_at(end, driver.read()).await {
            Err(_) => break,
            Ok(reading) => lines.push(reading?.bytes.to_vec()),
        }
    }
    Ok(lines_look_like(&lines))
}

#[cfg(test)]
mod tests;
