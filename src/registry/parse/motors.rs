//! The motors of `[device.NAME.can]`, and the axes of actions derived from them.

use std::time::Duration;

use super::effector;
use super::input::{LEVELS, gpio_line};
use crate::diagnostic::did_you_mean;
use crate::section::Section;
use crate::spec::{
    ActionSpec, BrakeSpec, CanProtocol, CanSpec, DamiaoSpec, DeviceSpec, MotionSpec, MotorKind, MotorMode, MotorSpec,
    Mounting, NodeSpec, Stop, StopSpec, WatchSpec,
};
use crate::units::show_duration;

const KEYS: [&str; 11] =
    ["name", "slave", "master", "type", "mode", "kp", "kd", "position", "velocity", "torque", "slew"];
/// How it sits on its joint.
const MOUNTING_KEYS: [&str; 2] = ["zero", "reversed"];
/// How the command of a position starts and changes.
const MOTION_KEYS: [&str; 3] = ["acceleration", "soft_start", "first_target"];
/// Which behaviour of a motor is a fault, and how it stops then.
const FAULT_KEYS: [&str; 8] =
    ["margin", "lag", "blocked_after", "own_fault", "other_fault", "emergency", "hold_for", "brake"];
const TEMPERATURE_KEYS: [&str; 2] = ["max_mos", "max_rotor"];
/// Limits: six numbers per motor, and 64 in an action or a sample.
const MOST: usize = 10;
/// Motors that hold when no action arrives must not do so between two commands.
const DEADMAN_PERIODS: u32 = 2;
/// A motor that stops when it receives nothing must not do so between two commands.
const TIMEOUT_PERIODS: u32 = 4;
/// A motor that continues for longer than this after this program is killed moves too far.
const LONG_TIMEOUT: Duration = Duration::from_millis(500);
/// Default limits of a motor: slow enough to step aside.
const SPEED: f64 = 2.0;
/// Share of the highest torque of its type, likewise.
const TORQUE_SHARE: f64 = 0.1;
/// The winding's insulation and the transistors tolerate more; a finger does not.
const TEMPERATURE: f64 = 80.0;
/// By convention a motor answers with its own id plus this.
const MASTER_OFFSET: u16 = 0x10;
/// Ids of commands, relative to a motor's own: MIT, position and velocity, velocity, position and force.
const COMMANDS: [u16; 4] = [0, 0x100, 0x200, 0x300];
/// The least damping above 0 in a MIT frame, Nm s/rad: 12 bits from 0 to 5.
const KD_STEP: f64 = 5.0 / 4095.0;
/// The id by which parameters of all motors are read and written.
const PARAMETERS: u16 = 0x7ff;

/// Example of a brake.
const BRAKE: &str = "brake = { chip = \"/dev/gpiochip0\", line = 4, released = \"high\" }";
/// A small spring-applied brake takes this long to engage or to release, unless its data sheet states otherwise.
const BRAKE_TIME: Duration = Duration::from_millis(100);

/// Reads the keys of `protocol = "damiao"`; `None` if a problem with them was reported.
pub(super) fn damiao(table: &Section<'_>) -> Option<DamiaoSpec> {
    let (ms, second) = (Duration::from_millis, Duration::from_secs);
    let hz = table.integer("hz", 10..=1000).unwrap_or(200);
    let deadman = table.duration("deadman", ms(1)..=second(10));
    let two = second(1) * DEADMAN_PERIODS / hz;
    if let Some(short) = deadman.filter(|deadman| *deadman < two) {
        let message = format!("deadman = {short:?} is less than {DEADMAN_PERIODS} commands at {hz} Hz take");
        let least = two.as_micros().div_ceil(1000);
        let fix = format!("write deadman = \"{least}ms\" or more, or remove it for twice the time between actions");
        table.report("deadman", message, fix);
    }
    let disable_after = or_never(table, "disable_after", ms(10), None);
    let silent_after = table.duration("silent_after", ms(1)..=second(10));
    let least = second(1) * TIMEOUT_PERIODS / hz;
    let timeout = table.duration("timeout", ms(1)..=second(10));
    if let Some(short) = timeout.filter(|timeout| *timeout < least) {
        let message = format!("timeout = {short:?} is less than {TIMEOUT_PERIODS} commands at {hz} Hz take");
        table.report("timeout", message, format!("write timeout = \"{}ms\" or more", least.as_millis() + 1));
    }
    let motors = motors(table);
    Some(DamiaoSpec {
        motors: motors?,
        hz,
        deadman,
        disable_after,
        timeout: timeout.unwrap_or(ms(100).max(least)),
        silent_after: silent_after.unwrap_or(ms(40)),
        effector: None,
    })
}

