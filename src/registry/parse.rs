//! From the text of `devices.toml` to a [`Registry`], or to a list of all its problems.
//!
//! Text -> [`toml::de::DeTable`] -> one draft per entry (`device`) -> checks between entries
//! (here) -> depths within the memory budget, and whether the window around each tick fits the rates (here).
//!
//! Invariant: no text causes a panic.
//! Invariant: all problems of a file are reported at once, each with its place and a fix.

mod button;
pub(crate) mod device;
mod export;
mod form;
mod identity;
pub(crate) mod input;
mod interlock;
mod module;
pub(crate) mod program;
mod verdict;

use std::path::Path;
use std::time::Duration;

use rapid_core::modality::{MAX_MODALITIES, ModalityId};

use super::diagnostic::{Diagnostic, RegistryErrors, did_you_mean};
use super::keys::{About, keys};
use super::kinds::{self, Word};
use super::section::{Section, file_label, read, read_file};
use super::spec::{
    DeviceSpec, ExportSpec, IdentitySpec, InferenceSpec, NodeSpec, POOL_SPARE, RESERVED_BYTES, Registry, RigSpec,
    SAMPLE_OVERHEAD,
};
use super::trust::distrust;
use super::units::{show_duration, show_size};
use device::Draft;
use program::Programs;
use verdict::Whose;

pub(super) use identity::is_port;
pub use identity::{like_a_name, name_problem};

/// The registry used when there is no file: the rig that `rapid --sim` simulates.
pub const BUILTIN: &str = include_str!("../../devices.toml");

keys! {
    /// The tables of the file.
    pub(super) const ROOT {} => {
        /// The rig.
        rig = About::Table(&[RigSpec::KEYS]);
        /// What policies are computed on.
        inference = About::Table(&[InferenceSpec::KEYS]);
        /// Which values a dataset has.
        export = About::Table(&[ExportSpec::KEYS]);
        /// Limits of the verdict for all devices.
        verdict = About::Table(verdict::OF_THE_RIG);
        /// A device, and the modality that it provides.
        device = About::Named(kinds::KEYS);
        /// What is mounted in a slot of the gripper.
        module = About::Named(&[module::ModuleKeys::KEYS]);
        /// An emergency stop or an enabling switch.
        stop = About::Named(interlock::KEYS);
        /// A pedal or button.
        button = About::Named(button::KEYS);
    }
}

/// Topics `rapid` publishes itself.
const OWN_TOPICS: [&str; 7] =
    ["/rapid/mask", "/rapid/frame", "/rapid/observation", "/rapid/event", "/rapid/log", "/action", "/tf"];

/// A registry, and the warnings about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Loaded {
    /// The registry.
    pub registry: Registry,
    /// What works but may be unexpected.
    pub warnings: Vec<Diagnostic>,
}

impl Registry {
    /// Reads `devices.toml`.
    ///
    /// # Errors
    /// When the file cannot be read, may be changed by other users while this process is root, or is invalid: then all
    /// problems.
    pub fn load(path: &Path) -> Result<Loaded, RegistryErrors> {
        let text = read_file(
            path,
            "`rapid --sim` needs no file; for real devices write one, beginning from the \
                                    devices.toml of the repository, or name another with --config FILE",
        )?;
        let mut loaded = Self::parse(&text, Some(path))?;
        // As root it would have been rejected.
        if let Ok(Some(reason)) = distrust(path) {
            let (file, message, fix) = (file_label(Some(path), ""), reason.to_string(), Some(reason.fix()));
            loaded.warnings.insert(0, Diagnostic { file, line: 0, column: 0, entry: None, message, fix });
        }
        Ok(loaded)
    }

    /// Reads the text of a `devices.toml`; `path` names it in messages, and programs are searched for
    /// beside it. Without a path they are not searched for: no program of such a registry will be run.
    ///
    /// # Errors
    /// All problems of the text.
    pub fn parse(text: &str, path: Option<&Path>) -> Result<Loaded, RegistryErrors> {
        let file = file_label(path, "devices.toml");
        let programs = path.map_or(Programs::Nowhere, Programs::Beside);
        let path = path.map(Path::to_path_buf);
        read(&file, text, |root| {
            let registry = Self { path, text: text.to_owned(), ..registry(root, programs, &file)? };
            Ok(Loaded { registry, warnings: root.warnings() })
        })
    }

