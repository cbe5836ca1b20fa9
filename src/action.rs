//! Actions: what a policy, an expert or another program wants an actuator to do next.
//!
//! An action travels as a sample of numbers, like the state of an arm: little-endian 64-bit floats in the
//! order of the actuator's `[device.NAME.action]` table, in its units. Its capture time is the tick of
//! the control grid it is the action of.

use serde::Serialize;

/// Topic of actions, on the bus and in recordings.
pub const ACTION_TOPIC: &str = "/action";
/// Numbers in an action, at most.
pub const MAX_ACTION: usize = 64;

/// May an actuator move? Told to whoever watches it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Arming {
    /// It takes no actions until it is armed.
    Disarmed,
    /// It is being armed.
    Arming,
    /// It follows actions.
    Armed,
    /// It is armed and stays where it is: no action came in time.
    Holding,
    /// It disabled itself, and takes no actions until it is armed again.
    Faulted,
}

impl Arming {
    /// The word for it, as in JSON.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Disarmed => "disarmed",
            Self::Arming => "arming",
            Self::Armed => "armed",
            Self::Holding => "holding",
            Self::Faulted => "faulted",
        }
    }
}

/// What an operator asks of an actuator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// It may move from now on.
    Arm,
    /// It may not.
    Disarm,
}

/// What an actuator tells of itself beside its samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActuatorNotice {
    /// May it move now?
    pub arming: Arming,
    /// What happened, for people.
    pub text: String,
    /// Somebody should look after it.
    pub is_problem: bool,
}