/// Warns of motors that continue for long without commands.
pub(super) fn warn_of_slow_stop(devices: &[(Section<'_>, DeviceSpec)]) {
    for (section, device) in devices {
        let NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) = &device.node else { continue };
        if motors.timeout <= LONG_TIMEOUT {
            continue;
        }
        let timeout = show_duration(motors.timeout);
        let message = format!(
            "timeout = {timeout}: the motors follow their last command for this long when rapid and its guard are gone"
        );
        let fix = format!("write timeout = \"500ms\" or less in [{}.can]", section.entry);
        section.warn_at(section.at, message, fix);
    }
}

fn motors(table: &Section<'_>) -> Option<Vec<MotorSpec>> {
    if !table.has("motors") {
        let example = "write motors = [{ name = \"gripper\", slave = 5, type = \"DMH3510\", kp = 0.8, kd = 0.05, \
                       position = [-1, 1] }]";
        table.missing("motors", example);
        return None;
    }
    let listed = table.field("motors")?.get_ref().as_array().map(|list| list.len());
    let entries = table.tables("motors")?;
    if let Some(count) = listed.filter(|count| !(1..=MOST).contains(count)) {
        return table.refuse("motors", format!("{count} motors"), format!("list 1 to {MOST} motors"));
    }
    if listed != Some(entries.len()) {
        return None;
    }
    let read: Vec<_> =
        entries.into_iter().map(|entry| (motor(&entry), entry)).map(|(motor, entry)| (entry, motor)).collect();
    check_pairs(&read);
    read.into_iter().map(|(_, motor)| motor).collect()
}

fn motor(entry: &Section<'_>) -> Option<MotorSpec> {
    entry.allow(&[&KEYS[..], &MOUNTING_KEYS, &MOTION_KEYS, &FAULT_KEYS, &TEMPERATURE_KEYS].concat());
    let name = name(entry);
    // 0x100 and more are the ids of commands in other modes.
    let slave: Option<u16> = entry.integer("slave", 1..=0xff);
    let master = entry.integer("master", 0..=0x7ff);
    let kind = kind(entry);
    entry.need("slave", "write slave = the motor's CAN id, 1 to 255");
    entry.need("position", "write position = [lowest, highest] in rad, as far as the joint may go");
    let (most_speed, most_torque) = kind.map_or((1000.0, 1000.0), |kind| {
        let [_, velocity, torque] = kind.shipped();
        (velocity, torque)
    });
    let velocity = above_zero(entry, "velocity", most_speed).unwrap_or(SPEED.min(most_speed));
    let torque = above_zero(entry, "torque", most_torque).unwrap_or(TORQUE_SHARE * most_torque);
    let mode = mode(entry);
    let position = position(entry, mode);
    let mounting = mounting(entry, kind, position);
    // A position can change no faster than the motor turns; a speed within a hundredth of a second.
    let most_slew = if mode == Some(MotorMode::Velocity) { 100.0 * most_speed } else { most_speed };
    // To its highest speed within a tenth of a second.
    let default_slew = if mode == Some(MotorMode::Velocity) { 10.0 * velocity } else { velocity };
    let slew = above_zero(entry, "slew", most_slew).unwrap_or(default_slew);
    let motion = motion(entry, slew, mode);
    let (watch, stop, brake) = (watch(entry), stop(entry, mode), brake(entry));
    let [max_mos, max_rotor] = TEMPERATURE_KEYS.map(|key| entry.number(key, 20.0..=150.0).unwrap_or(TEMPERATURE));
    let slave = slave?;
    let mode = mode?;
    Some(MotorSpec {
        name: name?,
        slave,
        master: if entry.has("master") { master? } else { slave + MASTER_OFFSET },
        kind: kind?,
        mode,
        mounting,
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

fn name(entry: &Section<'_>) -> Option<String> {
    if !entry.has("name") {
        entry.missing("name", "write name = what its axis is called, for example name = \"gripper\"");
        return None;
    }
    let name = entry.text("name")?;
    let legal = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    if name.is_empty() || name.len() > 64 || !name.chars().all(legal) {
        let fix = "use letters, digits, `_`, `-` and `.`, at most 64";
        return entry.refuse("name", format!("{name:?} cannot be a motor's name"), fix);
    }
    Some(name.to_owned())
}

fn kind(entry: &Section<'_>) -> Option<MotorKind> {
    let known: Vec<&str> = MotorKind::ALL.iter().map(|kind| kind.name()).collect();
    if !entry.has("type") {
        entry.missing("type", &format!("write type = one of {}", known.join(", ")));
        return None;
    }
    let text = entry.text("type")?;
    MotorKind::named(text)
        .or_else(|| entry.refuse("type", format!("unknown type {text:?}"), did_you_mean(text, &known, "write one of")))
}

fn position(entry: &Section<'_>, mode: Option<MotorMode>) -> Option<[f64; 2]> {
    // Eight times the range of the factory settings; a wheel turns continuously.
    let farthest = if mode == Some(MotorMode::Velocity) { 1000.0 } else { 100.0 };
    let limits = entry.numbers("position")?;
    match limits.as_slice() {
        [low, high] if low.abs() <= farthest && high.abs() <= farthest && low < high => Some([*low, *high]),
        _ => {
            let message = format!("position = {limits:?} is not a range");
            let fix = format!("write [lowest, highest] in rad, the highest above the lowest, within {farthest}");
            entry.refuse("position", message, fix)
        }
    }
}

/// How the motor sits on its joint, whose limits are these. What it cannot report there is a mistake.
fn mounting(entry: &Section<'_>, kind: Option<MotorKind>, limits: Option<[f64; 2]>) -> Mounting {
    let zero = entry.number("zero", f64::MIN..=f64::MAX).unwrap_or_default();
    let mounting = Mounting { zero, reversed: entry.flag("reversed").unwrap_or_default() };
    let Some(kind) = kind else { return mounting };
    let [most, ..] = kind.shipped();
    let is_beyond = |position: f64| position.abs() > most;
    if is_beyond(zero) {
        let message = format!("zero = {zero:?} is farther than a {} can count, {most} rad", kind.name());
        let fix = "write what the motor reports at the zero of its joint, in rad: 90 degrees are 1.571 rad";
        entry.report("zero", message, fix);
        return mounting;
    }
    // Limits that are farther by themselves are of a motor that was set to count farther.
    if let Some(limits) = limits.filter(|limits| !limits.iter().any(|end| is_beyond(*end))) {
        let [low, high] = mounting.motor_range(limits);
        if is_beyond(low) || is_beyond(high) {
            let message = format!(
                "zero = {zero:?} puts position = {limits:?} at {low:.2} to {high:.2} rad of the motor, and a {} counts to \
                 {most} rad",
                kind.name()
            );
            let fix =
                "narrow position, or set the zero of the motor nearer to that of its joint, with its maker's program";
            entry.report("zero", message, fix);
        }
    }
    mounting
}

/// A number above zero.
fn above_zero(entry: &Section<'_>, key: &str, most: f64) -> Option<f64> {
    entry.number(key, 0.001..=most)
}

fn mode(entry: &Section<'_>) -> Option<MotorMode> {
    let zero = MotorMode::Mit { kp: 0.0, kd: 0.0 };
    let words = [("mit", zero), ("position", MotorMode::PositionVelocity), ("velocity", MotorMode::Velocity)];
    let mode = if entry.has("mode") { entry.choice("mode", &words)? } else { zero };
    let gains = [("kp", 500.0), ("kd", 5.0)];
    if mode != zero {
        // Frames of these modes have no room for any of them.
        for key in ["kp", "kd", "torque"].into_iter().filter(|key| entry.has(key)) {
            let message = format!("a motor that runs its own loop takes no {key}");
            entry.report(key, message, format!("remove {key}, or write mode = \"mit\""));
        }
        return Some(mode);
    }
    let [kp, kd] = gains.map(|(key, most)| {
        let fix = format!("write {key} = 0 to {most}, or mode = \"position\" or \"velocity\" for the motor's own loop");
        entry.need(key, &fix);
        entry.number(key, 0.0..=most)
    });
    let (kp, kd) = (kp?, kd?);
    // Position control without damping oscillates: the maker's manual forbids it. A frame has 12 bits for it.
    if kp > 0.0 && kd < KD_STEP {
        let message = if kd == 0.0 {
            "kp without kd: the motor would oscillate".to_owned()
        } else {
            format!("kd = {kd} is less than a frame can express, {KD_STEP:.5}: the motor would oscillate")
        };
        return entry.refuse("kd", message, "write a higher kd, for example kd = 0.05");
    }
    Some(MotorMode::Mit { kp, kd })
}

/// How the command of a position starts and changes.
fn motion(entry: &Section<'_>, slew: f64, mode: Option<MotorMode>) -> MotionSpec {
    let default = MotionSpec::of_slew(slew);
    if mode == Some(MotorMode::Velocity) {
        for key in MOTION_KEYS.into_iter().filter(|key| entry.has(key)) {
            let message = format!("a commanded velocity has no {key}");
            entry.report(key, message, format!("remove {key}; slew limits its acceleration"));
        }
        return default;
    }
    let soft_start = entry.duration("soft_start", Duration::ZERO..=Duration::from_secs(10));
    MotionSpec {
        acceleration: above_zero(entry, "acceleration", 100_000.0).unwrap_or(default.acceleration),
        soft_start: soft_start.unwrap_or(default.soft_start),
        first_target: above_zero(entry, "first_target", 200.0).unwrap_or(default.first_target),
    }
}

/// Which behaviour of the motor is a fault.
fn watch(entry: &Section<'_>) -> WatchSpec {
    let default = WatchSpec::default();
    let half_a_second = Duration::from_millis(500);
    WatchSpec {
        margin: entry.number("margin", 0.0..=1.0).unwrap_or(default.margin),
        lag: above_zero(entry, "lag", 10.0).unwrap_or(default.lag),
        blocked_after: or_never(entry, "blocked_after", half_a_second, default.blocked_after),
    }
}

/// How the motor stops at a fault, or at an emergency stop.
fn stop(entry: &Section<'_>, mode: Option<MotorMode>) -> StopSpec {
    let has_damping = mode.is_none_or(|mode| matches!(mode, MotorMode::Mit { .. }));
    let other_fault = if has_damping { Stop::Damp } else { Stop::Hold };
    let default = StopSpec { other_fault, ..StopSpec::default() };
    let choice = |key| {
        let stop = entry.has(key).then(|| entry.choice(key, &Stop::WORDS)).flatten()?;
        if stop == Stop::Brake && !entry.has("brake") {
            let fix = format!("write {BRAKE}, or another way to stop");
            entry.report(key, format!("{key} = \"brake\", and the motor has no brake"), fix);
        }
        if stop == Stop::Damp && !has_damping {
            let fix = "write \"hold\", which it does with all its torque, \"limp\" or \"brake\"";
            entry.report(key, "a motor that runs its own loop cannot be damped".to_owned(), fix);
        }
        Some(stop)
    };
    let (own_fault, other_fault) = (choice("own_fault"), choice("other_fault"));
    let emergency = choice("emergency");
    StopSpec {
        own_fault: own_fault.unwrap_or(default.own_fault),
        other_fault: other_fault.unwrap_or(default.other_fault),
        emergency: emergency.unwrap_or(default.emergency),
        hold_for: or_never(entry, "hold_for", Duration::from_millis(10), default.hold_for),
    }
}

/// The brake of the joint, if it has one.
fn brake(entry: &Section<'_>) -> Option<BrakeSpec> {
    let table = entry.table("brake")?;
    table.allow(&["chip", "line", "released", "engages_in", "releases_in"]);
    let (chip, line) = gpio_line(&table);
    if !table.has("released") {
        let fix = "write released = \"high\" or \"low\": the level that lets the joint turn, best the one that a broken wire \
                   does not have";
        table.missing("released", fix);
    }
    let released = table.choice("released", &LEVELS);
    let time = |key| table.duration(key, Duration::ZERO..=BrakeSpec::SLOWEST).unwrap_or(BRAKE_TIME);
    let (engages_in, releases_in) = (time("engages_in"), time("releases_in"));
    Some(BrakeSpec { chip: chip?, line: line?, released_high: released?, engages_in, releases_in })
}

/// A time of `least` to an hour, or the word "never".
fn or_never(table: &Section<'_>, key: &str, least: Duration, default: Option<Duration>) -> Option<Duration> {
    match table.word(key) {
        _ if !table.has(key) => default,
        Some("never") => None,
        _ => table.duration(key, least..=Duration::from_hours(1)),
    }
}

/// Names and ids that two motors cannot both have. An answer with the id of a command would be interpreted as
/// one by another motor.
fn check_pairs(motors: &[(Section<'_>, Option<MotorSpec>)]) {
    let known = || motors.iter().filter_map(|(entry, motor)| Some((entry, motor.as_ref()?)));
    for (at, (entry, motor)) in known().enumerate() {
        let refuse = |key: &str, message: String, fix: &str| entry.report(key, message, fix);
        for (_, earlier) in known().take(at) {
            if earlier.name == motor.name {
                refuse("name", format!("two motors are called {:?}", motor.name), "give each its own name");
            }
            if earlier.slave == motor.slave {
                let message = format!("slave = {:#x} is already used by {}", motor.slave, earlier.name);
                refuse("slave", message, "give each motor its own id, with its maker's program");
            } else if earlier.master == motor.master && earlier.slave & 0xf == motor.slave & 0xf {
                let message = format!(
                    "{} answers with master = {:#x} too, and cannot be distinguished from it",
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

/// The axes of the entry's actions. They are derived from its motors, whose limits are applied, or from the tip of their
/// arm: an additional table would have no effect.
pub(super) fn axes(damiao: &DamiaoSpec, section: &Section<'_>) -> ActionSpec {
    if section.has("action") {
        let message = format!("motors take no table [{}]: their axes follow from them", section.child("action"));
        let fix = format!(
            "remove the table, and write limits as position, velocity, torque and slew of each motor in [{}]",
            section.child("can")
        );
        section.report("action", message, fix);
    }
    if let Some(effector) = &damiao.effector {
        return effector::axes(effector);
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
