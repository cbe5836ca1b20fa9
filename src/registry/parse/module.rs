//! `[module.NAME]`, and where its sensors sit: `[module.NAME.transform.SENSOR]`.

use super::device::Draft;
use super::identity::name_problem;
use super::names;
use crate::diagnostic::did_you_mean;
use crate::section::Section;
use crate::spec::{ModuleSpec, Mount, TransformSpec};

const TRANSFORM: &str = "transform";
const POSITION: &str = "position";
const ROTATION: &str = "rotation";
/// The frame in which a sensor's place is given, unless its table names another.
const GRIPPER: &str = "gripper";
/// Longest name of a frame, bytes.
const LONGEST: usize = 64;
/// How far from 1 the length of a rotation may be: those of calibrations are rounded.
const TOLERANCE: f64 = 0.01;

/// Reads the modules, in the order of the file.
pub(super) fn modules(root: &Section<'_>, drafts: &[Draft<'_>]) -> Vec<ModuleSpec> {
    let Some(tables) = root.table("module") else { return Vec::new() };
    let mut modules: Vec<ModuleSpec> = Vec::new();
    for (_, name, _) in tables.fields() {
        let Some(section) = tables.table(name) else { continue };
        if let Some((_, fix)) = name_problem(name) {
            let fix = fix.replace("[device.", "[module.");
            section.report_at(section.at, format!("{name:?} cannot be a module's name"), fix);
        }
        if name == "none" {
            let fix = "give it another name: `--module none` means that no declared one is mounted";
            section.report_at(section.at, "\"none\" cannot be a module's name", fix);
        }
        modules.extend(module(name, &section, drafts, &modules));
    }
    modules
}

fn module(name: &str, section: &Section<'_>, drafts: &[Draft<'_>], earlier: &[ModuleSpec]) -> Option<ModuleSpec> {
    section.allow(&["slot", "tags", "devices", TRANSFORM]);
    section.need("slot", "write slot = \"front\", \"tip\", \"top\" or \"bottom\"");
    let mount = section.choice("slot", &Mount::WORDS);
    let mut tags = Vec::new();
    for tag in section.texts("tags").unwrap_or_default() {
        match tag.split_once('=') {
            Some((key, value)) if !key.is_empty() => tags.push((key.to_owned(), value.to_owned())),
            _ => section.report("tags", format!("{tag:?} is not a tag"), "write KEY=VALUE, as \"finger=soft\""),
        }
    }
    let devices = section.texts("devices").unwrap_or_default();
    for device in &devices {
        let Some(draft) = drafts.iter().find(|draft| draft.name == *device) else {
            let fix = did_you_mean(device, names(drafts), "entries are");
            section.report("devices", format!("there is no [device.{device}]"), fix);
            continue;
        };
        if let (Some(mount), Some(own)) = (mount, draft.mount)
            && mount != own
        {
            let message = format!("slot of [device.{device}] is {own}, and of its module {mount}");
            section.report("slot", message, "write the same slot in both, or in the module alone");
        }
        // Of one slot, one is mounted at a time: which of them has the sensor is named.
        let elsewhere = |other: &&ModuleSpec| other.devices.contains(device) && Some(other.mount) != mount;
        if let Some(other) = earlier.iter().find(elsewhere) {
            let message = format!("[device.{device}] is a sensor of [module.{}] already, in another slot", other.name);
            section.report("devices", message, "name it in one of the two");
        }
    }
    let transforms = transforms(section, &devices);
    Some(ModuleSpec { name: name.to_owned(), mount: mount?, tags, devices, transforms })
}

/// Reads where the sensors sit.
fn transforms(section: &Section<'_>, devices: &[String]) -> Vec<TransformSpec> {
    let Some(tables) = section.table(TRANSFORM) else { return Vec::new() };
    let mut found = Vec::new();
    for (at, sensor, _) in tables.fields() {
        if !devices.iter().any(|device| device == sensor) {
            let fix = match devices {
                [] => "name it in its `devices`, or remove the table".to_owned(),
                devices => did_you_mean(sensor, devices, "its `devices` are"),
            };
            tables.report_child(at, sensor, format!("{sensor:?} is no sensor of this module"), fix);
            continue;
        }
        let Some(table) = tables.table(sensor) else { continue };
        found.extend(transform(sensor, &table));
    }
    found
}

fn transform(sensor: &str, table: &Section<'_>) -> Option<TransformSpec> {
    table.allow(&["parent", POSITION, ROTATION]);
    table.need(POSITION, "write position = [x, y, z], in m");
    let (parent, position, rotation) =
        (parent(sensor, table), numbers(table, POSITION, "write position = [x, y, z], in m"), rotation(table));
    Some(TransformSpec { sensor: sensor.to_owned(), parent: parent?, position: position?, rotation: rotation? })
}

fn parent(sensor: &str, table: &Section<'_>) -> Option<String> {
    let parent = table.text("parent").unwrap_or(GRIPPER);
    if parent.is_empty() || parent == sensor || parent.len() > LONGEST {
        let fix = format!("name another frame, of at most {LONGEST} bytes, or remove the key: it is {GRIPPER:?} then");
        return table.refuse("parent", format!("{parent:?} cannot be the frame in which {sensor} sits"), fix);
    }
    Some(parent.to_owned())
}

fn rotation(table: &Section<'_>) -> Option<[f64; 4]> {
    if !table.has(ROTATION) {
        return Some([0.0, 0.0, 0.0, 1.0]);
    }
    let rotation: [f64; 4] = numbers(table, ROTATION, "write rotation = [x, y, z, w]")?;
    let length = rotation.iter().map(|part| part * part).sum::<f64>().sqrt();
    if (length - 1.0).abs() > TOLERANCE {
        let fix = "write a quaternion x y z w of length 1, or remove the key if the sensor is not turned";
        return table.refuse(ROTATION, format!("not a rotation: its length is {length:.3}"), fix);
    }
    Some(rotation.map(|part| part / length))
}

fn numbers<const COUNT: usize>(table: &Section<'_>, key: &str, fix: &str) -> Option<[f64; COUNT]> {
    let numbers = table.numbers(key)?;
    match <[f64; COUNT]>::try_from(numbers.as_slice()) {
        Ok(numbers) if numbers.iter().all(|number| number.is_finite()) => Some(numbers),
        Ok(_) => table.refuse(key, "a number that is not finite".to_owned(), fix),
        Err(_) => table.refuse(key, format!("{} numbers, and it has {COUNT}", numbers.len()), fix),
    }
}