    /// The registry of the simulated demonstration rig, `devices.toml` of the repository.
    ///
    /// # Panics
    /// Never: the text is part of the program, and a test parses it.
    #[expect(clippy::expect_used, reason = "a text fixed at build time, parsed by a test")]
    pub fn builtin() -> Self {
        Self::parse(BUILTIN, None).expect("the built-in devices.toml is valid").registry
    }

    /// A rig without entries, to which they are added while it runs; `path` is the file that they are written to.
    pub fn empty(path: &Path) -> Self {
        let (devices, modules, stops, buttons) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let (inference, export) = (InferenceSpec::default(), ExportSpec::default());
        Self {
            rig: RigSpec::default(),
            inference,
            export,
            devices,
            modules,
            stops,
            buttons,
            path: Some(path.to_owned()),
            text: String::new(),
        }
    }
}

/// The content of the tables of the text.
fn registry(root: &Section<'_>, programs: Programs<'_>, file: &str) -> Result<Registry, RegistryErrors> {
    root.known(&[ROOT]);
    let section = root.table_or_empty("rig");
    let rig = RigSpec::read(&section);
    let inference = InferenceSpec::read(&root.table_or_empty("inference"));
    let verdict = verdict::read(root, Whose::Rig);
    let mut drafts = drafts(root, programs);
    if drafts.is_empty() && root.is_faultless() {
        let fix = "`rapid register` adds what is plugged in; by hand, add a [device.NAME] table with vid, pid and node";
        return Err(RegistryErrors::whole_file(file.to_owned(), "no device is registered", fix));
    }
    check_identities(&drafts);
    check_streams(&drafts);
    check_topics(&drafts);
    check_expected(&section, &rig.expect, &drafts);
    check_actuators(&drafts);
    kinds::lan::check_ports(&drafts);
    kinds::lan::check_gopros(&drafts);
    kinds::lan::check_instances(&drafts);
    assign_bits(&mut drafts);
    kinds::serial::warn_of_old_names(&drafts);
    warn_of_unused_ports(&drafts);
    program::warn_of_distrusted(&drafts);
    fit(&mut drafts, rig.memory_budget, root);
    let modules = module::modules(root, &drafts);
    let stops = interlock::interlocks(root, &drafts);
    let buttons = button::buttons(root, &drafts, &stops);
    let export = root.table("export").map(|section| export::read(&section, &drafts)).unwrap_or_default();
    root.check()?;

    let mut devices: Vec<_> = drafts.into_iter().filter_map(|draft| draft.finish(&verdict, &rig)).collect();
    devices.sort_by_key(|(_, device)| device.id);
    warn_of_narrow_window(&devices, rig.sync_window);
    kinds::can::warn_of_slow_stop(&devices);
    let mut devices: Vec<_> = devices.into_iter().map(|(_, device)| device).collect();
    for device in &mut devices {
        if let NodeSpec::Lan(lan) = &mut device.node {
            lan.keep_free(rig.disk_reserve);
        }
    }
    Ok(Registry { rig, inference, export, devices, modules, stops, buttons, path: None, text: String::new() })
}

/// One draft per entry, in the order of the file.
fn drafts<'a>(root: &Section<'a>, programs: Programs<'_>) -> Vec<Draft<'a>> {
    if let Some((at, ..)) = root.fields().iter().find(|(_, key, value)| *key == "device" && value.get_ref().is_array())
    {
        let fix = "write each entry as a separate table, [device.NAME], without `name =`";
        root.report_at(*at, "[[device]] lists belong to rapid_driver's registry", fix);
        return Vec::new();
    }
    let Some(devices) = root.table("device") else { return Vec::new() };
    let mut drafts = Vec::new();
    for (at, name, value) in devices.fields() {
        if let Some(table) = value.get_ref().as_table() {
            let draft = device::read(name, devices.part(table, at, devices.child(name)), programs);
            let streams = device::streams(&draft, programs);
            drafts.push(draft);
            drafts.extend(streams);
            if drafts.len() > MAX_MODALITIES {
                let message =
                    format!("more than {MAX_MODALITIES} devices: the mask has one bit for each and is 64 bits wide");
                devices.report_child(at, name, message, "remove entries that are not used, or run two rigs");
                drafts.truncate(MAX_MODALITIES);
                break;
            }
        } else {
            devices.report_child(at, name, format!("{name:?} is not a table"), "write it as a table [device.NAME]");
        }
    }
    drafts
}

