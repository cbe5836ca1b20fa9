//! What happened on a bus of motors, in words.

use std::fmt;
use std::sync::Arc;

use super::fault::{Fault, Part, Strange};
use super::notice::{Notice, Reason, Refusal};
use crate::control::damiao::parameter::Parameter;

/// Something to be shown, with the names of its motors.
#[derive(Debug)]
pub struct Words<'a, T> {
    what: &'a T,
    names: &'a [String],
    stops: &'a [Arc<str>],
}

impl<'a, T> Words<'a, T> {
    /// With the names of emergency stops.
    #[must_use]
    pub const fn with_stops(self, stops: &'a [Arc<str>]) -> Self {
        Self { stops, ..self }
    }

    /// Something else, with the same names.
    const fn with<U>(&self, what: &'a U) -> Words<'a, U> {
        Words { what, names: self.names, stops: self.stops }
    }

    fn name(&self, motor: usize) -> &str {
        self.names.get(motor).map_or("?", String::as_str)
    }
}

impl Fault {
    /// In words; `names` are those of the motors.
    pub const fn words<'a>(&'a self, names: &'a [String]) -> Words<'a, Self> {
        Words { what: self, names, stops: &[] }
    }
}

impl Notice {
    /// In words; `names` are those of the motors.
    pub const fn words<'a>(&'a self, names: &'a [String]) -> Words<'a, Self> {
        Words { what: self, names, stops: &[] }
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

impl fmt::Display for Strange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Jump { from, to } => write!(
                f,
                "reports {to:.3} rad after {from:.3} rad, which it cannot have reached: a damaged frame, or another \
                 program set its zero"
            ),
            Self::Beyond { position, range: [low, high] } => {
                write!(f, "is at {position:.3} rad, outside its limits of {low} to {high} rad")
            }
            Self::Fast { velocity, limit } => {
                write!(f, "moves at {velocity:.2} rad/s, beyond its limit of {limit} rad/s")
            }
            Self::Strong { torque, limit } => write!(f, "reports {torque:.2} Nm, beyond its limit of {limit} Nm"),
            Self::Driven { torque } => {
                write!(f, "moves away from its command, against its full torque limit of {torque} Nm")
            }
            Self::Frozen { position, velocity } => {
                write!(f, "reports {velocity:.2} rad/s but stays at {position:.3} rad: its encoder stands still")
            }
            Self::Blocked { torque } => {
                write!(
                    f,
                    "does not move at its torque limit of {torque} Nm: it is blocked, or its encoder stands still"
                )
            }
            Self::Lagging { command, is } => write!(f, "does not follow: {command:.3} is commanded, {is:.3} reported"),
        }
    }
}

impl fmt::Display for Words<'_, Fault> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self.what {
            Fault::Silent { motor } => write!(f, "motor {} does not answer", self.name(motor)),
            Fault::Latched { motor, status } => write!(f, "motor {} reports {status}", self.name(motor)),
            Fault::Hot { motor, part, celsius, limit } => {
                write!(f, "motor {}: {part} at {celsius} °C (limit {limit} °C)", self.name(motor))
            }
            Fault::Strange { motor, what } => write!(f, "motor {} {what}", self.name(motor)),
            Fault::Changed { motor, parameter, value } => {
                write!(f, "{parameter} of motor {} is {value} now: another program set it", self.name(motor))
            }
            Fault::OtherMaster { motor } => {
                write!(f, "another program on the bus commands motor {}: end it", self.name(motor))
            }
            Fault::Far { motor, position, target } => write!(
                f,
                "motor {} is at {position:.2} rad, and actions ask for {target:.2} rad: bring them together, or raise \
                 `first_target`",
                self.name(motor)
            ),
            Fault::Stalled { after } => {
                write!(f, "rapid was held up: no motor was commanded for {} ms", after.as_millis())
            }
            Fault::Brake { motor } => {
                write!(f, "the brake of motor {} cannot be driven: the log gives the reason", self.name(motor))
            }
            Fault::NotReleased { motor } => {
                write!(f, "the brake of motor {} was not released in time", self.name(motor))
            }
            Fault::Dropped { motor } => write!(f, "motor {} is no longer enabled", self.name(motor)),
            Fault::EmergencyStop(trip) => f.write_str(&trip.text(self.stops)),
            Fault::NotEnabled { motor } => write!(f, "motor {} does not become enabled", self.name(motor)),
            Fault::NotDisabled { motor } => write!(f, "motor {} does not become disabled", self.name(motor)),
            Fault::Unread { motor, parameter } => {
                write!(f, "motor {} does not report its {parameter}", self.name(motor))
            }
            Fault::Unusable { motor, parameter: Parameter::PMax, value }
                if value.number().is_finite() && value.number() > 0.0 =>
            {
                write!(f, "motor {} reports at most {value} rad, and its `position` lies beyond that", self.name(motor))
            }
            Fault::Unusable { motor, parameter, value } => {
                write!(f, "{parameter} of motor {} is {value}, and cannot be used or changed", self.name(motor))
            }
        }
    }
}

