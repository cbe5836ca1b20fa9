//! Actions: the next motion that a policy, an expert or another program requests of an actuator.
//!
//! An action travels as a sample of numbers, like the state of an arm: little-endian 64-bit floats in the
//! order of the actuator's `[device.NAME.action]` table, in its units. Its capture time is the tick of
//! the control grid that it belongs to.

use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU16, Ordering};

use serde::Serialize;

use crate::bell::Bell;
use crate::time::Stamp;

/// Topic of actions, on the bus and in recordings.
pub const ACTION_TOPIC: &str = "/action";
/// Numbers in an action, at most.
pub const MAX_ACTION: usize = 64;

/// Whether an actuator may move. For screens and recordings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Arming {
    /// It takes no actions until it is armed.
    Disarmed,
    /// It is being armed.
    Arming,
    /// It follows actions.
    Armed,
    /// It is armed and holds its position: no action arrived in time.
    Holding,
    /// It disabled itself, and takes no actions until it is armed again.
    Faulted,
}

impl Arming {
    /// The word for it, as in JSON.
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

/// An order to an actuator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// It may move from now on.
    Arm,
    /// As above; joints that are outside their limits are first driven back into them, slowly.
    ArmBack,
    /// It may not move.
    Disarm,
    /// It may not move, and each joint stops as it is configured for an emergency stop.
    Emergency(Trip),
}

/// What tripped an emergency stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trip {
    /// Which stop, by its position in the registry, below [`MAX_STOPS`](crate::interlock::MAX_STOPS).
    pub stop: u8,
    /// Its input was lost; otherwise it reports stop.
    pub is_lost: bool,
}

impl Trip {
    /// As text; `stops` are the names of all stops.
    pub fn text(self, stops: &[Arc<str>]) -> String {
        let name = stops.get(usize::from(self.stop)).map_or("?", |name| name);
        format!("emergency stop {name} {}", if self.is_lost { "lost" } else { "pressed" })
    }
}

/// Why a sample on the topic of actions is ignored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NoAction {
    /// It is not a list of finite numbers.
    #[error("an action is not a list of 1 to {MAX_ACTION} finite 64-bit floats")]
    NoNumbers,
    /// A policy of this process drives the actuator.
    #[error("another program publishes actions while a policy runs here: end one of them")]
    Foreign,
    /// It is a pose that the arm cannot take.
    #[error("the arm cannot reach the pose of an action, or has no path to it: the action is not followed")]
    OutOfReach,
    /// It is not as long as the actions of the arm.
    #[error("an action does not have as many values as the arm takes")]
    Length,
}

/// Where an actuator reads the action to carry out: the topic of actions.
pub trait ActionSource: std::fmt::Debug + Send + Sync {
    /// Readable when an action may have arrived since the last call of [`Self::newest`]. A program may publish without
    /// ringing it: a caller that waits for it must also poll.
    fn bell(&self) -> Option<BorrowedFd<'_>>;

    /// Writes the newest pending action into `action` and discards older ones; returns it with the tick it belongs to,
    /// or `None` if none is pending.
    ///
    /// # Errors
    /// When all pending samples are invalid, or must not be followed.
    fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction>;
}

/// Orders on their way to the actuator that carries them out.
///
/// Invariant: neither a disarm nor an emergency stop is lost, and no earlier arm survives them. Of several emergency
/// stops the first is named.
#[derive(Debug, Default)]
pub struct OrderSlot {
    given: AtomicU16,
    bell: Bell,
}

impl OrderSlot {
    const DISARM: u16 = 1;
    const ARM: u16 = 2;
    const EMERGENCY: u16 = 4;
    const LOST: u16 = 8;
    /// The arm drives joints back.
    const BACK: u16 = 16;
    const ANY_ARM: u16 = Self::ARM | Self::BACK;
    /// The stop's index is in the bits from here.
    const STOP: u32 = 8;

    /// Adds an order.
    pub fn give(&self, order: Order) {
        let left = |given: u16| match order {
            // The newer arm replaces the older.
            Order::Arm => (given & !Self::ANY_ARM) | Self::ARM,
            Order::ArmBack => (given & !Self::ANY_ARM) | Self::BACK,
            Order::Disarm => (given & !Self::ANY_ARM) | Self::DISARM,
            Order::Emergency(_) if given & Self::EMERGENCY != 0 => given & !Self::ANY_ARM,
            Order::Emergency(Trip { stop, is_lost }) => {
                let cause = (u16::from(stop) << Self::STOP) | if is_lost { Self::LOST } else { 0 };
                (given & Self::DISARM) | Self::EMERGENCY | cause
            }
        };
        // The closure always returns a value.
        let _ = self.given.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |given| Some(left(given)));
        self.bell.ring();
    }

    /// Rings with every order, until the next [`Self::take_pending`].
    pub const fn bell(&self) -> &Bell {
        &self.bell
    }

    /// Takes the pending orders in their order of execution. An emergency stop comes before a disarm, which also turns
    /// off what an emergency stop would hold.
    pub fn take_pending(&self) -> impl Iterator<Item = Order> + use<> {
        // First: an order that arrives in between rings again, which is harmless.
        self.bell.silence();
        let given = self.given.swap(0, Ordering::SeqCst);
        let [stop, _] = (given >> Self::STOP).to_le_bytes();
        let trip = Trip { stop, is_lost: given & Self::LOST != 0 };
        let orders = [
            (Self::EMERGENCY, Order::Emergency(trip)),
            (Self::DISARM, Order::Disarm),
            (Self::ARM, Order::Arm),
            (Self::BACK, Order::ArmBack),
        ];
        orders.into_iter().filter(move |(bit, _)| given & bit != 0).map(|(_, order)| order)
    }
}

/// What an actuator reports in addition to its samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActuatorNotice {
    /// Whether it may move now.
    pub arming: Arming,
    /// What happened, as text for the user.
    pub text: String,
    /// It needs attention.
    pub is_problem: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_is_never_lost_and_no_earlier_arm_survives_it() {
        use Order::{Arm, ArmBack, Disarm, Emergency};
        let [one, two] = [Trip { stop: 0, is_lost: false }, Trip { stop: 15, is_lost: true }].map(Emergency);
        let slot = OrderSlot::default();
        for (given, taken) in [
            (&[][..], &[][..]),
            (&[Arm], &[Arm]),
            (&[Arm, ArmBack], &[ArmBack]),
            (&[ArmBack, Arm], &[Arm]),
            (&[ArmBack, Disarm], &[Disarm]),
            (&[two, ArmBack], &[two, ArmBack]),
            (&[ArmBack, two], &[two]),
            (&[Disarm], &[Disarm]),
            (&[Arm, Disarm], &[Disarm]),
            (&[Disarm, Arm], &[Disarm, Arm]),
            (&[Arm, Disarm, Arm, Arm], &[Disarm, Arm]),
            (&[Disarm, Arm, Disarm], &[Disarm]),
            (&[Arm, two], &[two]),
            (&[two, Arm], &[two, Arm]),
            (&[one, two, Arm], &[one, Arm]),
            (&[two, Arm, one], &[two]),
            (&[Disarm, one, Arm], &[one, Disarm, Arm]),
            (&[two, Arm, Disarm], &[two, Disarm]),
        ] {
            for order in given {
                slot.give(*order);
            }
            assert_eq!(slot.take_pending().collect::<Vec<_>>(), taken, "{given:?}");
            assert_eq!(slot.take_pending().count(), 0);
        }
    }
}
