//! Actions that move nothing.

use std::time::Duration;

use rapid_core::time::Stamp;

use super::MotorBus;
use super::notice::Refusal;

/// Actions may be this far in the future: the clock is the same, but ticks are rounded.
const EARLY: Duration = Duration::from_millis(100);

impl MotorBus {
    /// Why an action is refused, if it is.
    pub(super) fn refuse(&self, target: &[f64], tick: Stamp, now: Stamp) -> Option<Refusal> {
        if target.len() != self.motors.len() {
            Some(Refusal::Length)
        } else if !target.iter().all(|value| value.is_finite()) {
            Some(Refusal::NotFinite)
        } else if tick > now.after(EARLY) {
            Some(Refusal::Early)
        } else if self.is_returning && self.is_armed() {
            Some(Refusal::Returning)
        } else if now.since(tick) >= self.deadman.patience(self.line.period()) {
            Some(Refusal::Old)
        } else if self.is_armed() && tick >= self.armed && self.line.tick().is_none() {
            // The first one since the arm.
            self.far(target).map(|motor| Refusal::Far { motor })
        } else {
            None
        }
    }

    /// The first motor that is too far from an action for it to be the first after an arm.
    pub(super) fn far(&self, target: &[f64]) -> Option<usize> {
        self.motors.iter().zip(target).position(|(motor, target)| motor.is_far(*target))
    }
}