impl fmt::Display for Words<'_, Refusal> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.what {
            Refusal::Length => f.write_str("it does not have one number for each motor"),
            Refusal::NotFinite => f.write_str("one of its numbers is not finite"),
            Refusal::Old => f.write_str("it is too old"),
            Refusal::Early => f.write_str("its time is in the future"),
            Refusal::Returning => f.write_str("joints are being driven back into their limits"),
            Refusal::Far { motor } => write!(
                f,
                "it is the first after arming, and motor {} is farther from it than `first_target`",
                self.name(*motor)
            ),
        }
    }
}

impl fmt::Display for Words<'_, Notice> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.what {
            Notice::Ready => f.write_str("all motors have answered; they are disarmed"),
            Notice::Unanswered { motor } => write!(f, "motor {} has not answered yet", self.name(*motor)),
            Notice::RangesDiffer { motor, read, shipped: [p, v, t] } => write!(
                f,
                "motor {} counts in PMAX {} VMAX {} TMAX {}, but its type is shipped with {p} {v} {t}; the motor's own are \
                 used",
                self.name(*motor),
                read.position(),
                read.velocity(),
                read.torque(),
            ),
            Notice::ParameterSet { motor, parameter, was, is } => {
                write!(f, "{parameter} of motor {} was {was} and is {is} now", self.name(*motor))
            }
            Notice::Warm { motor, part, celsius, limit } => {
                write!(f, "motor {}: {part} at {celsius} °C (limit {limit} °C)", self.name(*motor))
            }
            Notice::Strange { motor, what } => write!(f, "motor {} {what}", self.name(*motor)),
            Notice::OtherMaster { motor } => {
                write!(f, "another program on the bus commands motor {}: end it before arming", self.name(*motor))
            }
            Notice::Latched { motor, status } => {
                write!(f, "motor {} reports {status}: arming clears it", self.name(*motor))
            }
            Notice::Cleared { motor, status } => {
                write!(f, "motor {} reported {status}: cleared in order to arm", self.name(*motor))
            }
            Notice::Arming => f.write_str("motors are being armed"),
            Notice::Armed => f.write_str("motors are armed, and hold until an action comes"),
            Notice::Returning => {
                f.write_str("motors are armed, and joints outside their limits are driven back slowly")
            }
            Notice::Returned => f.write_str("all joints are within their limits: motors hold until an action comes"),
            Notice::Following => f.write_str("motors follow actions"),
            Notice::Holding => f.write_str("no action came in time: motors hold"),
            Notice::Disabled(Reason::Asked) => f.write_str("motors are disabled"),
            Notice::Disabled(Reason::Deadman) => f.write_str("no action came for too long: motors are disabled"),
            Notice::Fault(fault) => {
                write!(f, "{}: all motors are stopped", self.with(fault))
            }
            Notice::Kept { damped, held, braked } => {
                let parts = [
                    ("damped until disarmed", damped),
                    ("holding until disarmed", held),
                    ("holding until the brake is engaged", braked),
                ];
                for (word, bits) in parts.into_iter().filter(|(_, bits)| **bits != 0) {
                    write!(f, "{word}: ")?;
                    let named = self.names.iter().enumerate().filter(|(index, _)| bits >> (index % 16) & 1 == 1);
                    for (_, name) in named {
                        write!(f, "{name} ")?;
                    }
                }
                f.write_str("(any others are disabled)")
            }
            Notice::NotBraked { motor } => write!(
                f,
                "the brake of motor {} cannot be driven: its motor alone holds the joint; support it before disarming",
                self.name(*motor)
            ),
            Notice::Clamped { motor, target, used } => {
                write!(f, "target {target} of motor {} is beyond its limits; {used} is used", self.name(*motor))
            }
            Notice::Refused(refusal) => {
                write!(f, "an action is refused: {}", self.with(refusal))
            }
        }
    }
}
