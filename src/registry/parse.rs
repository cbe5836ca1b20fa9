//! From the text of `devices.toml` to a [`Registry`], or to everything that is wrong with it.
//!
//! Text -> [`toml::de::DeTable`] -> one draft an entry (`device`) -> checks between entries
//! (here) -> depths within the memory budget (`budget`).
//!
//! Invariant: no text makes this panic.
//! Invariant: all problems of a file are reported at once, each with its place and a fix.

mod action;
mod budget;
mod can;
mod device;
mod file;
mod hooks;
mod identity;
mod interlock;
mod lan;
mod module;
mod motors;
mod name;
mod node;
mod process;
mod program;
mod verdict;
mod window;

use std::path::Path;
use std::time::Duration;

use super::diagnostic::{Diagnostic, RegistryErrors, did_you_mean};
use super::section::{At, Problems, Section, file_label, read};
use super::spec::{IdentitySpec, NodeSpec, Registry, RigSpec};
use super::trust::distrust;
use crate::modality::{MAX_MODALITIES, ModalityId};
use device::Draft;
use program::Programs;
use verdict::Whose;

pub use file::read_file;
pub(super) use identity::is_port;
pub use name::{like_a_name, name_problem};

/// The registry used when there is no file: the rig `rapid --sim` simulates.
pub const BUILTIN: &str = include_str!("../../devices.toml");

/// Topics `rapid` publishes itself.
const OWN_TOPICS: [&str; 5] = ["/rapid/mask", "/rapid/frame", "/rapid/event", "/rapid/log", "/action"];

/// A registry, and what should be known about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Loaded {
    /// The registry.
    pub registry: Registry,
    /// What works but will surprise.
    pub warnings: Vec<Diagnostic>,
}

impl Registry {
    /// Reads `devices.toml`.
    ///
    /// # Errors
    /// When the file cannot be read, may be changed by other users while we are root, or says
    /// something that is wrong: then all of it.
    pub fn load(path: &Path) -> Result<Loaded, RegistryErrors> {
        let text = read_file(
            path,
            "`rapid --sim` needs no file; for real devices write one, beginning from the \
                                    devices.toml of the repository, or name another with --config FILE",
        )?;
        let mut loaded = Self::parse(&text, Some(path))?;
        // As root it would have been refused.
        if let Ok(Some(reason)) = distrust(path) {
            let (file, message, fix) = (file_label(Some(path), ""), reason.to_string(), Some(reason.fix()));
            loaded.warnings.insert(0, Diagnostic { file, line: 0, column: 0, entry: None, message, fix });
        }
        Ok(loaded)
    }

    /// Reads the text of a `devices.toml`; `path` names it in messages, and programs are looked for
    /// beside it. Without a path they are not looked for: nothing of such a registry will be run.
    ///
    /// # Errors
    /// All that is wrong with the text.
    pub fn parse(text: &str, path: Option<&Path>) -> Result<Loaded, RegistryErrors> {
        let file = file_label(path, "devices.toml");
        let mut problems = Problems::new(file.clone(), text);
        let document = read(text, &mut problems);
        problems.check()?;
        let root = Section::new(document.get_ref(), 0, String::new());
        root.allow(&mut problems, &["rig", "verdict", "device", "module", "stop"]);
        let mut rig = rig(&root, &mut problems);
        let verdict = verdict::read(&root, Whose::Rig, &mut problems);
        let programs = path.map_or(Programs::Nowhere, Programs::Beside);
        let mut drafts = drafts(&root, programs, &mut problems);
        if drafts.is_empty() && problems.is_empty() {
            return Err(nothing_registered(file));
        }
        check_identities(&drafts, &mut problems);
        check_topics(&drafts, &mut problems);
        rig.expect = expected(&root, &drafts, &mut problems);
        check_actuators(&drafts, &mut problems);
        lan::check_ports(&drafts, &mut problems);
        let mut warnings = assign_bits(&mut drafts, &mut problems);
        warnings.extend(unused_ports(&drafts, &problems));
        warnings.extend(drafts.iter().flat_map(|draft| program::distrusted(draft, &problems)));
        warnings.extend(budget::fit(&mut drafts, rig.memory_budget, root.at_of("rig"), &mut problems));
        let modules = module::modules(&root, &drafts, &mut problems);
        let stops = interlock::interlocks(&root, &drafts, &mut problems, &mut warnings);
        problems.check()?;
        let entries = window::entries(&drafts);
        let mut devices: Vec<_> = drafts.into_iter().filter_map(|draft| draft.finish(&verdict)).collect();
        devices.sort_by_key(|device| device.id);
        warnings.extend(window::too_narrow(&devices, &entries, rig.sync_window, &problems));
        warnings.extend(motors::slow_to_stop(&devices, &entries, &problems));
        for device in &mut devices {
            if let NodeSpec::Lan(lan) = &mut device.node {
                lan.keep_free(rig.disk_reserve);
            }
        }
        let registry = Self { rig, devices, modules, stops, path: path.map(Path::to_path_buf), text: text.to_owned() };
        Ok(Loaded { registry, warnings })
    }

