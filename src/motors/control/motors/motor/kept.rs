//! A motor that was stopped by a fault or an emergency stop, and is still on: damped, or where it is.
//!
//! Invariant: what an emergency stop finds left on holds no more than before.
//! Invariant: a joint that stops by its brake, or whose time to hold is over, is let go only once the brake holds it; without
//! a working brake it is let go when its time is over.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::Stop;

use super::brake::Brake;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Kept {
    stop: Stop,
    /// The brake is to be engaged while the motor still damps or holds the joint.
    is_brake_due: bool,
    /// That the brake cannot hold the joint was reported.
    is_missed: bool,
}

impl Kept {
    /// `None` for a motor that is to be limp: it is turned off.
    pub(super) fn new(stop: Stop) -> Option<Self> {
        (stop != Stop::Limp).then_some(Self { stop, is_brake_due: false, is_missed: false })
    }

    pub(super) const fn stop(self) -> Stop {
        self.stop
    }

    /// Is its brake to be released?
    pub(super) const fn releases(self) -> bool {
        !self.waits_for_brake()
    }

    /// It is kept until its brake holds the joint.
    pub(super) const fn waits_for_brake(self) -> bool {
        self.is_brake_due || matches!(self.stop, Stop::Brake)
    }

    /// Its joint waits for a brake that cannot be driven; `true` once.
    pub(super) const fn misses(&mut self, brake: &Brake) -> bool {
        let is_missed = self.waits_for_brake() && brake.is_broken();
        is_missed && !std::mem::replace(&mut self.is_missed, true)
    }

    /// An emergency stop that is to stop the motor like this. Returns whether it remains on.
    pub(super) const fn stop_at_emergency(&mut self, stop: Stop, brake: &Brake) -> bool {
        match (self.stop, stop) {
            (_, Stop::Limp) => return false,
            (Stop::Hold, Stop::Damp | Stop::Brake) => self.stop = stop,
            // It has sunk: to hold would be to go back up.
            (Stop::Damp, Stop::Brake) => self.is_brake_due = brake.exists(),
            _ => {}
        }
        true
    }

    /// Was it kept for long enough, `waited` after the stop? Its brake holds the joint, or its time is over; a brake is engaged
    /// before that.
    pub(super) fn is_over(
        &mut self,
        hold_for: Option<Duration>,
        brake: &Brake,
        (waited, now): (Duration, Stamp),
    ) -> bool {
        if let (Stop::Hold | Stop::Brake, Some(limit)) = (self.stop, hold_for) {
            match brake.engages_in() {
                None if waited >= limit => return true,
                Some(engages_in) if waited + engages_in >= limit => self.is_brake_due = true,
                _ => {}
            }
        }
        self.waits_for_brake() && brake.holds(now)
    }
}
