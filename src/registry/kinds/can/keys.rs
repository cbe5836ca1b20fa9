//! Reads `[device.NAME.can]` with its motors, and derives the axes of actions from them.

use std::time::Duration;

use super::effector;
use super::motors::{
    BRAKE_KEYS, BrakeKeys, BrakeSpec, DamiaoSpec, MAX_MOTORS, MotionSpec, MotorKind, MotorMode, MotorSpec, Stop,
    StopSpec, WatchSpec,
};
use super::mounting::Mounting;
use super::{CanAdapter, CanProtocol, CanSpec, SLCAN_BITRATES};
use crate::keys::{About, Key, Keys, NUMBERS, Own, Real, Time, TimeOrNever, Words, keys, table, text, whole};
use crate::kinds::{NodeSpec, Settings};
use crate::parse::input::GpioKeys;
use crate::parse::program::Programs;
use crate::section::Section;
use crate::spec::{ActionSpec, DeviceSpec};
use crate::units::show_duration;

pub(crate) const TABLE: Key = table("can", "A CAN adapter.", || About::Table(&[CanKeys::KEYS, BusKeys::KEYS]));
const TEN_SECONDS: Time = Time(Duration::from_millis(1), Duration::from_secs(10));

keys! {
    /// `[device.NAME.can]`.
    struct CanKeys {
        /// How the adapter is accessed.
        adapter: CanAdapter = Words(&CanAdapter::WORDS), or CanAdapter::SocketCan;
        /// Bits a second on the bus.
        bitrate: u32 = whole::<u32>(10_000, 1_000_000), or 1_000_000;
        /// What is on the bus: frames, recorded as they are, or motors.
        protocol: Option<bool> = Words(&PROTOCOLS), usually "`\"raw\"`";
    }

    /// Keys that only a bus of motors has.
    struct BusKeys {
        /// Commands a second to each motor.
        hz: u32 = whole::<u32>(10, 1000), or 200;
        /// Without an action for this long the motors hold.
        deadman: Option<Duration> = TEN_SECONDS, usually "twice the time between actions";
        /// After holding for this long they are disabled.
        disable_after: Option<Duration> = TimeOrNever(Duration::from_millis(10)), or None;
        /// The motors' internal limit: without a frame for this long they stop.
        timeout: Option<Duration> = TEN_SECONDS, usually "`\"100ms\"`, or four commands";
        /// A motor that leaves frames unanswered for this long is silent: with two cycles at 200 Hz it is reported within
        /// 50 ms.
        silent_after: Duration = TEN_SECONDS, or Duration::from_millis(40);
    } => {
        /// The motors, one per axis.
        motors = About::List(MOTOR_KEYS);
    }
}

/// The keys of a motor.
const MOTOR_KEYS: Keys =
    &[MotorKeys::KEYS, Mounting::KEYS, MotionSpec::KEYS, WatchSpec::KEYS, StopSpec::KEYS, HeatKeys::KEYS];
/// How the command of a position starts and changes.
const MOTION_KEYS: [&str; 3] = ["acceleration", "soft_start", "first_target"];