    /// The registry of the simulated demonstration rig, `devices.toml` of the repository.
    ///
    /// # Panics
    /// Never: the text is part of the program, and a test parses it.
    #[must_use]
    #[expect(clippy::expect_used, reason = "a text fixed at build time, parsed by a test")]
    pub fn builtin() -> Self {
        Self::parse(BUILTIN, None).expect("the built-in devices.toml is valid").registry
    }
}

fn nothing_registered(file: String) -> RegistryErrors {
    RegistryErrors::whole_file(
        file,
        "no device is registered",
        "add a [device.NAME] table with vid, pid and node; `lsusb` shows vid:pid of what is plugged in",
    )
}

fn rig(root: &Section<'_>, problems: &mut Problems<'_>) -> RigSpec {
    let mut rig = RigSpec {
        name: "rig".to_owned(),
        observation_hz: 30.0,
        sync_window: Duration::from_millis(25),
        cooldown: Duration::from_secs(2),
        memory_budget: 512 << 20,
        disk_reserve: None,
        expect: Vec::new(),
    };
    let Some(section) = root.table(problems, "rig") else { return rig };
    let known = ["name", "observation_hz", "sync_window", "cooldown", "memory_budget", "disk_reserve", "expect"];
    section.allow(problems, &known);
    if let Some(name) = section.text(problems, "name") {
        // The name becomes part of file names.
        let legal = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        if (1..=64).contains(&name.value.len()) && name.value.chars().all(legal) && !name.value.starts_with('.') {
            name.value.clone_into(&mut rig.name);
        } else {
            let fix = "use letters, digits, `-`, `_` and `.`, at most 64, not beginning with `.`";
            section.report(problems, "name", format!("rig name {:?} cannot be part of a file name", name.value), fix);
        }
    }
    if let Some(hz) = section.number(problems, "observation_hz", 0.1..=1000.0) {
        rig.observation_hz = hz;
    }
    let window = Duration::from_millis(1)..=Duration::from_secs(10);
    rig.sync_window = section.duration(problems, "sync_window", window).unwrap_or(rig.sync_window);
    let cooldown = Duration::ZERO..=Duration::from_mins(1);
    rig.cooldown = section.duration(problems, "cooldown", cooldown).unwrap_or(rig.cooldown);
    let budget = 1 << 20..=64 << 30;
    rig.memory_budget = section.size(problems, "memory_budget", budget).unwrap_or(rig.memory_budget);
    rig.disk_reserve = section.size(problems, "disk_reserve", 0..=1 << 40);
    rig
}

/// One draft an entry, in the order of the file.
fn drafts<'a>(root: &Section<'a>, programs: Programs<'_>, problems: &mut Problems<'_>) -> Vec<Draft<'a>> {
    if let Some((at, _, value)) = root.fields().into_iter().find(|(_, key, _)| *key == "device")
        && value.get_ref().is_array()
    {
        let fix = "write each entry as a table of its own, [device.NAME], without `name =`";
        problems.report(at, "", "[[device]] lists belong to rapid_driver's registry", fix);
        return Vec::new();
    }
    let Some(devices) = root.table(problems, "device") else { return Vec::new() };
    let mut drafts = Vec::new();
    for (at, name, value) in devices.fields() {
        if drafts.len() == MAX_MODALITIES {
            let message =
                format!("more than {MAX_MODALITIES} devices: the mask has one bit for each and is 64 bits wide");
            problems.report(at, &devices.child(name), message, "remove entries that are not used, or run two rigs");
            break;
        }
        let Some(section) = value.get_ref().as_table() else {
            let message = format!("{name:?} is not a table");
            problems.report(at, &devices.child(name), message, "write it as a table [device.NAME]");
            continue;
        };
        let section = Section::new(section, at, devices.child(name));
        drafts.push(device::read(name, section, programs, problems));
    }
    drafts
}

/// Two entries may not mean the same unit: the same serial number, or the same port where there is
/// no serial number. Entries with neither are interchangeable units and may repeat. A composite
/// device may have one entry for its camera and one for its serial line.
fn check_identities(drafts: &[Draft<'_>], problems: &mut Problems<'_>) {
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
            same_model && same_place
        };
        let Some(earlier) = drafts.iter().take(index).find(same_unit) else { continue };
        let (key, what) =
            if identity.serial.is_some() { (draft.serial_key(), "serial number") } else { ("port", "port") };
        let message = format!(
            "same vid, pid and {what} as [{}] on line {}",
            earlier.section.entry,
            problems.line(earlier.section.at)
        );
        let fix = format!("give each entry the {what} of its own unit; one physical device is one entry");
        draft.section.report(problems, key, message, fix);
    }
}

