//! `[module.NAME]`, and where its sensors sit: `[module.NAME.transform.SENSOR]`.

use super::device::Draft;
use super::identity::name_problem;
use super::names;
use crate::diagnostic::did_you_mean;
use crate::keys::{About, TEXT, TEXTS, Words, keys, numbers};
use crate::section::Section;
use crate::spec::{ModuleSpec, Mount, TransformSpec};

keys! {
    /// `[module.NAME]`.
    pub(super) struct ModuleKeys {
        /// Where on the gripper it is mounted.
        slot: Option<Mount> = Words(&Mount::WORDS), need "write slot = \"front\", \"tip\", \"top\" or \"bottom\"";
        /// Tags of episodes with it, each `"KEY=VALUE"`.
        tags: Vec<String> = TEXTS, or Vec::new();
        /// Entries of its sensors.
        devices: Vec<String> = TEXTS, or Vec::new();
    } => {
        /// Where a sensor sits, by the name of its entry.
        transform = About::Named(&[TransformKeys::KEYS]);
    }

    /// `[module.NAME.transform.SENSOR]`.
    pub(super) struct TransformKeys {
        /// The frame in which the place is given.
        parent: Option<String> = TEXT, usually "`\"gripper\"`";
        /// `[x, y, z]`, m.
        position: Option<[f64; 3]> = numbers(place, "3 values"), need "write position = [x, y, z], in m";
        /// A quaternion `[x, y, z, w]` of length 1.
        rotation: Option<[f64; 4]> = numbers(rotation, "4 values"), usually "`[0, 0, 0, 1]`";
    }
}

const TRANSFORM: &str = "transform";
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
    let ModuleKeys { slot: mount, tags: written, devices } = ModuleKeys::read(section);
    let mut tags = Vec::new();
    for tag in written {
        match tag.split_once('=') {
            Some((key, value)) if !key.is_empty() => tags.push((key.to_owned(), value.to_owned())),
            _ => section.report("tags", format!("{tag:?} is not a tag"), "write KEY=VALUE, as \"finger=soft\""),
        }
    }
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
            tables.report_child(at, sensor, format!("{sensor:?} is not a sensor of this module"), fix);
            continue;
        }
        let Some(table) = tables.table(sensor) else { continue };
        found.extend(transform(sensor, &table));
    }
    found
}

fn transform(sensor: &str, table: &Section<'_>) -> Option<TransformSpec> {
    let keys = TransformKeys::read(table);
    let parent = parent(sensor, keys.parent, table);
    let rotation = if table.has("rotation") { keys.rotation } else { Some([0.0, 0.0, 0.0, 1.0]) };
    Some(TransformSpec { sensor: sensor.to_owned(), parent: parent?, position: keys.position?, rotation: rotation? })
}

fn parent(sensor: &str, parent: Option<String>, table: &Section<'_>) -> Option<String> {
    let parent = parent.unwrap_or_else(|| GRIPPER.to_owned());
    if parent.is_empty() || parent == sensor || parent.len() > LONGEST {
        let fix = format!("name another frame, of at most {LONGEST} bytes, or remove the key: it is {GRIPPER:?} then");
        return table.refuse("parent", format!("{parent:?} cannot be the frame in which {sensor} sits"), fix);
    }
    Some(parent)
}

fn place(table: &Section<'_>, key: &str) -> Option<[f64; 3]> {
    exactly(table, key, "write position = [x, y, z], in m")
}

fn rotation(table: &Section<'_>, key: &str) -> Option<[f64; 4]> {
    let rotation: [f64; 4] = exactly(table, key, "write rotation = [x, y, z, w]")?;
    let length = rotation.iter().map(|part| part * part).sum::<f64>().sqrt();
    if (length - 1.0).abs() > TOLERANCE {
        let fix = "write a quaternion x y z w of length 1, or remove the key if the sensor is not turned";
        return table.refuse(key, format!("not a rotation: its length is {length:.3}"), fix);
    }
    Some(rotation.map(|part| part / length))
}

fn exactly<const COUNT: usize>(table: &Section<'_>, key: &str, fix: &str) -> Option<[f64; COUNT]> {
    let numbers = table.numbers(key)?;
    match <[f64; COUNT]>::try_from(numbers.as_slice()) {
        Ok(numbers) if numbers.iter().all(|number| number.is_finite()) => Some(numbers),
        Ok(_) => table.refuse(key, "a number that is not finite".to_owned(), fix),
        Err(_) => table.refuse(key, format!("{} values, and it has {COUNT}", numbers.len()), fix),
    }
}
