//! The return of joints outside their limits, which an operator requests with an arm that drives back.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::MotorMode;

use super::MotorBus;
use super::motor::Motor;
use super::notice::Notice;
use super::watch::beyond;
use crate::control::limits::Limits;

/// How fast a joint is driven back, rad/s: slow enough to step aside and to disarm.
pub const RETURN_SPEED: f64 = 0.1;

impl MotorBus {
    /// Ends the return once every joint is within its limits.
    pub(super) fn look_for_return(&mut self, now: Stamp) {
        // The return needs no actions, however long it takes.
        self.deadman.arm(now);
        if self
            .motors
            .iter()
            .zip(&self.commands)
            .zip(&self.limits)
            .all(|((motor, command), limits)| motor.is_back(*command, limits))
        {
            self.is_returning = false;
            self.hold(now);
            self.notices.notify(Notice::Returned);
        }
    }
}

impl Motor {
    /// The command of the return, from the previous one.
    pub(super) fn way_back(&self, before: f64, limits: &Limits, passed: Duration) -> f64 {
        let step = RETURN_SPEED * passed.as_secs_f64();
        if self.spec.mode == MotorMode::Velocity {
            let [low, high] = self.spec.position;
            let Some(feedback) = self.feedback else { return 0.0 };
            let away = feedback.q.clamp(low, high) - feedback.q;
            let wanted = if away == 0.0 { 0.0 } else { RETURN_SPEED.copysign(away) };
            return limits.slew(before, wanted, passed);
        }
        let [low, high] = limits.range();
        before + (before.clamp(low, high) - before).clamp(-step, step)
    }

    fn is_back(&self, command: f64, limits: &Limits) -> bool {
        let Some(feedback) = &self.feedback else { return false };
        let [low, high] = limits.range();
        let is_there = self.spec.mode == MotorMode::Velocity || (low..=high).contains(&command);
        is_there && beyond(&self.spec, feedback).is_none()
    }
}
