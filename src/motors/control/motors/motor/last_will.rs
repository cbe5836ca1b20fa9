//! What a motor is sent when this program can send nothing any more.

use rapid_registry::{MotorMode, Stop};

use super::{Motor, Phase};
use crate::control::can::CanFrame;
use crate::control::damiao::codec::{Feedback, StateCommand};

impl Motor {
    /// The frame that keeps the motor from falling, or from falling fast, while no program reads what it reports; one that
    /// disables it where it is to be limp.
    ///
    /// A joint in MIT mode that is to hold is damped: with nothing to lower the stiffness, a joint that is pushed away
    /// would push back with more than its torque limit.
    pub(in crate::control::motors) fn last_will(&self, command: f64) -> CanFrame {
        let slave = self.spec.slave;
        let frame = match (self.last_stop(), self.spec.mode, self.ranges, self.feedback) {
            (
                Stop::Damp | Stop::Hold | Stop::Brake,
                MotorMode::Mit { kd, .. },
                Some(ranges),
                Some(Feedback { q, .. }),
            ) => self.mit_frame(q, [0.0, kd], &ranges).ok(),
            (Stop::Damp | Stop::Hold | Stop::Brake, MotorMode::PositionVelocity, ..) => {
                self.position_frame(command).ok()
            }
            (Stop::Damp | Stop::Hold | Stop::Brake, MotorMode::Velocity, ..) => self.velocity_frame(0.0).ok(),
            _ => None,
        };
        frame.unwrap_or_else(|| StateCommand::Disable.frame(slave))
    }

    /// How it stops when this program can command it no more.
    pub(in crate::control::motors) const fn last_stop(&self) -> Stop {
        match self.phase {
            Phase::On => self.spec.stop.other_fault,
            Phase::Kept(stop) => stop,
            _ => Stop::Limp,
        }
    }
}
