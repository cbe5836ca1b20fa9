//! Permission: whether the actuator of this run may move.
//!
//! Every order of a run is given here, whatever its source: the operator at the screen, another program, an emergency
//! stop or an enabling switch, the end of the run.
//!
//! Invariant: a disarm is never refused, and holds for the rest of the run, whether or not an actuator is plugged in, until a
//! newer arm.
//! Invariant: an arm that was given before the last disarm arrived does nothing, in whatever order the two arrive. Nor
//! does one that is older than [`VOID_AFTER`], or arrives while no actuator is plugged in, or while an input of an
//! [`Interlock`](crate::interlock) does not run, nor one that was given before that input stopped, whatever it has reported
//! since.
//! Invariant: nothing here waits, locks or allocates.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use crate::action::{Order, OrderSlot};
use crate::bell::Bell;
use crate::interlock::{Blocked, InputState, Interlocks};
use crate::time::Stamp;

/// An arm that took longer to arrive does nothing.
pub const VOID_AFTER: Duration = Duration::from_secs(1);

/// See the module's comment.
#[derive(Debug, Default)]
pub struct Permission {
    /// When the last disarm arrived; 0 before the first.
    disarmed: AtomicU64,
    /// Orders for the actuator.
    slot: OrderSlot,
    /// Actuators that are plugged in.
    actuators: AtomicUsize,
    /// The actuator is armed when it is first plugged in: no other order has arrived since.
    at_first_plug: AtomicBool,
    /// Emergency stops and enabling switches.
    interlocks: Interlocks,
}

/// Why an arm does nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ArmRefused {
    /// There is no actuator.
    #[error("no actuator is plugged in: plug it in, then arm it")]
    NoActuator,
    /// It took too long to arrive.
    #[error("the order is {:.1} s old, and 1 s is allowed: give it again", .0.as_secs_f64())]
    Old(Duration),
    /// A disarm arrived in between.
    #[error("a disarm came after this order was given: give it again if the actuator is to move")]
    Overtaken,
    /// Its time is in the future: it was given on another machine, or is forged.
    #[error("the order is from a later time than now")]
    Early,
    /// An emergency stop or an enabling switch prevents it.
    #[error(transparent)]
    Blocked(#[from] Blocked),
}

impl Permission {
    /// For a new run; `at_first_plug`: its actuator is armed when it is first plugged in.
    pub fn new(at_first_plug: bool) -> Self {
        Self { at_first_plug: AtomicBool::new(at_first_plug), ..Self::default() }
    }

    /// The same with these emergency stops and enabling switches: nothing may move before each of them runs.
    #[must_use]
    pub fn with_interlocks(self, interlocks: Interlocks) -> Self {
        Self { interlocks, ..self }
    }

    /// Input `index` of the interlocks has this state, as determined at `now`. An input that does not run stops the
    /// actuator before this returns. Returns whether the state has changed.
    pub fn report(&self, index: usize, state: InputState, now: Stamp) -> bool {
        let is_news = self.interlocks.set(index, state, now);
        if is_news && state != InputState::Runs {
            self.at_first_plug.store(false, Ordering::SeqCst);
            // After the input's state, and before the order: see `stopped_since`.
            self.disarmed.fetch_max(now.0.max(1), Ordering::SeqCst);
            self.slot.give(self.interlocks.order(index).unwrap_or(Order::Disarm));
        }
        is_news
    }

    /// The state of input `index` of the interlocks, as it was reported last.
    pub fn state(&self, index: usize) -> InputState {
        self.interlocks.state(index)
    }

    /// The actuator may not move, from `now` on. Returns whether one is plugged in.
    pub fn disarm(&self, now: Stamp) -> bool {
        self.at_first_plug.store(false, Ordering::SeqCst);
        // Before the order: see `stopped_since`.
        self.disarmed.fetch_max(now.0.max(1), Ordering::SeqCst);
        self.slot.give(Order::Disarm);
        self.actuators.load(Ordering::SeqCst) > 0
    }

    /// The actuator may move; the order was given at `given` and has arrived `now`.
    ///
    /// # Errors
    /// When it does nothing, and why.
    pub fn arm(&self, given: Stamp, now: Stamp) -> Result<(), ArmRefused> {
        self.allow(Order::Arm, given, now)
    }

    /// As [`Self::arm`], for an actuator that drives joints back that are outside their limits.
    ///
    /// # Errors
    /// When it does nothing, and why.
    pub fn arm_back(&self, given: Stamp, now: Stamp) -> Result<(), ArmRefused> {
        self.allow(Order::ArmBack, given, now)
    }

