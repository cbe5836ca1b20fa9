//! Motors of a CAN bus with Damiao's protocol, as `[device.NAME.can]` declares them.
//!
//! Invariant: the ranges of a motor's numbers are read from the motor. [`MotorKind`] holds the factory
//! settings, for comparison.

use std::path::PathBuf;
use std::time::Duration;

use super::effector::EffectorSpec;
use super::mounting::Mounting;
use crate::keys::{About, Key, Real, Time, TimeOrNever, Words, keys};
use crate::parse::input;
use crate::section::of_nothing;

rapid_core::words! {
    /// Every way to stop and its name.
    Stop, 4: "limp" = Limp, "damp" = Damp, "hold" = Hold, "brake" = Brake;
}

/// Most motors of one bus: an action has an axis each, a sample 6 values each.
pub const MAX_MOTORS: usize = 10;

/// `protocol = "damiao"`.
#[derive(Debug, Clone, PartialEq)]
pub struct DamiaoSpec {
    /// One motor per axis, in the order of samples and actions, `1..=`[`MAX_MOTORS`] of them. Their answers are distinct on
    /// the bus.
    pub motors: Vec<MotorSpec>,
    /// Commands a second to each motor, `10..=1000`, default 200.
    pub hz: u32,
    /// Without an action for this long the motors hold; at least two commands; `None` is twice the time
    /// between actions.
    pub deadman: Option<Duration>,
    /// After holding for this long they are disabled; `None` is never.
    pub disable_after: Option<Duration>,
    /// The motors' internal limit: without a frame for this long they stop. Above 0.
    pub timeout: Duration,
    /// A motor that leaves frames unanswered for this long is silent, default 40 ms: with two cycles at 200 Hz it is
    /// reported within 50 ms.
    pub silent_after: Duration,
    /// The arm that the motors are the joints of, if actions are poses of its tip.
    pub effector: Option<Box<EffectorSpec>>,
}

/// One motor.
#[derive(Debug, Clone, PartialEq)]
pub struct MotorSpec {
    /// Its name, in messages and as the name of its axis.
    pub name: String,
    /// CAN id it listens to (Damiao: `CAN_ID` or `ESC_ID`), `1..=0xff`.
    pub slave: u16,
    /// CAN id it answers with (Damiao: `MST_ID` or Master ID), `0..=0x7ff`.
    pub master: u16,
    /// The type of the motor.
    pub kind: MotorKind,
    /// How it is driven.
    pub mode: MotorMode,
    /// How it sits on its joint. All positions, velocities and torques of this entry are of the joint.
    pub mounting: Mounting,
    /// Lowest and highest position, rad; finite, the lowest first.
    pub position: [f64; 2],
    /// Highest speed, rad/s; above 0.
    pub velocity: f64,
    /// Highest torque, Nm; above 0. Bounds the torque that results from the position error in [`MotorMode::Mit`], and
    /// has no effect in the other modes, whose frames have no torque.
    pub torque: f64,
    /// Highest change of the command: rad/s of a commanded position, rad/s² of a commanded velocity;
    /// above 0.
    pub slew: f64,
    /// How it starts.
    pub motion: MotionSpec,
    /// Which behaviour is a fault.
    pub watch: WatchSpec,
    /// How it stops at a fault.
    pub stop: StopSpec,
    /// Its holding brake, if it has one that is controlled here.
    pub brake: Option<BrakeSpec>,
    /// Highest temperature of its transistors, °C.
    pub max_mos: f64,
    /// Highest temperature of its winding, °C.
    pub max_rotor: f64,
}

/// How a joint stops at a fault or an emergency stop. A disarm, and the end of the program, disable it regardless.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// Disabled: a joint under load falls.
    Limp,
    /// Without stiffness, with only its damping: a joint under load sinks slowly. Motors in the modes
    /// [`MotorMode::PositionVelocity`] and [`MotorMode::Velocity`] have no frame for it: they are not configured so,
    /// and stop as with [`Stop::Hold`].
    Damp,
    /// At its last commanded position; within its torque in [`MotorMode::Mit`], with all torque of the motor in the
    /// others.
    Hold,
    /// As [`Stop::Hold`] until its brake is engaged, then disabled.
    Brake,
}