fn unused_ports(drafts: &[Draft<'_>], problems: &Problems<'_>) -> Vec<Diagnostic> {
    let both = drafts.iter().filter(|draft| {
        let usb = draft.identity.as_ref().and_then(IdentitySpec::usb);
        usb.is_some_and(|usb| usb.serial.is_some() && usb.port.is_some())
    });
    let warn = |draft: &Draft<'_>| {
        let message = "port has no effect beside a serial number: the unit is recognised in every port".to_owned();
        let fix = "remove port, or remove the serial number to accept any unit in that port".to_owned();
        problems.diagnostic(draft.section.at_of("port"), &draft.section.entry, message, fix)
    };
    both.map(warn).collect()
}

fn check_topics(drafts: &[Draft<'_>], problems: &mut Problems<'_>) {
    for (index, draft) in drafts.iter().enumerate() {
        if OWN_TOPICS.contains(&draft.topic.as_str()) {
            let message = format!("topic {:?} is published by rapid itself", draft.topic);
            let fix = format!("choose another, for example {:?}", draft.default_topic());
            draft.section.report(problems, "topic", message, fix);
        }
        let Some(earlier) = drafts.iter().take(index).find(|earlier| earlier.topic == draft.topic) else { continue };
        let message = format!(
            "topic {:?} is already used by [{}] on line {}",
            draft.topic,
            earlier.section.entry,
            problems.line(earlier.section.at)
        );
        let fix = format!("choose another, for example {:?}", format!("{}/{}", draft.topic, draft.name));
        draft.section.report(problems, "topic", message, fix);
    }
}

/// The entries that every episode has to have samples of.
fn expected(root: &Section<'_>, drafts: &[Draft<'_>], problems: &mut Problems<'_>) -> Vec<String> {
    // One that is no table has been reported.
    let rig = root.fields().into_iter().find(|(_, key, _)| *key == "rig");
    let Some((at, table)) = rig.and_then(|(at, _, value)| Some((at, value.get_ref().as_table()?))) else {
        return Vec::new();
    };
    let rig = Section::new(table, at, root.child("rig"));
    let expected = rig.texts(problems, "expect").unwrap_or_default();
    for (index, name) in expected.iter().enumerate() {
        if !drafts.iter().any(|draft| draft.name == *name) {
            let known: Vec<&str> = drafts.iter().map(|draft| draft.name.as_str()).collect();
            let fix = did_you_mean(name, &known, "entries are");
            rig.report(problems, "expect", format!("expect: there is no [device.{name}]"), fix);
        } else if expected.iter().take(index).any(|earlier| earlier == name) {
            rig.report(problems, "expect", format!("expect: {name:?} is in the list twice"), "name it once");
        }
    }
    expected
}

/// An action has no name of a device in it: it means the one actuator there is.
fn check_actuators(drafts: &[Draft<'_>], problems: &mut Problems<'_>) {
    let mut actuators = drafts.iter().filter(|draft| draft.action.is_some());
    let Some(first) = actuators.next() else { return };
    for draft in actuators {
        let message = format!("[{}] is an actuator already, and a rig has one", first.section.entry);
        let fix = "remove one of the two action tables; the motors of a CAN bus have one without being asked";
        draft.section.report(problems, "action", message, fix);
    }
}

/// Gives entries without a bit the lowest free one, in the order of the file, after all bits that
/// are written down are taken.
fn assign_bits(drafts: &mut [Draft<'_>], problems: &mut Problems<'_>) -> Vec<Diagnostic> {
    let mut taken: Vec<At<u8>> = Vec::new();
    let mut free = (0..64).filter({
        let written: Vec<u8> = drafts.iter().filter_map(|draft| draft.bit.map(|bit| bit.value)).collect();
        move |bit| !written.contains(bit)
    });
    let mut warnings = Vec::new();
    for draft in drafts {
        if let Some(bit) = draft.bit {
            if let Some(earlier) = taken.iter().find(|earlier| earlier.value == bit.value) {
                let message = format!("bit {} is already taken on line {}", bit.value, problems.line(earlier.at));
                let fix =
                    free.clone().next().map_or("choose another".to_owned(), |free| format!("bit = {free} is free"));
                problems.report(bit.at, &draft.section.entry, message, fix);
            }
            taken.push(bit);
            draft.id = ModalityId::new(bit.value);
            continue;
        }
        // A bit that was written and is wrong has been reported; there is nothing to give.
        if draft.section.has("bit") {
            continue;
        }
        let Some(bit) = free.next() else { continue };
        draft.id = ModalityId::new(bit);
        let message = format!("no bit given, it gets bit {bit}: another entry above it would move it");
        let fix = format!("pin it with bit = {bit}; a policy is trained on bit positions");
        warnings.push(problems.diagnostic(draft.section.at, &draft.section.entry, message, fix));
    }
    warnings
}

#[cfg(test)]
mod tests;