keys! {
    /// What a motor is, how it is driven, and its limits: slow enough to step aside.
    struct MotorKeys {
        /// Its name, and that of its axis.
        name: Option<String> = NAME, need "write name = what its axis is called, for example name = \"gripper\"";
        /// CAN id that it listens to. 0x100 and more are the ids of commands in other modes.
        slave: Option<u16> = whole::<u16>(1, 0xff), usually "needed";
        /// CAN id that it answers with.
        master: Option<u16> = whole::<u16>(0, 0x7ff), usually "`slave` + 16";
        /// Its type.
        kind "type": Option<MotorKind> = Words(&MotorKind::WORDS), need &format!("write type = one of {}", kinds());
        /// How it is driven: by stiffness and damping, or by its own loop.
        mode: Option<MotorMode> = Words(&MODES), usually "`\"mit\"`";
        /// Stiffness, Nm/rad.
        kp: Option<f64> = Real(0.0, 500.0), usually "needed with mode mit";
        /// Damping, Nm s/rad.
        kd: Option<f64> = Real(0.0, 5.0), usually "needed with mode mit";
        /// `[lowest, highest]` position, rad.
        position: Option<Vec<f64>> = NUMBERS, usually "needed";
        /// Highest speed, rad/s.
        velocity: f64 = Real(0.001, 1000.0), within Real(0.001, shipped(kind)[1]), usually "2, or that of its type if it is lower",
            or_else SPEED.min(shipped(kind)[1]);
        /// Highest torque, Nm.
        torque: f64 = Real(0.001, 1000.0), within Real(0.001, shipped(kind)[2]), usually "a tenth of that of its type",
            or_else TORQUE_SHARE * shipped(kind)[2];
        /// Highest change of the command: rad/s of a position, rad/s² of a velocity.
        slew: f64 = Real(0.001, 100_000.0), within Real(0.001, most_slew(mode, kind)), usually "`velocity`; 10 times it of a velocity",
            or_else default_slew(mode, velocity);
    }

    /// What its parts tolerate.
    struct HeatKeys {
        /// Highest temperature of its transistors, °C; a finger tolerates less than they do.
        max_mos: f64 = Real(20.0, 150.0), or 80.0;
        /// Highest temperature of its winding, °C.
        max_rotor: f64 = Real(20.0, 150.0), or 80.0;
    }
}

const NAME: Own<String> = text(name, "letters, digits, `_`, `-` and `.`, at most 64");
const IMPEDANCE: MotorMode = MotorMode::Mit { kp: 0.0, kd: 0.0 };
const MODES: [(&str, MotorMode); 3] =
    [("mit", IMPEDANCE), ("position", MotorMode::PositionVelocity), ("velocity", MotorMode::Velocity)];
/// What can be on a bus, by its keyword: motors, or not.
const PROTOCOLS: [(&str, bool); 2] = [("raw", false), ("damiao", true)];

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

pub(crate) fn read(entry: &Section<'_>, programs: Programs<'_>) -> Option<Settings> {
    entry.no_tables(&["camera", "tty", "serial", "lan"], "a CAN adapter", "can");
    let table = entry.table_or_empty("can");
    table.known(&[CanKeys::KEYS, BusKeys::KEYS]);
    let CanKeys { adapter, bitrate, protocol } = CanKeys::values(&table);
    check_bitrate(&table, adapter, bitrate);
    let protocol = if protocol == Some(true) {
        let mut damiao = damiao(&table)?;
        damiao.effector = effector::read(entry, &damiao, programs).map(Box::new);
        CanProtocol::Damiao(damiao)
    } else {
        // An unknown word has been reported; the intended protocol is unknown.
        if protocol.is_some() || !table.has("protocol") {
            no_motors(&table);
        }
        effector::refuse(entry);
        CanProtocol::Raw
    };
    Some((NodeSpec::Can(CanSpec { adapter, bitrate, protocol }), None))
}

fn no_motors(table: &Section<'_>) {
    let of_motors = std::iter::once("motors").chain(BusKeys::KEYS.iter().map(|key| key.name));
    if let Some(key) = of_motors.into_iter().find(|key| table.has(key)) {
        let message = format!("a bus whose frames are recorded as they are has no {key}");
        table.report(key, message, "write protocol = \"damiao\" for a bus of motors, or remove it");
    }
}

fn check_bitrate(table: &Section<'_>, adapter: CanAdapter, bitrate: u32) {
    let (message, fix) = match adapter {
        CanAdapter::Slcan if !SLCAN_BITRATES.contains(&bitrate) => {
            let known: Vec<String> = SLCAN_BITRATES.iter().map(ToString::to_string).collect();
            (format!("slcan has no name for {bitrate} bits a second"), format!("write one of: {}", known.join(", ")))
        }
        CanAdapter::Damiao if bitrate != 1_000_000 => (
            "rapid does not set the bit rate of Damiao's adapter".to_owned(),
            "remove bitrate; the adapter is set up with its maker's program, and its motors talk at 1000000".to_owned(),
        ),
        _ => return,
    };
    table.report("bitrate", message, fix);
}

