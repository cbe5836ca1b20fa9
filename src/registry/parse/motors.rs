//! The motors of `[device.NAME.can]`, and the axes of actions that follow from them.

mod conduct;

use std::time::Duration;

use super::window::Entry;
use crate::registry::diagnostic::{Diagnostic, did_you_mean};
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{
    ActionSpec, CanProtocol, CanSpec, DamiaoSpec, DeviceSpec, MotorKind, MotorMode, MotorSpec, NodeSpec,
};
use crate::registry::units::show_duration;
use conduct::{brake, motion, or_never, stop, watch};

const KEYS: [&str; 24] = [
    "name",
    "slave",
    "master",
    "type",
    "mode",
    "kp",
    "kd",
    "position",
    "velocity",
    "torque",
    "slew",
    "acceleration",
    "soft_start",
    "first_target",
    "margin",
    "lag",
    "blocked_after",
    "own_fault",
    "other_fault",
    "emergency",
    "hold_for",
    "brake",
    "max_mos",
    "max_rotor",
];
/// Six numbers a motor, and 64 in an action or a sample.
const MOST: usize = 10;
/// Motors that hold for want of an action must not do so between two commands.
const DEADMAN_PERIODS: u32 = 2;
/// A motor that stops by itself when it is told nothing must not do so between two commands.
const TIMEOUT_PERIODS: u32 = 4;
/// A motor that continues for longer than this when this program is killed has gone far.
const LONG_TIMEOUT: Duration = Duration::from_millis(500);
/// What a motor does that nobody has set limits for: slow enough to step aside.
const SPEED: f64 = 2.0;
/// Of the highest torque of its type, likewise.
const TORQUE_SHARE: f64 = 0.1;
/// The winding's insulation and the transistors stand more; a finger does not.
const TEMPERATURE: f64 = 80.0;
/// By convention a motor answers with its own id and this.
const MASTER_OFFSET: u16 = 0x10;
/// Ids of commands, from a motor's own: MIT, position and velocity, velocity, position and force.
const COMMANDS: [u16; 4] = [0, 0x100, 0x200, 0x300];
/// The least damping above 0 in a MIT frame, Nm s/rad: 12 bits from 0 to 5.
const KD_STEP: f64 = 5.0 / 4095.0;
/// The id by which parameters of all motors are read and written.
const PARAMETERS: u16 = 0x7ff;

/// Reads the keys of `protocol = "damiao"`; `None` if a problem with them was reported.
pub(super) fn damiao(table: &Section<'_>, problems: &mut Problems<'_>) -> Option<DamiaoSpec> {
    let (ms, second) = (Duration::from_millis, Duration::from_secs);
    let hz = table.integer(problems, "hz", 10..=1000).and_then(|hz| u32::try_from(hz.value).ok()).unwrap_or(200);
    let deadman = table.duration(problems, "deadman", ms(1)..=second(10));
    let two = second(1) * DEADMAN_PERIODS / hz;
    if let Some(short) = deadman.filter(|deadman| *deadman < two) {
        let message = format!("deadman = {short:?} is less than {DEADMAN_PERIODS} commands at {hz} Hz take");
        let least = two.as_micros().div_ceil(1000);
        let fix = format!("write deadman = \"{least}ms\" or more, or remove it for twice the time between actions");
        table.report(problems, "deadman", message, fix);
    }
    let disable_after = or_never(table, problems, "disable_after", ms(10), None);
    let silent_after = table.duration(problems, "silent_after", ms(1)..=second(10));
    let least = second(1) * TIMEOUT_PERIODS / hz;
    let timeout = table.duration(problems, "timeout", ms(1)..=second(10));
    if let Some(short) = timeout.filter(|timeout| *timeout < least) {
        let message = format!("timeout = {short:?} is less than {TIMEOUT_PERIODS} commands at {hz} Hz take");
        table.report(problems, "timeout", message, format!("write timeout = \"{}ms\" or more", least.as_millis() + 1));
    }
    let motors = motors(table, problems);
    Some(DamiaoSpec {
        motors: motors?,
        hz,
        deadman,
        disable_after,
        timeout: timeout.unwrap_or(ms(100).max(least)),
        silent_after: silent_after.unwrap_or(ms(40)),
    })
}

