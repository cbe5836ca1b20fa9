//! What a bus of motors tells, for the log and for events; in words: `words`.

use std::time::Duration;

use super::words::Words;
use crate::action::Trip;
use crate::control::damiao::codec::{MotorStatus, Ranges};
use crate::control::damiao::parameter::{Parameter, Value};

/// Where a bus of motors stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BusState {
    /// Motors are asked for their parameters; none is enabled.
    Probing,
    /// All have answered, none is enabled.
    Disarmed,
    /// An arm was asked for: parameters are read again, faults cleared, motors enabled.
    Arming,
    /// All are enabled and go where actions say.
    Following,
    /// All are enabled and stay where the last command was, for want of an action.
    Holding,
    /// All are being disabled.
    Disabling,
    /// All are being kept disabled, until an arm is asked for.
    Faulted(Fault),
    /// Nothing is sent any more.
    Stopped,
}

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
        /// Where it says that it is.
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
    /// A motor latched a fault, or says something else that is neither enabled nor disabled.
    Latched {
        /// Which.
        motor: usize,
        /// What it says.
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

/// Why motors were disabled without a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reason {
    /// Somebody asked for it.
    Asked,
    /// No action came for too long.
    Deadman,
}

/// Why an action moves nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It has not one number for each axis.
    Length,
    /// A number of it is infinite, or none.
    NotFinite,
    /// Its tick is further back than the deadman allows.
    Old,
    /// Its tick is in the future.
    Early,
    /// Joints are being driven back into their limits.
    Returning,
    /// It is the first after an arm, and far from where a joint is.
    Far {
        /// Which motor.
        motor: usize,
    },
}

/// What happened on a bus of motors. Each is told once when it begins, not again while it lasts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Notice {
    /// All motors have answered: their state is known from now on.
    Ready,
    /// A motor has not answered yet.
    Unanswered {
        /// Which.
        motor: usize,
    },
    /// A motor counts in other ranges than its kind is shipped with. Its own are used.
    RangesDiffer {
        /// Which.
        motor: usize,
        /// What it says.
        read: Ranges,
        /// PMAX, VMAX, TMAX of its kind.
        shipped: [f64; 3],
    },
    /// A parameter was set, until the motor loses its power.
    ParameterSet {
        /// Which motor.
        motor: usize,
        /// Which.
        parameter: Parameter,
        /// What it was.
        was: Value,
        /// What it is.
        is: Value,
    },
    /// A motor is nearly as hot as it may be.
    Warm {
        /// Which.
        motor: usize,
        /// Which part.
        part: Part,
        /// °C.
        celsius: f64,
        /// °C.
        limit: f64,
    },
    /// Another program commands a motor, while none of ours is on.
    OtherMaster {
        /// Which.
        motor: usize,
    },
    /// A motor does something that it should not.
    Strange {
        /// Which.
        motor: usize,
        /// What.
        what: Strange,
    },
    /// A motor has latched a fault, beside the one that everything was stopped for.
    Latched {
        /// Which motor.
        motor: usize,
        /// The fault.
        status: MotorStatus,
    },
    /// A fault that a motor has latched is cleared, because an arm was asked for.
    Cleared {
        /// Which motor.
        motor: usize,
        /// The fault.
        status: MotorStatus,
    },
    /// An arm was asked for.
    Arming,
    /// All motors are enabled. They hold until an action comes.
    Armed,
    /// All motors are enabled, and joints outside their limits are driven back into them.
    Returning,
    /// All joints are within their limits again, and hold.
    Returned,
    /// Motors follow actions.
    Following,
    /// Motors hold: no fresh action.
    Holding,
    /// All motors are disabled.
    Disabled(Reason),
    /// All motors are being stopped.
    Fault(Fault),
    /// Of motors stopped by a fault, those that are still on, a bit each: damped, or holding.
    Kept {
        /// Bits of motors that are damped.
        damped: u16,
        /// Bits of motors that hold.
        held: u16,
    },
    /// A target is beyond the limits of its axis; the limit is used.
    Clamped {
        /// Which motor.
        motor: usize,
        /// The target.
        target: f64,
        /// What is used.
        used: f64,
    },
    /// An action moves nothing.
    Refused(Refusal),
}

impl Notice {
    /// Is it about something that an operator should look after?
    #[must_use]
    pub const fn is_problem(&self) -> bool {
        match self {
            Self::Ready
            | Self::ParameterSet { .. }
            | Self::Arming
            | Self::Armed
            | Self::Returned
            | Self::Following
            | Self::Disabled(Reason::Asked) => false,
            Self::Unanswered { .. }
            | Self::RangesDiffer { .. }
            | Self::Warm { .. }
            | Self::Holding
            | Self::Returning
            | Self::Disabled(Reason::Deadman)
            | Self::Fault(_)
            | Self::Strange { .. }
            | Self::OtherMaster { .. }
            | Self::Kept { .. }
            | Self::Cleared { .. }
            | Self::Latched { .. }
            | Self::Clamped { .. }
            | Self::Refused(_) => true,
        }
    }

    /// In words; `names` are those of the motors.
    #[must_use]
    pub const fn words<'a>(&'a self, names: &'a [String]) -> Words<'a, Self> {
        Words::new(self, names)
    }
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
            | Self::Far { motor, .. }
            | Self::NotEnabled { motor }
            | Self::NotDisabled { motor }
            | Self::Unread { motor, .. }
            | Self::Unusable { motor, .. } => Some(motor),
        }
    }

    /// The motor whose own joint is at fault, by its position in the entry. A joint that is sound, and overloaded or
    /// commanded by another program, needs not fall for it.
    #[must_use]
    pub const fn own(&self) -> Option<usize> {
        match *self {
            Self::OtherMaster { .. }
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
