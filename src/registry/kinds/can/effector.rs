//! `[device.NAME.effector]`: an arm whose actions are poses of its tip.
//!
//! The description of the arm is not read here: a registry is also read where its files are not, from an episode.

use std::path::PathBuf;

use rapid_core::action::MAX_ACTION;

use super::MOTOR_CHANNELS;
use super::motors::{DamiaoSpec, MotorMode, MotorSpec};
use crate::keys::{Own, Real, TEXT, Words, keys, numbers, own};
use crate::parse::program::Programs;
use crate::section::Section;
use crate::spec::{ActionSpec, tip_numbers};

/// The table.
pub(crate) const EFFECTOR: &str = "effector";
const POSITION: Own<[f64; 3]> = numbers(position, "3 values");
const ROTATION: Own<TipRotation> = own(
    rotation,
    "`\"commanded\"`, `\"free\"`, or a quaternion `[x, y, z, w]`",
    r#"{"anyOf": [{"enum": ["commanded", "free"]}, {"type": "array", "items": {"type": "number"}}]}"#,
);

keys! {
    /// `[device.NAME.effector]`.
    pub(crate) struct EffectorKeys(motors: &[MotorSpec]) {
        /// The description of the arm, beside this file.
        urdf: Option<String> = TEXT, need "write urdf = \"arm.urdf\": the description of the arm, beside this file";
        /// The link whose pose is commanded.
        tip: Option<String> = TEXT, need "write tip = \"tool0\": the link of the description whose pose is commanded";
        /// The link in whose frame poses are given.
        frame: Option<String> = TEXT, usually "the root of the description";
        /// How the tip is turned.
        rotation: Option<TipRotation> = ROTATION, usually "`\"free\"`";
        /// Whether the angle about the z axis of `frame` is commanded: an arm of five joints has no choice.
        yaw: bool = Words(&[("commanded", false), ("free", true)]), or false;
        /// The motor that opens and closes the gripper.
        gripper: Option<String> = TEXT, usually "none";
        /// The position of the gripper's motor when it is closed, rad.
        closed: Option<f64> = Real::ANY, within reach(motors, gripper.as_ref());
        /// The position of the gripper's motor when it is open, rad.
        open: Option<f64> = Real::ANY, within reach(motors, gripper.as_ref());
        /// Lowest position of the tip, m.
        min: Option<[f64; 3]> = POSITION, need "write min = [x, y, z]: the lowest position of the tip, m";
        /// Highest position of the tip, m.
        max: Option<[f64; 3]> = POSITION, need "write max = [x, y, z]: the highest position of the tip, m";
    }
}

/// `[device.NAME.effector]`: an arm whose actions are poses of its tip, and whose samples end with that pose.
#[derive(Debug, Clone, PartialEq)]
pub struct EffectorSpec {
    /// The description of the arm, a URDF file. Each of its joints between `frame` and `tip` that moves has the name of a
    /// motor.
    pub urdf: PathBuf,
    /// The link in whose frame poses are given; `None` is the root of the description.
    pub frame: Option<String>,
    /// The link whose pose is commanded and reported.
    pub tip: String,
    /// How the tip is turned.
    pub rotation: TipRotation,
    /// The angle about the z axis of `frame` is whatever the arm makes of it: an arm of five joints has no choice.
    pub free_yaw: bool,
    /// What opens and closes at the tip.
    pub gripper: Option<GripperSpec>,
    /// Lowest position that is commanded, m: x, y, z in `frame`.
    pub min: [f64; 3],
    /// Highest position that is commanded, each above the lowest.
    pub max: [f64; 3],
}

impl EffectorSpec {
    /// Numbers of a sample after those of the motors: position, opening if there is a gripper, quaternion `x y z w`.
    pub const fn numbers(&self) -> usize {
        tip_numbers(self.gripper.is_some())
    }

    /// Coordinates of the tip that are commanded: as many joints are needed.
    pub const fn commanded(&self) -> usize {
        match self.rotation {
            TipRotation::Free => 3,
            TipRotation::Commanded | TipRotation::Held(_) if self.free_yaw => 5,
            TipRotation::Commanded | TipRotation::Held(_) => 6,
        }
    }
}

/// How the tip of an arm is turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TipRotation {
    /// As the action has it: a quaternion `x y z w` after the position.
    Commanded,
    /// In any way.
    Free,
    /// Always so: a quaternion `x y z w` of length 1.
    Held([f64; 4]),
}

/// The gripper at the tip of an arm: a motor, and its positions at the opening 0 and 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GripperSpec {
    /// Its index in [`DamiaoSpec::motors`].
    pub motor: usize,
    /// Closed: opening 0, rad, of its joint; within the position of the motor.
    pub closed: f64,
    /// Open: opening 1, rad; likewise, and not the same.
    pub open: f64,
}

