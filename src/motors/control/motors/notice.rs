//! Notices of a bus of motors, for the log and for events; their text: `words`.

use super::fault::{Fault, Part, Strange};
use crate::control::damiao::codec::{MotorStatus, Ranges};
use crate::control::damiao::parameter::{Parameter, Value};

/// The state of a bus of motors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BusState {
    /// The parameters of the motors are read; none is enabled.
    Probing,
    /// All have answered, none is enabled.
    Disarmed,
    /// An arm was requested: parameters are read again, faults cleared, motors enabled.
    Arming,
    /// All are enabled and follow actions.
    Following,
    /// All are enabled and stay where the last command was, for lack of an action.
    Holding,
    /// All are being disabled.
    Disabling,
    /// All are being kept disabled until an arm is requested.
    Faulted(Fault),
    /// Nothing is sent any more.
    Stopped,
}

/// Why motors were disabled without a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reason {
    /// It was requested.
    Asked,
    /// No action came for too long.
    Deadman,
}

/// Why an action moves nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It does not have one value per axis.
    Length,
    /// A value of it is infinite or NaN.
    NotFinite,
    /// Its tick is further back than the deadman allows.
    Old,
    /// Its tick is in the future.
    Early,
    /// Joints are being driven back into their limits.
    Returning,
    /// It is the first after an arm, and far from the position of a joint.
    Far {
        /// Which motor.
        motor: usize,
    },
}

/// What happened on a bus of motors. Each is reported once when it begins, not again while it lasts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Notice {
    /// All motors have answered: their state is known from now on.
    Ready,
    /// A motor has not answered yet.
    Unanswered {
        /// Which.
        motor: usize,
    },
    /// The ranges of a motor differ from the factory ranges of its kind. Its own are used.
    RangesDiffer {
        /// Which.
        motor: usize,
        /// What it reports.
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
    /// A motor is close to its temperature limit.
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
    /// A motor behaves abnormally.
    Strange {
        /// Which.
        motor: usize,
        /// What.
        what: Strange,
    },
    /// A motor has latched a fault besides the one that stopped all motors.
    Latched {
        /// Which motor.
        motor: usize,
        /// The fault.
        status: MotorStatus,
    },
    /// A latched fault of a motor is cleared, because an arm was requested.
    Cleared {
        /// Which motor.
        motor: usize,
        /// The fault.
        status: MotorStatus,
    },
    /// An arm was requested.
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
    /// The motors stopped by a fault that are still on, a bit each.
    Kept {
        /// Bits of motors that are damped.
        damped: u16,
        /// Bits of motors that hold.
        held: u16,
        /// Bits of motors that hold until their brake does.
        braked: u16,
    },
    /// A motor is kept on until its brake holds the joint, and the brake cannot be driven.
    NotBraked {
        /// Which motor.
        motor: usize,
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
    /// Does it need the attention of an operator?
    pub const fn is_problem(&self) -> bool {
        !matches!(
            self,
            Self::Ready
                | Self::ParameterSet { .. }
                | Self::Arming
                | Self::Armed
                | Self::Returned
                | Self::Following
                | Self::Disabled(Reason::Asked)
        )
    }
}
