//! How a motor is stopped: off, damped, or where it is.

use super::{Motor, Phase};
use crate::control::damiao::codec::MotorStatus;
use crate::registry::{MotorMode, Stop, StopSpec};

impl Motor {
    /// Stops it at a fault; `is_own`: its own. One that is not on is turned off; one that is kept already stays so, but for
    /// a fault of its own. Says whether it stops otherwise than before.
    pub(in crate::control::motors) fn stop_at_fault(&mut self, is_own: bool, command: &mut f64) -> bool {
        let StopSpec { own_fault, other_fault, .. } = self.spec.stop;
        match self.phase {
            Phase::Kept(_) if !is_own => false,
            Phase::Kept(_) => self.keep_no_more_than(own_fault),
            before => {
                self.stop_as(if is_own { own_fault } else { other_fault }, command);
                matches!(before, Phase::Clearing | Phase::Enabling | Phase::On)
            }
        }
    }

    /// Stops it at an emergency stop. What a fault has left on may hold no more than before.
    pub(in crate::control::motors) fn stop_at_emergency(&mut self, command: &mut f64) {
        let emergency = self.spec.stop.emergency;
        if self.is_kept() {
            self.keep_no_more_than(emergency);
        } else {
            self.stop_as(emergency, command);
        }
    }

    /// It is kept on, and may be no longer, or only as `stop` says. Says whether that changes it.
    fn keep_no_more_than(&mut self, stop: Stop) -> bool {
        let before = self.phase;
        match (before, stop) {
            (_, Stop::Limp) => self.turn_off(),
            // It follows no command.
            _ if self.status != Some(MotorStatus::Enabled) => self.turn_off(),
            (Phase::Kept(Stop::Hold), Stop::Damp) => self.phase = Phase::Kept(Stop::Damp),
            (_, Stop::Brake) => self.phase = Phase::Kept(Stop::Brake),
            _ => {}
        }
        self.phase != before
    }

    fn stop_as(&mut self, stop: Stop, command: &mut f64) {
        let has_damping = matches!(self.spec.mode, MotorMode::Mit { .. });
        let stop = if stop == Stop::Damp && !has_damping { Stop::Hold } else { stop };
        match (self.phase, stop) {
            // One that has turned itself off, or reports a fault, follows no command.
            (Phase::On, stop @ (Stop::Damp | Stop::Hold | Stop::Brake))
                if self.status == Some(MotorStatus::Enabled) =>
            {
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