/// Warns of motors that continue for long once nothing commands them.
pub(super) fn slow_to_stop(devices: &[DeviceSpec], entries: &[Entry], problems: &Problems<'_>) -> Vec<Diagnostic> {
    let warn = |device: &DeviceSpec| {
        let NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) = &device.node else { return None };
        let place = entries.iter().find(|entry| entry.name == device.name)?;
        if motors.timeout <= LONG_TIMEOUT {
            return None;
        }
        let timeout = show_duration(motors.timeout);
        let message = format!(
            "timeout = {timeout}: for so long the motors follow their last command when rapid and its guard are gone"
        );
        let fix = format!("write timeout = \"500ms\" or less in [{}.can]", place.table);
        Some(problems.diagnostic(place.at, &place.table, message, fix))
    };
    devices.iter().filter_map(warn).collect()
}

fn motors(table: &Section<'_>, problems: &mut Problems<'_>) -> Option<Vec<MotorSpec>> {
    if !table.has("motors") {
        let example = "write motors = [{ name = \"gripper\", slave = 5, type = \"DMH3510\", kp = 0.8, kd = 0.05, \
                       position = [-1, 1] }]";
        table.missing(problems, "motors", example);
        return None;
    }
    let listed =
        table.fields().into_iter().find(|(_, key, _)| *key == "motors")?.2.get_ref().as_array().map(|list| list.len());
    let entries = table.tables(problems, "motors");
    if let Some(count) = listed.filter(|count| !(1..=MOST).contains(count)) {
        table.report(problems, "motors", format!("{count} motors"), format!("list 1 to {MOST} motors"));
        return None;
    }
    if listed != Some(entries.len()) {
        return None;
    }
    let mut read: Vec<(Section<'_>, Option<MotorSpec>)> = Vec::new();
    for entry in entries {
        let motor = motor(&entry, problems);
        read.push((entry, motor));
    }
    check_pairs(&read, problems);
    read.into_iter().map(|(_, motor)| motor).collect()
}

fn motor(entry: &Section<'_>, problems: &mut Problems<'_>) -> Option<MotorSpec> {
    entry.allow(problems, &KEYS);
    let name = name(entry, problems);
    // 0x100 and more are the ids of commands in other modes.
    let slave = id(entry, "slave", 1..=0xff, problems);
    let master = id(entry, "master", 0..=0x7ff, problems);
    let kind = kind(entry, problems);
    for (key, fix) in [
        ("slave", "write slave = the motor's CAN id, 1 to 255"),
        ("position", "write position = [lowest, highest] in rad, as far as the joint may go"),
    ] {
        if !entry.has(key) {
            entry.missing(problems, key, fix);
        }
    }
    let (most_speed, most_torque) = kind.map_or((1000.0, 1000.0), |kind| {
        let [_, velocity, torque] = kind.shipped();
        (velocity, torque)
    });
    let velocity = above_zero(entry, "velocity", most_speed, problems).unwrap_or(SPEED.min(most_speed));
    let torque = above_zero(entry, "torque", most_torque, problems).unwrap_or(TORQUE_SHARE * most_torque);
    let mode = mode(entry, problems);
    let position = position(entry, mode, problems);
    // A position can change no faster than the motor turns; a speed within a hundredth of a second.
    let most_slew = if mode == Some(MotorMode::Velocity) { 100.0 * most_speed } else { most_speed };
    // To its highest speed within a tenth of a second.
    let default_slew = if mode == Some(MotorMode::Velocity) { 10.0 * velocity } else { velocity };
    let slew = above_zero(entry, "slew", most_slew, problems).unwrap_or(default_slew);
    let motion = motion(entry, slew, mode, problems);
    let (watch, stop, brake) = (watch(entry, problems), stop(entry, mode, problems), brake(entry, problems));
    let mut temperature = |key| entry.number(problems, key, 20.0..=150.0).unwrap_or(TEMPERATURE);
    let (max_mos, max_rotor) = (temperature("max_mos"), temperature("max_rotor"));
    let slave = slave?;
    let mode = mode?;
    Some(MotorSpec {
        name: name?,
        slave,
        master: if entry.has("master") { master? } else { slave + MASTER_OFFSET },
        kind: kind?,
        mode,
        position: position?,
        velocity,
        torque,
        slew,
        motion,
        watch,
        stop,
        brake,
        max_mos,
        max_rotor,
    })
}

fn name(entry: &Section<'_>, problems: &mut Problems<'_>) -> Option<String> {
    if !entry.has("name") {
        entry.missing(problems, "name", "write name = what its axis is called, for example name = \"gripper\"");
        return None;
    }
    let name = entry.text(problems, "name")?.value;
    let legal = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    if name.is_empty() || name.len() > 64 || !name.chars().all(legal) {
        let fix = "use letters, digits, `_`, `-` and `.`, at most 64";
        entry.report(problems, "name", format!("{name:?} cannot be a motor's name"), fix);
        return None;
    }
    Some(name.to_owned())
}

fn id(
    entry: &Section<'_>,
    key: &str,
    range: std::ops::RangeInclusive<i64>,
    problems: &mut Problems<'_>,
) -> Option<u16> {
    u16::try_from(entry.integer(problems, key, range)?.value).ok()
}

fn kind(entry: &Section<'_>, problems: &mut Problems<'_>) -> Option<MotorKind> {
    let known: Vec<&str> = MotorKind::ALL.iter().map(|kind| kind.name()).collect();
    if !entry.has("type") {
        entry.missing(problems, "type", &format!("write type = one of {}", known.join(", ")));
        return None;
    }
    let text = entry.text(problems, "type")?.value;
    let kind = MotorKind::named(text);
    if kind.is_none() {
        let fix = did_you_mean(text, &known, "write one of");
        entry.report(problems, "type", format!("unknown type {text:?}"), fix);
    }
    kind
}

fn position(entry: &Section<'_>, mode: Option<MotorMode>, problems: &mut Problems<'_>) -> Option<[f64; 2]> {
    // Eight times what motors count to as they are shipped; a wheel turns on.
    let farthest = if mode == Some(MotorMode::Velocity) { 1000.0 } else { 100.0 };
    if !entry.has("position") {
        return None;
    }
    let limits = entry.numbers(problems, "position")?;
    match limits.as_slice() {
        [low, high] if low.abs() <= farthest && high.abs() <= farthest && low < high => Some([*low, *high]),
        _ => {
            let message = format!("position = {limits:?} is no range");
            let fix = format!("write [lowest, highest] in rad, the highest above the lowest, within {farthest}");
            entry.report(problems, "position", message, fix);
            None
        }
    }
}

/// A number above zero.
fn above_zero(entry: &Section<'_>, key: &str, most: f64, problems: &mut Problems<'_>) -> Option<f64> {
    entry.number(problems, key, 0.001..=most)
}

fn mode(entry: &Section<'_>, problems: &mut Problems<'_>) -> Option<MotorMode> {
    let zero = MotorMode::Mit { kp: 0.0, kd: 0.0 };
    let words = [("mit", zero), ("position", MotorMode::PositionVelocity), ("velocity", MotorMode::Velocity)];
    let mode = if entry.has("mode") { entry.choice(problems, "mode", &words)? } else { zero };
    let gains = [("kp", 500.0), ("kd", 5.0)];
    if mode != zero {
        // Frames of these modes have room for none of them.
        for key in ["kp", "kd", "torque"].into_iter().filter(|key| entry.has(key)) {
            let message = format!("a motor that runs its own loop takes no {key}");
            entry.report(problems, key, message, format!("remove {key}, or write mode = \"mit\""));
        }
        return Some(mode);
    }
    let [kp, kd] = gains.map(|(key, most)| {
        if !entry.has(key) {
            let fix =
                format!("write {key} = 0 to {most}, or mode = \"position\" or \"velocity\" for the motor's own loop");
            entry.missing(problems, key, &fix);
        }
        entry.number(problems, key, 0.0..=most)
    });
    let (kp, kd) = (kp?, kd?);
    // Position held without damping rings: the maker's manual forbids it. A frame has 12 bits for it.
    if kp > 0.0 && kd < KD_STEP {
        let message = if kd == 0.0 {
            "kp without kd: the motor would swing".to_owned()
        } else {
            format!("kd = {kd} is less than a frame can express, {KD_STEP:.5}: the motor would swing")
        };
        entry.report(problems, "kd", message, "write a higher kd, for example kd = 0.05");
        return None;
    }
    Some(MotorMode::Mit { kp, kd })
}

/// Names and ids that two motors cannot both have. An answer with the id of a command would be taken for
/// one by another motor.
fn check_pairs(motors: &[(Section<'_>, Option<MotorSpec>)], problems: &mut Problems<'_>) {
    let known = || motors.iter().filter_map(|(entry, motor)| Some((entry, motor.as_ref()?)));
    for (at, (entry, motor)) in known().enumerate() {
        let mut refuse = |key: &str, message: String, fix: &str| entry.report(problems, key, message, fix);
        for (_, earlier) in known().take(at) {
            if earlier.name == motor.name {
                refuse("name", format!("two motors are called {:?}", motor.name), "give each its own name");
            }
            if earlier.slave == motor.slave {
                let message = format!("slave = {:#x} is that of {} already", motor.slave, earlier.name);
                refuse("slave", message, "give each motor its own id, with its maker's program");
            } else if earlier.master == motor.master && earlier.slave & 0xf == motor.slave & 0xf {
                let message = format!(
                    "{} answers with master = {:#x} too, and cannot be told from it",
                    earlier.name, motor.master
                );
                refuse("master", message, "give each motor its own master, with its maker's program");
            }
        }
        let brakes = known().take(at).filter_map(|(_, earlier)| Some((earlier, earlier.brake.as_ref()?)));
        for (earlier, brake) in brakes {
            let Some(own) = motor.brake.as_ref().filter(|own| (&own.chip, own.line) == (&brake.chip, brake.line))
            else {
                continue;
            };
            if own.released_high != brake.released_high {
                let message = format!("the same line releases the brake of {} at the other level", earlier.name);
                refuse("brake", message, "write the same released for both, or another line");
            }
        }
        if motor.master == PARAMETERS {
            refuse("master", "master = 0x7ff is the id of all motors' parameters".to_owned(), "choose another");
        }
        for (_, other) in known() {
            if COMMANDS.iter().any(|offset| other.slave + offset == motor.master) {
                let message =
                    format!("master = {:#x} is an id of commands to {}, which would obey it", motor.master, other.name);
                refuse("master", message, "choose another, usually slave + 0x10");
            }
        }
    }
}

/// The axes of the entry's actions. They follow from its motors, whose limits are those that are kept: a
/// table beside them would say what nobody heeds.
pub(super) fn axes(damiao: &DamiaoSpec, section: &Section<'_>, problems: &mut Problems<'_>) -> ActionSpec {
    if section.has("action") {
        let message = format!("motors take no table [{}]: their axes follow from them", section.child("action"));
        let fix = format!(
            "remove the table, and write limits as position, velocity, torque and slew of each motor in [{}]",
            section.child("can")
        );
        section.report(problems, "action", message, fix);
    }
    let range = |motor: &MotorSpec| match motor.mode {
        MotorMode::Velocity => ("rad/s", [-motor.velocity, motor.velocity]),
        MotorMode::Mit { .. } | MotorMode::PositionVelocity => ("rad", motor.position),
    };
    let of =
        |value: fn((&'static str, [f64; 2])) -> f64| damiao.motors.iter().map(|motor| value(range(motor))).collect();
    ActionSpec {
        names: damiao.motors.iter().map(|motor| motor.name.clone()).collect(),
        units: damiao.motors.iter().map(|motor| range(motor).0.to_owned()).collect(),
        min: of(|(_, [low, _])| low),
        max: of(|(_, [_, high])| high),
    }
}