/// Reads the keys of `protocol = "damiao"`; `None` if a problem with them was reported.
fn damiao(table: &Section<'_>) -> Option<DamiaoSpec> {
    let BusKeys { hz, deadman, disable_after, timeout, silent_after } = BusKeys::values(table);
    let second = Duration::from_secs(1);
    let two = second * DEADMAN_PERIODS / hz;
    if let Some(short) = deadman.filter(|deadman| *deadman < two) {
        let message = format!("deadman = {short:?} is less than {DEADMAN_PERIODS} commands at {hz} Hz take");
        let least = two.as_micros().div_ceil(1000);
        let fix = format!("write deadman = \"{least}ms\" or more, or remove it for twice the time between actions");
        table.report("deadman", message, fix);
    }
    let least = second * TIMEOUT_PERIODS / hz;
    if let Some(short) = timeout.filter(|timeout| *timeout < least) {
        let message = format!("timeout = {short:?} is less than {TIMEOUT_PERIODS} commands at {hz} Hz take");
        table.report("timeout", message, format!("write timeout = \"{}ms\" or more", least.as_millis() + 1));
    }
    let timeout = timeout.unwrap_or(Duration::from_millis(100).max(least));
    let motors = motors(table)?;
    Some(DamiaoSpec { motors, hz, deadman, disable_after, timeout, silent_after, effector: None })
}

