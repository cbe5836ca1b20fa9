//! What can be wrong with a bus of motors, and with whose joint; in words: `words`.

use std::time::Duration;

use super::words::Words;
use crate::action::Trip;
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

/// Something that a motor does and should not. Numbers are rad, rad/s and Nm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Strange {
    /// It reports a position to which it cannot have come since its last frame: the frame is damaged, or another
    /// program set its zero.
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
    /// It is faster than it may be.
    Fast {
        /// How fast it is.
        velocity: f64,
        /// How fast it may be.
        limit: f64,
    },
    /// It reports more torque than it may have.
    Strong {
        /// How much.
        torque: f64,
        /// The limit.
        limit: f64,
    },
    /// It moves away from its command, though pushed with all the torque that it may have.
    Driven {
        /// The limit.
        torque: f64,
    },
    /// It reports a speed and always the same position: its encoder stands still.
    Frozen {
        /// The position.
        position: f64,
        /// The speed.
        velocity: f64,
    },
    /// It stands still, though pushed with all the torque that it may have: it is blocked, or its encoder stands still.
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
    /// A motor is hotter than it may be.
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
    /// A motor did so for too long.
    Strange {
        /// Which.
        motor: usize,
        /// What.
        what: Strange,
    },
    /// A motor that is on was set otherwise by another program.
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
    /// Actions ask for a position that is far from where the joint is.
    Far {
        /// Which motor.
        motor: usize,
        /// Where it is, rad.
        position: f64,
        /// What the actions ask for, rad.
        target: f64,
    },
    /// This program was held up: no motor was commanded for so long.
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
    /// A motor answers, and did not become enabled.
    NotEnabled {
        /// Which.
        motor: usize,
    },
    /// A motor answers, and did not become disabled.
    NotDisabled {
        /// Which.
        motor: usize,
    },
    /// A motor answers, but not to the question for a parameter.
    Unread {
        /// Which.
        motor: usize,
        /// Which.
        parameter: Parameter,
    },
    /// An emergency stop: nothing is wrong with a motor.
    EmergencyStop(Trip),
    /// A parameter of a motor is one that nothing can be done with, or stayed so when it was set.
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
    /// The motor that it is of, by its position in the entry; `None` where it is of none.
    #[must_use]
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

    /// The motor whose own joint is at fault, by its position in the entry. A joint that is sound, and overloaded or
    /// commanded by another program, or whose brake cannot be driven, need not fall for it: with that, its motor is all that
    /// holds it.
    #[must_use]
    pub const fn own(&self) -> Option<usize> {
        match *self {
            Self::OtherMaster { .. }
            | Self::Brake { .. }
            | Self::Changed { parameter: Parameter::Timeout, .. }
            | Self::Strange { what: Strange::Driven { .. } | Strange::Beyond { .. }, .. } => None,
            _ => self.motor(),
        }
    }

    /// In words; `names` are those of the motors.
    #[must_use]
    pub const fn words<'a>(&'a self, names: &'a [String]) -> Words<'a, Self> {
        Words::new(self, names)
    }
}
