//! What a bus of motors tells, for the log and for events.

use std::collections::VecDeque;
use std::fmt;

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
    /// An arm was asked for.
    Arming,
    /// All motors are enabled. They hold until an action comes.
    Armed,
    /// Motors follow actions.
    Following,
    /// Motors hold: no fresh action.
    Holding,
    /// All motors are disabled.
    Disabled(Reason),
    /// All motors are being disabled.
    Fault(Fault),
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

/// Notices that wait to be taken. The oldest are lost where there is no room, for nothing here
/// allocates.
#[derive(Debug)]
pub(super) struct Notices {
    waiting: VecDeque<Notice>,
    lost: u64,
}

impl Notices {
    /// Notices that may wait.
    const ROOM: usize = 64;

    pub(super) fn new() -> Self {
        Self { waiting: VecDeque::with_capacity(Self::ROOM), lost: 0 }
    }

    pub(super) fn tell(&mut self, notice: Notice) {
        if self.waiting.len() >= Self::ROOM {
            self.waiting.pop_front();
            self.lost += 1;
        }
        self.waiting.push_back(notice);
    }

    pub(super) fn take(&mut self) -> Option<Notice> {
        self.waiting.pop_front()
    }

    pub(super) const fn lost(&self) -> u64 {
        self.lost
    }
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
            | Self::Following
            | Self::Disabled(Reason::Asked) => false,
            Self::Unanswered { .. }
            | Self::RangesDiffer { .. }
            | Self::Warm { .. }
            | Self::Holding
            | Self::Disabled(Reason::Deadman)
            | Self::Fault(_)
            | Self::Clamped { .. }
            | Self::Refused(_) => true,
        }
    }

    /// In words; `names` are those of the motors.
    #[must_use]
    pub const fn words<'a>(&'a self, names: &'a [String]) -> Words<'a, Self> {
        Words { what: self, names }
    }
}

impl Fault {
    /// In words; `names` are those of the motors.
    #[must_use]
    pub const fn words<'a>(&'a self, names: &'a [String]) -> Words<'a, Self> {
        Words { what: self, names }
    }
}

/// Something to be shown, with the names of the motors it speaks of.
#[derive(Debug)]
pub struct Words<'a, T> {
    what: &'a T,
    names: &'a [String],
}

impl<T> Words<'_, T> {
    fn name(&self, motor: usize) -> &str {
        self.names.get(motor).map_or("?", String::as_str)
    }
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Mos => "transistors",
            Self::Rotor => "winding",
        })
    }
}

impl fmt::Display for Words<'_, Fault> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self.what {
            Fault::Silent { motor } => write!(f, "motor {} does not answer", self.name(motor)),
            Fault::Latched { motor, status } => write!(f, "motor {} reports {status}", self.name(motor)),
            Fault::Hot { motor, part, celsius, limit } => {
                write!(f, "the {part} of motor {} have {celsius} °C, more than {limit} °C", self.name(motor))
            }
            Fault::Dropped { motor } => write!(f, "motor {} is no longer enabled", self.name(motor)),
            Fault::NotEnabled { motor } => write!(f, "motor {} does not become enabled", self.name(motor)),
            Fault::NotDisabled { motor } => write!(f, "motor {} does not become disabled", self.name(motor)),
            Fault::Unread { motor, parameter } => write!(f, "motor {} does not tell its {parameter}", self.name(motor)),
            Fault::Unusable { motor, parameter: Parameter::PMax, value }
                if value.number().is_finite() && value.number() > 0.0 =>
            {
                write!(f, "motor {} counts to {value} rad, and its `position` lies beyond that", self.name(motor))
            }
            Fault::Unusable { motor, parameter, value } => {
                write!(f, "{parameter} of motor {} is {value}, and cannot be used or changed", self.name(motor))
            }
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Length => "it has not one number for each motor",
            Self::NotFinite => "a number of it is not finite",
            Self::Old => "it is too old",
            Self::Early => "its time is in the future",
        })
    }
}

impl fmt::Display for Words<'_, Notice> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.what {
            Notice::Ready => f.write_str("all motors have answered; they are disarmed"),
            Notice::Unanswered { motor } => write!(f, "motor {} has not answered yet", self.name(*motor)),
            Notice::RangesDiffer { motor, read, shipped: [p, v, t] } => write!(
                f,
                "motor {} counts in PMAX {} VMAX {} TMAX {}, its type is shipped with {p} {v} {t}; the motor's own are used",
                self.name(*motor),
                read.position(),
                read.velocity(),
                read.torque(),
            ),
            Notice::ParameterSet { motor, parameter, was, is } => {
                write!(f, "{parameter} of motor {} was {was} and is {is} now", self.name(*motor))
            }
            Notice::Warm { motor, part, celsius, limit } => {
                write!(f, "the {part} of motor {} have {celsius} °C, of at most {limit} °C", self.name(*motor))
            }
            Notice::Arming => f.write_str("motors are being armed"),
            Notice::Armed => f.write_str("motors are armed, and hold until an action comes"),
            Notice::Following => f.write_str("motors follow actions"),
            Notice::Holding => f.write_str("no action came in time: motors hold"),
            Notice::Disabled(Reason::Asked) => f.write_str("motors are disabled"),
            Notice::Disabled(Reason::Deadman) => f.write_str("no action came for too long: motors are disabled"),
            Notice::Fault(fault) => write!(f, "{}: all motors are disabled", fault.words(self.names)),
            Notice::Clamped { motor, target, used } => {
                write!(f, "target {target} of motor {} is beyond its limits; {used} is used", self.name(*motor))
            }
            Notice::Refused(refusal) => write!(f, "an action moves nothing: {refusal}"),
        }
    }
}
