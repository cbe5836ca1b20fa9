//! A joint and its motor as they are configured, and the frames between the two and this program: only here does a number
//! of a joint become one of a motor, or the other way round, by [`Mounting`](rapid_registry::Mounting).
//!
//! Invariant: every position, velocity and torque of whatever uses it is of the joint.

use rapid_registry::{MotorMode, MotorSpec};

use crate::control::can::CanFrame;
use crate::control::damiao::codec::{self, Feedback, Mit, Ranges};
use crate::control::damiao::parameter::{self, Reply};
use crate::control::limits::stiffness;

/// Ids of commands, relative to the motor's own.
const COMMANDS: [u32; 4] = [0, 0x100, 0x200, 0x300];

#[derive(Debug)]
pub(in crate::control::motors) struct Joint {
    /// Its position in the entry.
    pub(super) index: usize,
    pub(super) spec: MotorSpec,
}

impl Joint {
    /// Is this frame one of its answers?
    pub(in crate::control::motors) fn sent(&self, frame: &CanFrame, reply: Option<&Reply>) -> bool {
        let id = u16::from(frame.data[0] & 0xf);
        let slave_fits = reply.map_or(self.spec.slave & 0xf == id, |reply| reply.slave == self.spec.slave);
        frame.id == u32::from(self.spec.master) && slave_fits
    }

    pub(in crate::control::motors) fn name(&self) -> &str {
        &self.spec.name
    }

    /// Does another program command it, or set one of its parameters, by this frame? Our own frames are not received.
    pub(in crate::control::motors) fn is_commanded_by(&self, frame: &CanFrame) -> bool {
        let slave = u32::from(self.spec.slave);
        let writes = parameter::is_write(frame) == Some(self.spec.slave);
        writes || frame.id.checked_sub(slave).is_some_and(|offset| COMMANDS.contains(&offset))
    }

    /// The positions, rad, that are within its limits and that its motor can encode, which is from `-range` to `range`:
    /// those beyond can be neither sent nor reported. The lower end is above the upper one if there are none.
    pub(super) fn within(&self, range: f64) -> [f64; 2] {
        let [low, high] = self.spec.position;
        let [lowest, highest] = self.spec.mounting.joint_range([-range, range]);
        [low.max(lowest), high.min(highest)]
    }

    /// The feedback in a frame of the motor, as its joint's; `None` as in [`Feedback::decode`].
    pub(super) fn feedback(&self, frame: &CanFrame, ranges: &Ranges) -> Option<Feedback> {
        let own = Feedback::decode(frame, ranges)?;
        let mounting = self.spec.mounting;
        Some(Feedback {
            q: mounting.joint_position(own.q),
            dq: mounting.turned(own.dq),
            tau: mounting.turned(own.tau),
            ..own
        })
    }

    /// The frame of a command, with the joint at `q`; `None` if it is not finite. The stiffness is lowered so that it requests
    /// no more than the torque limit.
    pub(super) fn command(&self, command: f64, q: f64, ranges: &Ranges) -> Option<CanFrame> {
        let MotorSpec { slave, mounting, velocity, torque, .. } = self.spec;
        match self.spec.mode {
            MotorMode::Mit { kp, kd } => self.mit(command, [stiffness(kp, command - q, torque), kd], ranges),
            MotorMode::PositionVelocity => {
                codec::position_velocity(slave, mounting.motor_position(command), velocity).ok()
            }
            MotorMode::Velocity => codec::velocity(slave, mounting.turned(command)).ok(),
        }
    }

    /// The frame that damps the joint at `q`, without stiffness; `None` if its mode has none.
    pub(super) fn damping(&self, q: f64, ranges: &Ranges) -> Option<CanFrame> {
        let MotorMode::Mit { kd, .. } = self.spec.mode else { return None };
        self.mit(q, [0.0, kd], ranges)
    }

    /// To a position, rad, at rest, with this stiffness, Nm/rad, and damping, Nm s/rad.
    fn mit(&self, q: f64, [kp, kd]: [f64; 2], ranges: &Ranges) -> Option<CanFrame> {
        let q = self.spec.mounting.motor_position(q);
        codec::mit(self.spec.slave, &Mit { kp, kd, q, dq: 0.0, tau: 0.0 }, ranges).ok()
    }
}
