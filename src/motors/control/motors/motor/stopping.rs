//! How a motor is stopped: off, damped, or where it is.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::{MotorMode, Stop, StopSpec};

use super::{Motor, Phase};

impl Motor {
    /// Stops it at a fault; `is_own`: its own. One that is not on is turned off; one that is kept already stays so, but for
    /// a fault of its own, with which nothing is known of it any more.
    pub(in crate::control::motors) fn stop_at_fault(&mut self, is_own: bool, command: &mut f64) {
        let StopSpec { own_fault, other_fault, .. } = self.spec.stop;
        match (self.phase, is_own) {
            (Phase::Kept(_), true) => self.turn_off(),
            (Phase::Kept(_), false) => {}
            (_, true) => self.stop_as(own_fault, command),
            (_, false) => self.stop_as(other_fault, command),
        }
    }

    /// Stops it at an emergency stop. What a fault has left on may hold no more than before.
    pub(in crate::control::motors) fn stop_at_emergency(&mut self, command: &mut f64) {
        match (self.phase, self.spec.stop.emergency) {
            (Phase::Kept(_), Stop::Limp) => self.turn_off(),
            (Phase::Kept(Stop::Hold), Stop::Damp) => self.phase = Phase::Kept(Stop::Damp),
            (Phase::Kept(Stop::Hold), Stop::Brake) => self.phase = Phase::Kept(Stop::Brake),
            // It has sunk: to hold would be to go back up.
            (Phase::Kept(Stop::Damp), Stop::Brake) => self.call_brake(),
            (Phase::Kept(_), _) => {}
            (_, stop) => self.stop_as(stop, command),
        }
    }

    /// Was it kept for long enough, `waited` after the stop? Its brake holds the joint, or its time is over; a brake
    /// is engaged before that.
    pub(in crate::control::motors) fn was_kept(&mut self, waited: Duration, now: Stamp) -> bool {
        let Phase::Kept(stop) = self.phase else { return false };
        if let (Stop::Hold | Stop::Brake, Some(limit)) = (stop, self.spec.stop.hold_for) {
            let engages_in =
                self.spec.brake.as_ref().filter(|_| !self.has_broken_brake()).map(|brake| brake.engages_in);
            if engages_in.is_none() && waited >= limit {
                return true;
            }
            if engages_in.is_some_and(|engages_in| waited + engages_in >= limit) {
                self.call_brake();
            }
        }
        self.waits_for_brake() && self.has_braked(now)
    }

    fn stop_as(&mut self, stop: Stop, command: &mut f64) {
        let has_damping = matches!(self.spec.mode, MotorMode::Mit { .. });
        let stop = if stop == Stop::Damp && !has_damping { Stop::Hold } else { stop };
        match (self.phase, stop) {
            // One that has turned itself off, or reports a fault, follows no command.
            (Phase::On, stop @ (Stop::Damp | Stop::Hold | Stop::Brake)) if self.may_follow() => {
                self.watch.reset();
                self.phase = Phase::Kept(stop);
                if self.spec.mode == MotorMode::Velocity {
                    *command = 0.0;
                }
            }
            _ => self.turn_off(),
        }
    }
}
