//! `[module.NAME]`.

use super::device::Draft;
use super::name::name_problem;
use crate::registry::diagnostic::did_you_mean;
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{ModuleSpec, Mount};

/// Reads the modules, in the order of the file.
pub(super) fn modules(root: &Section<'_>, drafts: &[Draft<'_>], problems: &mut Problems<'_>) -> Vec<ModuleSpec> {
    let Some(tables) = root.table(problems, "module") else { return Vec::new() };
    let mut modules: Vec<ModuleSpec> = Vec::new();
    for (_, name, _) in tables.fields() {
        let Some(section) = tables.table(problems, name) else { continue };
        if let Some((_, fix)) = name_problem(name) {
            let fix = fix.replace("[device.", "[module.");
            problems.report(section.at, &section.entry, format!("{name:?} cannot be a module's name"), fix);
        }
        modules.extend(module(name, &section, drafts, &modules, problems));
    }
    modules
}

fn module(
    name: &str,
    section: &Section<'_>,
    drafts: &[Draft<'_>],
    earlier: &[ModuleSpec],
    problems: &mut Problems<'_>,
) -> Option<ModuleSpec> {
    section.allow(problems, &["slot", "tags", "devices"]);
    if !section.has("slot") {
        section.missing(problems, "slot", "write slot = \"front\", \"tip\", \"top\" or \"bottom\"");
    }
    let mount = section.choice(problems, "slot", &Mount::WORDS);
    let mut tags = Vec::new();
    for tag in section.texts(problems, "tags").unwrap_or_default() {
        match tag.split_once('=') {
            Some((key, value)) if !key.is_empty() => tags.push((key.to_owned(), value.to_owned())),
            _ => section.report(problems, "tags", format!("{tag:?} is no tag"), "write KEY=VALUE, as \"finger=soft\""),
        }
    }
    let devices = section.texts(problems, "devices").unwrap_or_default();
    for device in &devices {
        let Some(draft) = drafts.iter().find(|draft| draft.name == *device) else {
            let known: Vec<&str> = drafts.iter().map(|draft| draft.name.as_str()).collect();
            let fix = did_you_mean(device, &known, "entries are");
            section.report(problems, "devices", format!("there is no [device.{device}]"), fix);
            continue;
        };
        if let (Some(mount), Some(own)) = (mount, draft.mount)
            && mount != own
        {
            let message = format!("slot of [device.{device}] is {own}, and of its module {mount}");
            section.report(problems, "slot", message, "write the same slot in both, or in the module alone");
        }
        if let Some(other) = earlier.iter().find(|other| other.devices.contains(device)) {
            let message = format!("[device.{device}] is a sensor of [module.{}] already", other.name);
            section.report(problems, "devices", message, "name it in one of the two");
        }
    }
    Some(ModuleSpec { name: name.to_owned(), mount: mount?, tags, devices })
}