/// A brake that holds a joint while its motor is off: a line of a GPIO chip releases it. It is released while the motor
/// is on, unless that stops as [`Stop::Brake`], and engaged at all other times.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct BrakeSpec {
    /// The chip, for example `/dev/gpiochip0`.
    pub chip: PathBuf,
    /// Its line; joints with the same line share a brake, which is released while all of them permit it.
    pub line: u32,
    /// The level that releases it.
    pub released_high: bool,
    /// Time from the change of the level until it holds.
    pub engages_in: Duration,
    /// Time from the change of the level until it no longer holds; both are at most [`BrakeSpec::SLOWEST`].
    pub releases_in: Duration,
}

impl BrakeSpec {
    /// Longest accepted time of a brake.
    pub const SLOWEST: Duration = Duration::from_secs(2);
}

keys! {
    /// How a motor stops, by fault. A faulty joint is not driven further; the others sink slowly with it. An emergency stop
    /// disables all.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct StopSpec(others: Stop) {
        /// How it stops at a fault of its own.
        own_fault: Stop = Words(&Stop::WORDS), or Stop::Limp;
        /// How it stops at another motor's.
        other_fault: Stop = Words(&Stop::WORDS), usually "`\"damp\"`, and `\"hold\"` with its own loop", or_else others;
        /// How it stops at an emergency stop.
        emergency: Stop = Words(&Stop::WORDS), or Stop::Limp;
        /// How long it holds before it is disabled; never is until a disarm.
        hold_for: Option<Duration> = TimeOrNever(Duration::from_millis(10)), or None;
    } => {
        /// The holding brake of its joint.
        brake = About::Table(&BRAKE_KEYS);
    }
}

/// The keys of the table of a brake.
pub(crate) const BRAKE_KEYS: [&[Key]; 2] = [input::GpioKeys::KEYS, BrakeKeys::KEYS];

keys! {
    /// Those of them that a line of a GPIO chip does not have by itself.
    pub(crate) struct BrakeKeys {
        /// The level that releases it, best the one that a broken wire does not have.
        released: Option<bool> = Words(&input::LEVELS), need RELEASED;
        /// Time from the change of the level until it holds. A small spring-applied brake takes the default.
        engages_in: Duration = Time(Duration::ZERO, BrakeSpec::SLOWEST), or Duration::from_millis(100);
        /// Time from the change of the level until it no longer holds.
        releases_in: Duration = Time(Duration::ZERO, BrakeSpec::SLOWEST), or Duration::from_millis(100);
    }
}

const RELEASED: &str = "write released = \"high\" or \"low\": the level that lets the joint turn, best the one that a broken wire \
                        does not have";

impl Default for StopSpec {
    fn default() -> Self {
        of_nothing(|table| Self::values(table, Stop::Damp))
    }
}

keys! {
    /// How the command of a position starts and changes. Has no effect in [`MotorMode::Velocity`], whose slew limit is an
    /// acceleration.
    #[derive(Debug, Clone, Copy, PartialEq)]
    pub struct MotionSpec(slew: f64) {
        /// Highest acceleration of the command, rad/s².
        acceleration: f64 = Real(0.001, 100_000.0), usually "20 times `slew`", or_else slew / SPEEDS_UP_IN;
        /// After an arm the command reaches its highest speed in this time.
        soft_start: Duration = Time(Duration::ZERO, Duration::from_secs(10)), or Duration::from_secs(1);
        /// How far from the joint the first action after an arm may be, rad.
        first_target: f64 = Real(0.001, 200.0), or 0.5;
    }
}

/// Time to the highest speed unless the entry states otherwise, seconds.
const SPEEDS_UP_IN: f64 = 0.05;

impl MotionSpec {
    /// For a command that changes by `slew` (rad/s) at most.
    pub fn of_slew(slew: f64) -> Self {
        of_nothing(|table| Self::values(table, slew))
    }
}

