//! Actions: what a policy, an expert or another program wants an actuator to do next.
//!
//! An action travels as a sample of numbers, like the state of an arm: little-endian 64-bit floats in the
//! order of the actuator's `[device.NAME.action]` table, in its units. Its capture time is the tick of
//! the control grid it is the action of.

use std::sync::atomic::{AtomicU8, Ordering};

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

/// Orders on their way to whoever carries them out.
///
/// Invariant: a disarm is never lost, and nothing is left of what was said before it.
#[derive(Debug, Default)]
pub struct OrderSlot(AtomicU8);

impl OrderSlot {
    const DISARM: u8 = 1;
    const ARM: u8 = 2;

    /// Leaves an order there.
    pub fn give(&self, order: Order) {
        match order {
            Order::Disarm => self.0.store(Self::DISARM, Ordering::SeqCst),
            Order::Arm => drop(self.0.fetch_or(Self::ARM, Ordering::SeqCst)),
        }
    }

    /// Takes what is there, in the order in which it is to be carried out.
    pub fn take(&self) -> impl Iterator<Item = Order> + use<> {
        let given = self.0.swap(0, Ordering::SeqCst);
        let orders = [(Self::DISARM, Order::Disarm), (Self::ARM, Order::Arm)].into_iter();
        orders.filter(move |(bit, _)| given & bit != 0).map(|(_, order)| order)
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disarm_is_never_lost_and_ends_what_was_said_before() {
        use Order::{Arm, Disarm};
        let slot = OrderSlot::default();
        for (given, taken) in [
            (&[][..], &[][..]),
            (&[Arm], &[Arm]),
            (&[Disarm], &[Disarm]),
            (&[Arm, Disarm], &[Disarm]),
            (&[Disarm, Arm], &[Disarm, Arm]),
            (&[Arm, Disarm, Arm, Arm], &[Disarm, Arm]),
            (&[Disarm, Arm, Disarm], &[Disarm]),
        ] {
            for order in given {
                slot.give(*order);
            }
            assert_eq!(slot.take().collect::<Vec<_>>(), taken, "{given:?}");
            assert_eq!(slot.take().count(), 0);
        }
    }
}
