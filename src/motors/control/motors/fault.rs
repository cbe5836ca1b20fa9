//! Faults of a bus of motors and of its joints; their text: `words`.

use std::time::Duration;

use rapid_core::action::Trip;

use crate::control::damiao::codec::MotorStatus;
use crate::control::damiao::parameter::{Parameter, Value};

/// Which part of a motor is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Its transistors.
    Mos,
    /// Its winding.
    Rotor,
}

/// Abnormal behaviour of a motor. Numbers are rad, rad/s and Nm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Strange {
    /// It reports a position that it cannot have reached since its last frame: the frame is damaged, or another program
    /// set its zero.
    Jump {
        /// Where it was.
        from: f64,
        /// The position it reports.
        to: f64,
    },
    /// It is outside its limits.
    Beyond {
        /// Where it is.
        position: f64,
        /// The limits.
        range: [f64; 2],
    },
    /// It exceeds its speed limit.
    Fast {
        /// How fast it is.
        velocity: f64,
        /// The limit.
        limit: f64,
    },
    /// It exceeds its torque limit.
    Strong {
        /// How much.
        torque: f64,
        /// The limit.
        limit: f64,
    },
    /// It moves away from its command at the full torque limit.
    Driven {
        /// The limit.
        torque: f64,
    },
    /// It reports a speed and an unchanging position: its encoder is frozen.
    Frozen {
        /// The position.
        position: f64,
        /// The speed.
        velocity: f64,
    },
    /// It stands still at the full torque limit: it is blocked, or its encoder is frozen.
    Blocked {
        /// The limit.
        torque: f64,
    },
    /// Its own loop does not bring it to its command.
    Lagging {
        /// The command.
        command: f64,
        /// What it reports.
        is: f64,
    },
}

/// Why all motors of a bus were disabled. Motors are given by their position in the entry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// A motor does not answer.
    Silent {
        /// Which.
        motor: usize,
    },
    /// A motor latched a fault, or reports something else that is neither enabled nor disabled.
    Latched {
        /// Which.
        motor: usize,
        /// What it reports.
        status: MotorStatus,
    },
    /// A motor is over its temperature limit.
    Hot {
        /// Which.
        motor: usize,
        /// Which part.
        part: Part,
        /// °C.
        celsius: f64,
        /// °C.
        limit: f64,
    },
    /// A motor behaved abnormally for too long.
    Strange {
        /// Which.
        motor: usize,
        /// What.
        what: Strange,
    },
    /// Another program changed a parameter of a motor that is on.
    Changed {
        /// Which.
        motor: usize,
        /// What was set.
        parameter: Parameter,
        /// What it is.
        value: Value,
    },
    /// Another program commands a motor.
    OtherMaster {
        /// Which.
        motor: usize,
    },
    /// Actions request a position far from where the joint is.
    Far {
        /// Which motor.
        motor: usize,
        /// Where it is, rad.
        position: f64,
        /// The position requested, rad.
        target: f64,
    },
    /// This program stalled: no motor was commanded for this long.
    Stalled {
        /// How long.
        after: Duration,
    },
    /// The brake of a joint can be neither engaged nor released.
    Brake {
        /// Which motor.
        motor: usize,
    },
    /// The brake of a joint was not released in time.
    NotReleased {
        /// Which motor.
        motor: usize,
    },
    /// A motor was enabled and no longer is: it lost its power, or another program disabled it.
    Dropped {
        /// Which.
        motor: usize,
    },
    /// A motor answers but did not become enabled.
    NotEnabled {
        /// Which.
        motor: usize,
    },
    /// A motor answers but did not become disabled.
    NotDisabled {
        /// Which.
        motor: usize,
    },
    /// A motor answers, but not to the query of a parameter.
    Unread {
        /// Which.
        motor: usize,
        /// Which.
        parameter: Parameter,
    },
    /// An emergency stop: nothing is wrong with a motor.
    EmergencyStop(Trip),
    /// A parameter of a motor is unusable, or remained so when it was set.
    Unusable {
        /// Which.
        motor: usize,
        /// Which.
        parameter: Parameter,
        /// What it is.
        value: Value,
    },
}

impl Fault {
    /// The motor concerned, by its position in the entry, if any.
    pub const fn motor(&self) -> Option<usize> {
        match *self {
            Self::EmergencyStop(_) | Self::Stalled { .. } => None,
            Self::Silent { motor }
            | Self::Latched { motor, .. }
            | Self::Hot { motor, .. }
            | Self::Strange { motor, .. }
            | Self::Changed { motor, .. }
            | Self::OtherMaster { motor }
            | Self::Dropped { motor }
            | Self::Brake { motor }
            | Self::NotReleased { motor }
            | Self::Far { motor, .. }
            | Self::NotEnabled { motor }
            | Self::NotDisabled { motor }
            | Self::Unread { motor, .. }
            | Self::Unusable { motor, .. } => Some(motor),
        }
    }

    /// The motor whose own joint is at fault, by its position in the entry. A healthy joint that is overloaded,
    /// commanded by another program, or without a working brake need not fall: in the last case only its motor holds
    /// it.
    pub const fn own(&self) -> Option<usize> {
        match *self {
            Self::OtherMaster { .. }
            | Self::Brake { .. }
            | Self::Changed { parameter: Parameter::Timeout, .. }
            | Self::Strange { what: Strange::Driven { .. } | Strange::Beyond { .. }, .. } => None,
            _ => self.motor(),
        }
    }
}