/// No arm is larger, m.
const FARTHEST_M: f64 = 1e3;

/// Reads the table of a bus of motors; `None` without one, or if a problem with it was reported.
pub(crate) fn read(section: &Section<'_>, damiao: &DamiaoSpec, programs: Programs<'_>) -> Option<EffectorSpec> {
    let table = section.table(EFFECTOR)?;
    let keys = EffectorKeys::read(&table, &damiao.motors);
    for motor in damiao.motors.iter().filter(|motor| motor.mode == MotorMode::Velocity) {
        let message = format!("motor {} is driven at a velocity, and poses are made of positions", motor.name);
        section.report(EFFECTOR, message, "write mode = \"mit\" or mode = \"position\" for it");
    }
    let rotation = if table.has("rotation") { keys.rotation? } else { TipRotation::Free };
    if keys.yaw && rotation == TipRotation::Free {
        table.report("yaw", "with rotation = \"free\" every angle is free", "remove the key");
    }
    let gripper = if table.has("gripper") { Some(gripper(&table, &keys, damiao)?) } else { no_gripper(&table) };
    let (min, max) = (keys.min?, keys.max?);
    if min.iter().zip(&max).any(|(min, max)| min >= max) {
        return table.refuse("max", "not above min in x, y and z", "write the higher corner of the box");
    }
    let spec = EffectorSpec {
        urdf: programs.file(&keys.urdf?),
        frame: keys.frame,
        tip: keys.tip?,
        rotation,
        free_yaw: keys.yaw,
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
        let message = format!("a sample of {count} values, and {MAX_ACTION} is the limit");
        return section.refuse(EFFECTOR, message, "move some of the motors to another adapter");
    }
    Some(spec)
}

/// Notes the table of a device that is not a bus of motors.
pub(crate) fn refuse(entry: &Section<'_>) {
    if entry.has(EFFECTOR) {
        entry.report(EFFECTOR, "only motors move an arm", "remove the table, or write protocol = \"damiao\"");
    }
}

fn rotation(table: &Section<'_>, key: &str) -> Option<TipRotation> {
    const FIX: &str = "write \"commanded\", \"free\", or a quaternion [x, y, z, w]: [0, 1, 0, 0] points downwards";
    if table.word(key).is_some() {
        let words = [("commanded", TipRotation::Commanded), ("free", TipRotation::Free)];
        return table.choice(key, &words);
    }
    let numbers = table.numbers(key)?;
    let Ok(numbers) = <[f64; 4]>::try_from(numbers) else {
        return table.refuse(key, "a quaternion has 4 values", FIX);
    };
    let length = numbers.iter().map(|number| number * number).sum::<f64>().sqrt();
    if !(0.5..=2.0).contains(&length) {
        return table.refuse(key, format!("a quaternion of length {length}"), FIX);
    }
    Some(TipRotation::Held(numbers.map(|number| number / length)))
}

fn gripper(table: &Section<'_>, keys: &EffectorKeys, damiao: &DamiaoSpec) -> Option<GripperSpec> {
    table.need("closed", "write closed = 0.0: the position of the motor when the gripper is closed, rad");
    table.need("open", "write open = 1.2: the position of the motor when the gripper is open, rad");
    let name = keys.gripper.as_ref()?;
    let Some(motor) = damiao.motors.iter().position(|motor| motor.name == *name) else {
        let names: Vec<_> = damiao.motors.iter().map(|motor| motor.name.as_str()).collect();
        return table.refuse("gripper", format!("no motor {name:?}"), format!("motors are {}", names.join(", ")));
    };
    let (closed, open) = (keys.closed?, keys.open?);
    if (closed - open).abs() < 1e-6 {
        return table.refuse("open", "open and closed are the same position", "write both positions of the motor");
    }
    Some(GripperSpec { motor, closed, open })
}

/// Positions of the motor of the gripper.
fn reach(motors: &[MotorSpec], gripper: Option<&String>) -> Real {
    let motor = motors.iter().find(|motor| Some(&motor.name) == gripper);
    motor.map_or(Real::ANY, |motor| Real(motor.position[0], motor.position[1]))
}

fn no_gripper(table: &Section<'_>) -> Option<GripperSpec> {
    for key in ["closed", "open"].into_iter().filter(|key| table.has(key)) {
        table.report(key, "there is no gripper", "write gripper = the name of its motor, or remove the key");
    }
    None
}

fn position(table: &Section<'_>, key: &str) -> Option<[f64; 3]> {
    let numbers = table.numbers(key)?;
    match <[f64; 3]>::try_from(numbers) {
        Ok(position) if position.iter().all(|number| number.abs() <= FARTHEST_M) => Some(position),
        _ => table.refuse(key, "not a position", format!("write {key} = [x, y, z], m")),
    }
}

/// The axes of its actions.
pub(crate) fn axes(spec: &EffectorSpec) -> ActionSpec {
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