/// Warns of motors that continue for long without commands.
pub(crate) fn warn_of_slow_stop(devices: &[(Section<'_>, DeviceSpec)]) {
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
    if let Some(count) = listed.filter(|count| !(1..=MAX_MOTORS).contains(count)) {
        return table.refuse("motors", format!("{count} motors"), format!("list 1 to {MAX_MOTORS} motors"));
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
    entry.known(MOTOR_KEYS);
    let keys = MotorKeys::values(entry);
    entry.need("slave", "write slave = the motor's CAN id, 1 to 255");
    entry.need("position", "write position = [lowest, highest] in rad, as far as the joint may go");
    let mode = mode(entry, &keys);
    let position = position(entry, keys.position, mode);
    let mounting = mounting(entry, keys.kind, position);
    let motion = motion(entry, keys.slew, mode);
    let (watch, stop, brake) = (WatchSpec::values(entry), stop(entry, mode), brake(entry));
    let HeatKeys { max_mos, max_rotor } = HeatKeys::values(entry);
    let slave = keys.slave?;
    Some(MotorSpec {
        name: keys.name?,
        slave,
        master: if entry.has("master") { keys.master? } else { slave + MASTER_OFFSET },
        kind: keys.kind?,
        mode: mode?,
        mounting,
        position: position?,
        velocity: keys.velocity,
        torque: keys.torque,
        slew: keys.slew,
        motion,
        watch,
        stop,
        brake,
        max_mos,
        max_rotor,
    })
}

fn name(entry: &Section<'_>, key: &str) -> Option<String> {
    let name = entry.text(key)?;
    let legal = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    if name.is_empty() || name.len() > 64 || !name.chars().all(legal) {
        let fix = "use letters, digits, `_`, `-` and `.`, at most 64";
        return entry.refuse(key, format!("{name:?} cannot be a motor's name"), fix);
    }
    Some(name.to_owned())
}

fn kinds() -> String {
    MotorKind::ALL.map(MotorKind::name).join(", ")
}

/// Highest position, speed and torque of a type.
fn shipped(kind: Option<MotorKind>) -> [f64; 3] {
    kind.map_or([1000.0; 3], MotorKind::shipped)
}

/// A position can change no faster than the motor turns; a speed within a hundredth of a second.
fn most_slew(mode: Option<MotorMode>, kind: Option<MotorKind>) -> f64 {
    let [_, most_speed, _] = shipped(kind);
    if mode == Some(MotorMode::Velocity) { 100.0 * most_speed } else { most_speed }
}

/// To its highest speed within a tenth of a second.
fn default_slew(mode: Option<MotorMode>, velocity: f64) -> f64 {
    if mode == Some(MotorMode::Velocity) { 10.0 * velocity } else { velocity }
}

fn position(entry: &Section<'_>, limits: Option<Vec<f64>>, mode: Option<MotorMode>) -> Option<[f64; 2]> {
    // Eight times the range of the factory settings; a wheel turns continuously.
    let farthest = if mode == Some(MotorMode::Velocity) { 1000.0 } else { 100.0 };
    let limits = limits?;
    match limits.as_slice() {
        [low, high] if low.abs() <= farthest && high.abs() <= farthest && low < high => Some([*low, *high]),
        _ => {
            let message = format!("position = {limits:?} is not a range");
            let fix = format!("write [lowest, highest] in rad, the highest above the lowest, within {farthest}");
            entry.refuse("position", message, fix)
        }
    }
}

/// How the motor sits on its joint, whose limits are these. What it cannot report there is an error.
fn mounting(entry: &Section<'_>, kind: Option<MotorKind>, limits: Option<[f64; 2]>) -> Mounting {
    let mounting = Mounting::values(entry);
    let zero = mounting.zero;
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

fn mode(entry: &Section<'_>, keys: &MotorKeys) -> Option<MotorMode> {
    let mode = if entry.has("mode") { keys.mode? } else { IMPEDANCE };
    if mode != IMPEDANCE {
        // Frames of these modes have no room for any of them.
        for key in ["kp", "kd", "torque"].into_iter().filter(|key| entry.has(key)) {
            let message = format!("a motor that runs its own loop takes no {key}");
            entry.report(key, message, format!("remove {key}, or write mode = \"mit\""));
        }
        return Some(mode);
    }
    for (key, most) in [("kp", 500), ("kd", 5)] {
        let fix = format!("write {key} = 0 to {most}, or mode = \"position\" or \"velocity\" for the motor's own loop");
        entry.need(key, &fix);
    }
    let (kp, kd) = (keys.kp?, keys.kd?);
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
    if mode != Some(MotorMode::Velocity) {
        return MotionSpec::values(entry, slew);
    }
    for key in MOTION_KEYS.into_iter().filter(|key| entry.has(key)) {
        let message = format!("a commanded velocity has no {key}");
        entry.report(key, message, format!("remove {key}; slew limits its acceleration"));
    }
    MotionSpec::of_slew(slew)
}

/// How the motor stops at a fault, or at an emergency stop.
fn stop(entry: &Section<'_>, mode: Option<MotorMode>) -> StopSpec {
    let has_damping = mode.is_none_or(|mode| matches!(mode, MotorMode::Mit { .. }));
    let spec = StopSpec::values(entry, if has_damping { Stop::Damp } else { Stop::Hold });
    for (key, stop) in [("own_fault", spec.own_fault), ("other_fault", spec.other_fault), ("emergency", spec.emergency)]
    {
        if stop == Stop::Brake && !entry.has("brake") {
            let fix = format!("write {BRAKE}, or another way to stop");
            entry.report(key, format!("{key} = \"brake\", and the motor has no brake"), fix);
        }
        if stop == Stop::Damp && !has_damping {
            let fix = "write \"hold\", which it does with all its torque, \"limp\" or \"brake\"";
            entry.report(key, "a motor that runs its own loop cannot be damped", fix);
        }
    }
    spec
}

/// The brake of the joint, if it has one.
fn brake(entry: &Section<'_>) -> Option<BrakeSpec> {
    let table = entry.table("brake")?;
    table.known(&BRAKE_KEYS);
    let GpioKeys { chip, line } = GpioKeys::values(&table);
    let BrakeKeys { released, engages_in, releases_in } = BrakeKeys::values(&table);
    Some(BrakeSpec { chip: chip?, line: line?, released_high: released?, engages_in, releases_in })
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
pub(crate) fn axes(damiao: &DamiaoSpec, section: &Section<'_>) -> ActionSpec {
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