    fn allow(&self, arm: Order, given: Stamp, now: Stamp) -> Result<(), ArmRefused> {
        self.at_first_plug.store(false, Ordering::SeqCst);
        let age = now.since(given);
        if given > now {
            return Err(ArmRefused::Early);
        } else if age > VOID_AFTER {
            return Err(ArmRefused::Old(age));
        } else if self.is_overtaken(given) {
            return Err(ArmRefused::Overtaken);
        } else if self.actuators.load(Ordering::SeqCst) == 0 {
            return Err(ArmRefused::NoActuator);
        }
        self.interlocks.check()?;
        self.slot.give(arm);
        // What stopped the actuator in the meantime may have been given to the slot before this.
        if let Some((void, stop)) = self.stopped_since(given.0.saturating_sub(1)) {
            self.slot.give(stop);
            return Err(void);
        }
        Ok(())
    }

    /// What makes void an arm that has just been given, and the order that has to follow it: whatever has stopped the
    /// actuator after `last`.
    ///
    /// The time of the last disarm is read before the states: an input stores its state and its time before that one, and
    /// is then seen here. Its order is not always a disarm: a joint that is to hold at an emergency stop must not fall.
    fn stopped_since(&self, last: u64) -> Option<(ArmRefused, Order)> {
        let is_overtaken = self.disarmed.load(Ordering::SeqCst) > last;
        let order = |index| self.interlocks.order(index).unwrap_or(Order::Disarm);
        if let Err(blocked) = self.interlocks.check() {
            let stop = order(blocked.index);
            return Some((blocked.into(), stop));
        }
        // An input that runs again has stopped the actuator nevertheless.
        let stop = || self.interlocks.stopped_after(last).map_or(Order::Disarm, order);
        is_overtaken.then(|| (ArmRefused::Overtaken, stop()))
    }

    fn is_overtaken(&self, given: Stamp) -> bool {
        given.0 <= self.disarmed.load(Ordering::SeqCst)
    }

    /// An actuator was plugged in: it receives orders until the returned value is dropped, but none that were given
    /// before.
    pub fn attend(self: &Arc<Self>) -> Attended {
        self.slot.take_pending().for_each(drop);
        self.actuators.fetch_add(1, Ordering::SeqCst);
        Attended(Arc::clone(self))
    }
}

/// An actuator that is plugged in, and its orders.
#[derive(Debug)]
pub struct Attended(Arc<Permission>);

impl Attended {
    /// Arms it by `give`, without an order, if the first actuator that is plugged in is to be armed. At most once a run,
    /// unless `give` fails. Returns why it was not armed, if an interlock prevents it.
    ///
    /// # Errors
    /// Those of `give`.
    pub fn arm_at_first_plug<E>(&self, mut give: impl FnMut(Order) -> Result<(), E>) -> Result<Option<Blocked>, E> {
        let Permission { at_first_plug, disarmed, interlocks, .. } = &*self.0;
        // Before the swap: a disarm stores its time after it has reverted the flag.
        let before = disarmed.load(Ordering::SeqCst);
        // Another actuator may have set the flag just before such a disarm reverts it.
        if !at_first_plug.swap(false, Ordering::SeqCst) || before != 0 {
            return Ok(None);
        }
        if let Err(blocked) = interlocks.check() {
            return Ok(Some(blocked));
        }
        give(Order::Arm).inspect_err(|_| self.was_not_armed())?;
        // What stopped the actuator in the meantime may have been carried out before the arm.
        let Some((void, stop)) = self.0.stopped_since(before) else {
            return Ok(None);
        };
        give(stop)?;
        match void {
            ArmRefused::Blocked(blocked) => Ok(Some(blocked)),
            _ => Ok(None),
        }
    }

    /// Names of the emergency stops that an order may refer to.
    pub fn stops(&self) -> &Arc<[Arc<str>]> {
        self.0.interlocks.names()
    }

    /// It could not be armed: the next one is to be, unless an order came meanwhile.
    fn was_not_armed(&self) {
        self.0.at_first_plug.store(true, Ordering::SeqCst);
        // A disarm stores its time first, and then reverts this: it is either seen here, or comes after.
        if self.0.disarmed.load(Ordering::SeqCst) != 0 {
            self.0.at_first_plug.store(false, Ordering::SeqCst);
        }
    }

    /// Rings with every order, until the next [`Self::take_pending`].
    pub fn bell(&self) -> &Bell {
        self.0.slot.bell()
    }

    /// Takes its orders since the last call, in their order of execution.
    pub fn take_pending(&self) -> impl Iterator<Item = Order> + use<> {
        self.0.slot.take_pending()
    }
}

impl Drop for Attended {
    fn drop(&mut self) {
        self.0.actuators.fetch_sub(1, Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests;
