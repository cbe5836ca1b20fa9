//! The frames of a motor that carry numbers, as those of its joint: only here does a number of a joint become one of a motor,
//! or the other way round, by [`Mounting`](rapid_registry::Mounting).
//!
//! Invariant: every position, velocity and torque in [`Motor`], and of whatever uses it, is of the joint.

use rapid_registry::MotorSpec;

use super::Motor;
use crate::control::can::CanFrame;
use crate::control::damiao::codec::{self, Feedback, Mit, NotFinite, Ranges};

/// The positions of a joint, rad, that are within its limits and that its motor can encode, which is from `-range` to
/// `range`: those beyond can be neither sent nor reported. The lower end is above the upper one if there are none.
pub(super) fn within(spec: &MotorSpec, range: f64) -> [f64; 2] {
    let [low, high] = spec.position;
    let [lowest, highest] = spec.mounting.joint_range([-range, range]);
    [low.max(lowest), high.min(highest)]
}

impl Motor {
    /// The feedback in a frame of the motor, as its joint's; `None` as in [`Feedback::decode`].
    pub(super) fn read_feedback(&self, frame: &CanFrame, ranges: &Ranges) -> Option<Feedback> {
        let own = Feedback::decode(frame, ranges)?;
        let mounting = self.spec.mounting;
        Some(Feedback {
            q: mounting.joint_position(own.q),
            dq: mounting.turned(own.dq),
            tau: mounting.turned(own.tau),
            ..own
        })
    }

    /// The frame of MIT mode: to a position of the joint, rad, at rest, with this stiffness, Nm/rad, and damping, Nm s/rad.
    ///
    /// # Errors
    /// A value is not finite.
    pub(super) fn mit_frame(&self, q: f64, [kp, kd]: [f64; 2], ranges: &Ranges) -> Result<CanFrame, NotFinite> {
        let q = self.spec.mounting.motor_position(q);
        codec::mit(self.spec.slave, &Mit { kp, kd, q, dq: 0.0, tau: 0.0 }, ranges)
    }

    /// The frame of position-velocity mode: to a position of the joint, rad, at its highest speed.
    ///
    /// # Errors
    /// The position is not finite.
    pub(super) fn position_frame(&self, q: f64) -> Result<CanFrame, NotFinite> {
        let q = self.spec.mounting.motor_position(q);
        codec::position_velocity(self.spec.slave, q, self.spec.velocity)
    }

    /// The frame of velocity mode: a velocity of the joint, rad/s.
    ///
    /// # Errors
    /// The velocity is not finite.
    pub(super) fn velocity_frame(&self, dq: f64) -> Result<CanFrame, NotFinite> {
        codec::velocity(self.spec.slave, self.spec.mounting.turned(dq))
    }
}