/// Two entries may not identify the same unit: the same serial number, or the same port where there is
/// no serial number. Entries with neither are interchangeable units and may repeat. A composite
/// device may have one entry for its camera and one for its serial line.
fn check_identities(drafts: &[Draft<'_>]) {
    for (index, draft) in drafts.iter().enumerate() {
        let Some(identity) = draft.identity.as_ref().and_then(IdentitySpec::usb) else { continue };
        let same_unit = |other: &&Draft<'_>| {
            let Some(earlier) = other.identity.as_ref().and_then(IdentitySpec::usb) else { return false };
            let same_model = (earlier.vid, earlier.pid, other.opens()) == (identity.vid, identity.pid, draft.opens());
            let same_place = match (&identity.serial, &earlier.serial) {
                (Some(serial), Some(earlier)) => serial == earlier,
                (None, None) => identity.port.is_some() && identity.port == earlier.port,
                _ => false,
            };
            let is_stream = |one: &Draft<'_>, of: &Draft<'_>| one.stream_of.as_ref() == Some(&of.name);
            let is_other_stream =
                is_stream(draft, other) || (draft.stream_of.is_some() && draft.stream_of == other.stream_of);
            same_model && same_place && !is_other_stream
        };
        let Some(earlier) = drafts.iter().take(index).find(same_unit) else { continue };
        let (key, what) = match identity.serial {
            Some(_) if draft.section.has("serial_number") => ("serial_number", "serial number"),
            Some(_) => ("serial", "serial number"),
            None => ("port", "port"),
        };
        let message =
            format!("same vid, pid and {what} as [{}] on line {}", earlier.section.entry, earlier.section.line());
        let fix = format!("give each entry the {what} of its own unit; one physical device is one entry");
        draft.section.report(key, message, fix);
    }
}

