//! `[device.NAME.effector]`: an arm whose actions are poses of its tip.
//!
//! The description of the arm is not read here: a registry is also read where its files are not, from an episode.

use rapid_core::action::MAX_ACTION;

use super::program::Programs;
use crate::section::Section;
use crate::spec::{ActionSpec, DamiaoSpec, EffectorSpec, GripperSpec, MOTOR_CHANNELS, MotorMode, TipRotation};

/// The table.
pub(super) const EFFECTOR: &str = "effector";
const KEYS: [&str; 10] = ["urdf", "tip", "frame", "rotation", "yaw", "gripper", "closed", "open", "min", "max"];

/// No arm is larger, m.
const FARTHEST_M: f64 = 1e3;

/// Reads the table of a bus of motors; `None` without one, or if a problem with it was reported.
pub(super) fn read(section: &Section<'_>, damiao: &DamiaoSpec, programs: Programs<'_>) -> Option<EffectorSpec> {
    let table = section.table(EFFECTOR)?;
    table.allow(&KEYS);
    table.need("urdf", "write urdf = \"arm.urdf\": the description of the arm, beside this file");
    table.need("tip", "write tip = \"tool0\": the link of the description whose pose is commanded");
    table.need("min", "write min = [x, y, z]: the lowest position of the tip, m");
    table.need("max", "write max = [x, y, z]: the highest position of the tip, m");
    for motor in damiao.motors.iter().filter(|motor| motor.mode == MotorMode::Velocity) {
        let message = format!("motor {} is driven at a velocity, and poses are made of positions", motor.name);
        section.report(EFFECTOR, message, "write mode = \"mit\" or mode = \"position\" for it");
    }
    let free_yaw = table.choice("yaw", &[("commanded", false), ("free", true)]).unwrap_or(false);
    let rotation = if table.has("rotation") { rotation(&table)? } else { TipRotation::Free };
    if free_yaw && rotation == TipRotation::Free {
        table.report("yaw", "with rotation = \"free\" every angle is free", "remove the key");
    }
    let gripper = if table.has("gripper") { Some(gripper(&table, damiao)?) } else { no_gripper(&table) };
    let (min, max) = (position(&table, "min"), position(&table, "max"));
    let (min, max) = (min?, max?);
    if min.iter().zip(&max).any(|(min, max)| min >= max) {
        return table.refuse("max", "not above min in x, y and z", "write the higher corner of the box");
    }
    let urdf = table.text("urdf")?;
    let spec = EffectorSpec {
        urdf: programs.file(urdf),
        frame: table.text("frame").map(str::to_owned),
        tip: table.text("tip")?.to_owned(),
        rotation,
        free_yaw,
        gripper,
        min,
        max,
    };
    let (joints, commanded) = (damiao.motors.len() - usize::from(spec.gripper.is_some()), spec.commanded());
    if joints < commanded {
        let message = format!("{joints} motors move the tip, and {commanded} of its coordinates are commanded");
        return table.refuse("rotation", message, "write rotation = \"free\" (3 coordinates), or yaw = \"free\" (5)");
    }
    let count = damiao.motors.len() * MOTOR_CHANNELS + spec.numbers();
    if count > MAX_ACTION {
        let message = format!("a sample of {count} numbers, and {MAX_ACTION} is the limit");
        return section.refuse(EFFECTOR, message, "move some of the motors to another adapter");
    }
    Some(spec)
}

fn rotation(table: &Section<'_>) -> Option<TipRotation> {
    const FIX: &str = "write \"commanded\", \"free\", or a quaternion [x, y, z, w]: [0, 1, 0, 0] points downwards";
    if table.word("rotation").is_some() {
        let words = [("commanded", TipRotation::Commanded), ("free", TipRotation::Free)];
        return table.choice("rotation", &words);
    }
    let numbers = table.numbers("rotation")?;
    let Ok(numbers) = <[f64; 4]>::try_from(numbers) else {
        return table.refuse("rotation", "a quaternion has 4 numbers", FIX);
    };
    let length = numbers.iter().map(|number| number * number).sum::<f64>().sqrt();
    if !(0.5..=2.0).contains(&length) {
        return table.refuse("rotation", format!("a quaternion of length {length}"), FIX);
    }
    Some(TipRotation::Held(numbers.map(|number| number / length)))
}

fn gripper(table: &Section<'_>, damiao: &DamiaoSpec) -> Option<GripperSpec> {
    table.need("closed", "write closed = 0.0: the position of the motor when the gripper is closed, rad");
    table.need("open", "write open = 1.2: the position of the motor when the gripper is open, rad");
    let name = table.text("gripper")?;
    let Some((motor, spec)) = damiao.motors.iter().enumerate().find(|(_, motor)| motor.name == name) else {
        let names: Vec<_> = damiao.motors.iter().map(|motor| motor.name.as_str()).collect();
        return table.refuse("gripper", format!("no motor {name:?}"), format!("motors are {}", names.join(", ")));
    };
    let [low, high] = spec.position;
    let (closed, open) = (table.number("closed", low..=high), table.number("open", low..=high));
    let (closed, open) = (closed?, open?);
    if (closed - open).abs() < 1e-6 {
        return table.refuse("open", "open and closed are the same position", "write both positions of the motor");
    }
    Some(GripperSpec { motor, closed, open })
}

fn no_gripper(table: &Section<'_>) -> Option<GripperSpec> {
    for key in ["closed", "open"].into_iter().filter(|key| table.has(key)) {
        table.report(key, "there is no gripper", "write gripper = the name of its motor, or remove the key");
    }
    None
}

fn position(table: &Section<'_>, key: &'static str) -> Option<[f64; 3]> {
    let numbers = table.numbers(key)?;
    match <[f64; 3]>::try_from(numbers) {
        Ok(position) if position.iter().all(|number| number.abs() <= FARTHEST_M) => Some(position),
        _ => table.refuse(key, "not a position", format!("write {key} = [x, y, z], m")),
    }
}

/// The axes of its actions.
pub(super) fn axes(spec: &EffectorSpec) -> ActionSpec {
    let mut axes: Vec<(&str, &str, [f64; 2])> = Vec::new();
    for (name, (min, max)) in ["x", "y", "z"].into_iter().zip(spec.min.into_iter().zip(spec.max)) {
        axes.push((name, "m", [min, max]));
    }
    if spec.rotation == TipRotation::Commanded {
        axes.extend(["qx", "qy", "qz", "qw"].map(|name| (name, "1", [-1.0, 1.0])));
    }
    if spec.gripper.is_some() {
        axes.push(("grip", "1", [0.0, 1.0]));
    }
    ActionSpec {
        names: axes.iter().map(|(name, ..)| (*name).to_owned()).collect(),
        units: axes.iter().map(|(_, unit, _)| (*unit).to_owned()).collect(),
        min: axes.iter().map(|(_, _, [min, _])| *min).collect(),
        max: axes.iter().map(|(_, _, [_, max])| *max).collect(),
    }
}
