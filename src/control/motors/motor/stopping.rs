//! How a motor is stopped: off, damped, or where it is.

use super::{Motor, Phase};
use crate::registry::{MotorMode, Stop, StopSpec};

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
            (Phase::Kept(_), Stop::Brake) => self.phase = Phase::Kept(Stop::Brake),
            (Phase::Kept(_), _) => {}
            (_, stop) => self.stop_as(stop, command),
        }
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