keys! {
    /// Which behaviour of a motor is a fault. The defaults suit a joint of an arm.
    #[derive(Debug, Clone, Copy, PartialEq)]
    pub struct WatchSpec {
        /// How far outside its limits it may be, rad; an arm farther out is rejected.
        margin: f64 = Real(0.0, 1.0), or 0.1;
        /// How far it may be from the command of its own loop, rad, in the mode `position`.
        lag: f64 = Real(0.001, 10.0), or 0.3;
        /// How long it may be blocked at its highest torque; never is for a gripper that holds something.
        blocked_after: Option<Duration> = TimeOrNever(Duration::from_millis(500)), or Some(Duration::from_secs(2));
    }
}

impl Default for WatchSpec {
    fn default() -> Self {
        of_nothing(Self::values)
    }
}

/// How a motor is driven, and the meaning of its axis of an action.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MotorMode {
    /// Impedance: torque = `kp` (position error) - `kd` velocity. The action is a position, rad.
    Mit {
        /// Nm/rad, `0..=500`.
        kp: f64,
        /// Nm s/rad, `0..=5`.
        kd: f64,
    },
    /// The motor's own position loop, at most at the motor's [`MotorSpec::velocity`]. The action is a
    /// position, rad.
    PositionVelocity,
    /// The motor's own velocity loop. The action is a velocity, rad/s.
    Velocity,
}

/// Defines [`MotorKind`] with its values and their names in `devices.toml`.
macro_rules! motor_kinds {
    ($($kind:ident = $name:literal),+ $(,)?) => {
        /// Damiao's motors, by name: programs number them differently.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[allow(missing_docs)]
        pub enum MotorKind {
            $($kind),+
        }

        impl MotorKind {
            /// All of them.
            pub const ALL: [Self; [$($name),+].len()] = [$(Self::$kind),+];

            /// Each with its name.
            pub(crate) const WORDS: [(&str, Self); Self::ALL.len()] = [$(($name, Self::$kind)),+];

            /// As it is written in `devices.toml`.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$kind => $name),+
                }
            }
        }
    };
}

motor_kinds! {
    Dm3507 = "DM3507",
    Dm4310 = "DM4310",
    Dm4310V48 = "DM4310_48V",
    Dm4340 = "DM4340",
    Dm4340V48 = "DM4340_48V",
    Dm6006 = "DM6006",
    Dm8006 = "DM8006",
    Dm8009 = "DM8009",
    Dm10010 = "DM10010",
    Dm10010L = "DM10010L",
    Dmg6220 = "DMG6220",
    Dmh3510 = "DMH3510",
    Dmh6215 = "DMH6215",
}

impl MotorKind {
    /// PMAX in rad, VMAX in rad/s and TMAX in Nm of the factory settings. Source: the tables of the
    /// public drivers `DM_CAN.py` and of `LeRobot`.
    pub const fn shipped(self) -> [f64; 3] {
        match self {
            Self::Dm3507 | Self::Dm4310 => [12.5, 30.0, 10.0],
            Self::Dm4310V48 => [12.5, 50.0, 10.0],
            Self::Dm4340 => [12.5, 8.0, 28.0],
            Self::Dm4340V48 => [12.5, 10.0, 28.0],
            Self::Dm6006 => [12.5, 45.0, 20.0],
            Self::Dm8006 => [12.5, 45.0, 40.0],
            Self::Dm8009 => [12.5, 45.0, 54.0],
            Self::Dm10010L => [12.5, 25.0, 200.0],
            Self::Dm10010 => [12.5, 20.0, 200.0],
            Self::Dmh3510 => [12.5, 280.0, 1.0],
            Self::Dmh6215 | Self::Dmg6220 => [12.5, 45.0, 10.0],
        }
    }

    /// The motor of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_found() {
        for kind in MotorKind::ALL {
            assert_eq!(MotorKind::named(kind.name()), Some(kind));
        }
        assert_eq!(MotorKind::named("DM1"), None);
    }
}