/// The streams of a camera are distinguished by their pixel formats, and their entries by their names.
fn check_streams(drafts: &[Draft<'_>]) {
    for (index, draft) in drafts.iter().enumerate() {
        let Some(owner) = &draft.stream_of else { continue };
        if let Some(other) = drafts.iter().enumerate().find(|(at, other)| *at != index && other.name == draft.name) {
            let message = format!("it is called {:?}, as is [{}]", draft.name, other.1.section.entry);
            draft.section.report_at(draft.section.at, message, "give one of them another name");
        }
        let is_of_it = |other: &&Draft<'_>| other.name == *owner || other.stream_of.as_ref() == Some(owner);
        let same = |other: &&Draft<'_>| other.format().is_some() && other.format() == draft.format();
        let Some(earlier) = drafts.iter().take(index).filter(is_of_it).find(same) else { continue };
        let format = draft.format().map(|format| format.to_string()).unwrap_or_default();
        let message =
            format!("pictures in {format}, as of [{}]: nothing else distinguishes the streams", earlier.section.entry);
        draft.section.report(
            "camera",
            message,
            "write the format of the other capture node: `rapid devices --formats` lists it",
        );
    }
}

fn warn_of_unused_ports(drafts: &[Draft<'_>]) {
    for draft in drafts {
        let usb = draft.identity.as_ref().and_then(IdentitySpec::usb);
        if usb.is_some_and(|usb| usb.serial.is_some() && usb.port.is_some()) {
            let message = "port has no effect beside a serial number: the unit is recognised in every port";
            let fix = "remove port, or remove the serial number to accept any unit in that port";
            draft.section.warn_at(draft.section.at_of("port"), message, fix);
        }
    }
}

fn check_topics(drafts: &[Draft<'_>]) {
    for (index, draft) in drafts.iter().enumerate() {
        if OWN_TOPICS.contains(&draft.topic.as_str()) {
            let message = format!("topic {:?} is published by rapid itself", draft.topic);
            let fix = format!("choose another, for example {:?}", device::default_topic(draft.kind, &draft.name));
            draft.section.report("topic", message, fix);
        }
        let has_it = |(at, other): &(usize, &Draft<'_>)| {
            let endings = other.form.as_ref().map(|form| [Some(form.ending()), form.further_ending()]);
            let mut derived = endings.into_iter().flatten().flatten().map(|ending| format!("{}{ending}", other.topic));
            (*at < index && other.topic == draft.topic) || derived.any(|topic| topic == draft.topic)
        };
        let Some((_, earlier)) = drafts.iter().enumerate().find(has_it) else { continue };
        let message = format!(
            "topic {:?} is already used by [{}] on line {}",
            draft.topic,
            earlier.section.entry,
            earlier.section.line()
        );
        let fix = format!("choose another, for example {:?}", format!("{}/{}", draft.topic, draft.name));
        draft.section.report("topic", message, fix);
    }
}

/// The entries of which every episode must contain samples.
fn check_expected(rig: &Section<'_>, expected: &[String], drafts: &[Draft<'_>]) {
    for (index, name) in expected.iter().enumerate() {
        if !drafts.iter().any(|draft| draft.name == *name) {
            let fix = did_you_mean(name, names(drafts), "entries are");
            rig.report("expect", format!("expect: there is no [device.{name}]"), fix);
        } else if expected.iter().take(index).any(|earlier| earlier == name) {
            rig.report("expect", format!("expect: {name:?} is in the list twice"), "name it once");
        }
    }
}

/// Names of the entries.
fn names<'d>(drafts: &'d [Draft<'_>]) -> impl Iterator<Item = &'d str> {
    drafts.iter().map(|draft| draft.name.as_str())
}

/// An action contains no device name: it is for the only actuator.
fn check_actuators(drafts: &[Draft<'_>]) {
    let mut actuators = drafts.iter().filter(|draft| draft.action.is_some());
    let Some(first) = actuators.next() else { return };
    for draft in actuators {
        let message = format!("[{}] is an actuator already, and a rig has one", first.section.entry);
        let fix = "remove one of the two action tables; the motors of a CAN bus have one automatically";
        draft.section.report("action", message, fix);
    }
}

/// Gives entries without a bit the lowest free one, in the order of the file, after all explicit bits
/// are taken.
fn assign_bits(drafts: &mut [Draft<'_>]) {
    let written: Vec<u8> = drafts.iter().filter_map(|draft| draft.bit).collect();
    let mut free = (0..64).filter(move |bit| !written.contains(bit));
    // Explicit bits, and their lines.
    let mut taken: Vec<(u8, usize)> = Vec::new();
    for draft in drafts {
        let section = &draft.section;
        if let Some(bit) = draft.bit {
            if let Some((_, line)) = taken.iter().find(|(earlier, _)| *earlier == bit) {
                let message = format!("bit {bit} is already taken on line {line}");
                let fix =
                    free.clone().next().map_or("choose another".to_owned(), |free| format!("bit = {free} is free"));
                section.report("bit", message, fix);
            }
            taken.push((bit, section.line_of("bit")));
            draft.id = ModalityId::new(bit);
            continue;
        }
        // An explicit but invalid bit has been reported; none is assigned.
        if section.has("bit") {
            continue;
        }
        let Some(bit) = free.next() else { continue };
        draft.id = ModalityId::new(bit);
        let message = format!("no bit given, it gets bit {bit}: another entry above it would move it");
        let fix = format!("pin it with bit = {bit}; a policy is trained on bit positions");
        section.warn_at(section.at, message, fix);
    }
}

/// Fewer pictures than this cannot cover the pauses of a writer.
const LEAST_CAMERA_DEPTH: u64 = 8;

/// Lowers the default depths of cameras, all in proportion, until the topics fit into `budget`. Depths written in the
/// file stay. If the total is still too large, a problem names the largest topics. Lowered depths cause a warning.
fn fit(drafts: &mut [Draft<'_>], budget: u64, root: &Section<'_>) {
    let scaled = |draft: &Draft<'_>, permille: u64| {
        if draft.depth_written || draft.kind != Some(Word::Camera) {
            return draft.depth;
        }
        // Depths are at most 4096: no overflow.
        (draft.depth * permille / 1000).max(LEAST_CAMERA_DEPTH)
    };
    let total = |drafts: &[Draft<'_>], permille| -> u64 {
        drafts.iter().map(|draft| pool(draft, scaled(draft, permille))).fold(RESERVED_BYTES, u64::saturating_add)
    };
    if total(drafts, 0) > budget {
        return report(drafts, total(drafts, 0), budget, root);
    }
    let permille = (0..=1000).rev().find(|permille| total(drafts, *permille) <= budget).unwrap_or(0);
    for draft in drafts {
        let depth = scaled(draft, permille);
        if depth < draft.depth {
            let message = format!(
                "depth lowered from {} to {depth} to keep all topics within memory_budget = {}",
                draft.depth,
                show_size(budget)
            );
            let fix = format!("write depth = {depth}, a smaller max_bytes, or a larger memory_budget in [rig]");
            draft.section.warn_at(draft.section.at, message, fix);
        }
        draft.depth = depth;
    }
}

/// Shared memory that the topic of `draft` takes with this depth, in bytes.
fn pool(draft: &Draft<'_>, depth: u64) -> u64 {
    let sample = draft.max_bytes.saturating_add(SAMPLE_OVERHEAD as u64);
    sample.saturating_mul(depth + POOL_SPARE as u64)
}

fn report(drafts: &[Draft<'_>], total: u64, budget: u64, root: &Section<'_>) {
    let size = |draft: &Draft<'_>| {
        let depth =
            if draft.depth_written || draft.kind != Some(Word::Camera) { draft.depth } else { LEAST_CAMERA_DEPTH };
        (pool(draft, depth), depth)
    };
    let mut largest: Vec<_> = drafts.iter().map(|draft| (size(draft), draft)).collect();
    largest.sort_by_key(|((bytes, _), _)| std::cmp::Reverse(*bytes));
    let named: Vec<String> = largest
        .iter()
        .take(3)
        .map(|((bytes, depth), draft)| {
            let samples = depth + POOL_SPARE as u64;
            format!("{} {} ({} x {samples})", draft.name, show_size(*bytes), show_size(draft.max_bytes))
        })
        .collect();
    let message = format!(
        "the topics need {} of shared memory, more than memory_budget = {}; largest: {}",
        show_size(total),
        show_size(budget),
        named.join(", ")
    );
    let fix = "lower max_bytes, depth or the pictures' size of these, or raise memory_budget in [rig]";
    root.report_child(root.at_of("rig"), "rig", message, fix);
}

/// Warns of every device that is so slow that ticks without a sample in `window` alone make an episode SUSPECT.
fn warn_of_narrow_window(devices: &[(Section<'_>, DeviceSpec)], window: Duration) {
    for (section, device) in devices {
        let (Some(hz), Some(least)) = (device.verdict.hz, device.verdict.suspect.valid) else { continue };
        // A tick has a sample if one lies within the window before or after it, whatever their phase.
        let share = hz * 2.0 * window.as_secs_f64();
        if share >= least.min(1.0) {
            continue;
        }
        let shown = show_duration(window);
        let message = format!(
            "at {hz} samples a second only {:.0} % of the ticks have one within sync_window = {shown}: every episode is SUSPECT",
            share * 100.0
        );
        // Half of the time between two samples, rounded up to a millisecond.
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let wide = show_duration(Duration::from_millis((500.0 / hz).ceil() as u64));
        let fix = format!("write sync_window = \"{wide}\" in [rig], or valid = \"off\" in [{}.verdict]", section.entry);
        section.warn_at(section.at, message, fix);
    }
}

#[cfg(test)]
mod tests;
