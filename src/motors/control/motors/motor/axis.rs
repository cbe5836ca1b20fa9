//! What a motor is commanded: from a target to the command of each cycle.
//!
//! Invariant: a command stays within the limits; where the joint is beyond them it stays or comes back.
//! Invariant: from cycle to cycle a commanded position changes by no more than the slew limit, whatever the motor reports.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::{MotorMode, MotorSpec};

use super::joint::Joint;
use crate::control::damiao::codec::Ranges;
use crate::control::limits::{Limits, within_torque};
use crate::control::motors::notice::Notice;
use crate::control::motors::notices::{Notices, Seldom};
use crate::control::ramp::Ramp;

/// How fast a joint is driven back, rad/s: slow enough to step aside and to disarm.
pub const RETURN_SPEED: f64 = 0.1;

#[derive(Debug)]
pub(in crate::control::motors) struct Axis {
    limits: Limits,
    ramp: Ramp,
    /// What is commanded, rad or rad/s.
    command: f64,
    target: f64,
    /// Targets beyond the limits are reported once a second at most.
    clamped: Seldom,
}

/// The command of a joint in this cycle, rad or rad/s.
#[derive(Debug, Clone, Copy)]
pub(super) struct Commanded {
    pub(super) command: f64,
    /// The command without the torque bound.
    pub(super) wanted: f64,
    /// The joint is outside its limits and returning.
    pub(super) is_returning: bool,
}

impl Axis {
    pub(super) fn new(spec: &MotorSpec) -> Self {
        let limits = match spec.mode {
            MotorMode::Velocity => Limits::new(-spec.velocity, spec.velocity, spec.slew),
            MotorMode::Mit { .. } | MotorMode::PositionVelocity => {
                let [low, high] = spec.position;
                Limits::new(low, high, spec.slew.min(spec.velocity))
            }
        };
        let ramp = Ramp::new(spec.motion.acceleration, spec.motion.soft_start);
        Self { limits, ramp, command: 0.0, target: 0.0, clamped: Seldom::default() }
    }

    /// What is commanded, rad or rad/s.
    pub(in crate::control::motors) const fn command(&self) -> f64 {
        self.command
    }

    /// What is aimed at, within the limits.
    pub(in crate::control::motors) const fn target(&self) -> f64 {
        self.target
    }

    /// Targets that were beyond the limits.
    pub(in crate::control::motors) const fn clamped(&self) -> u64 {
        self.limits.clamped()
    }

    /// Allows only positions that its motor can encode.
    pub(super) fn narrow(&mut self, joint: &Joint, ranges: &Ranges) {
        if joint.spec.mode != MotorMode::Velocity {
            let [low, high] = joint.within(ranges.position());
            self.limits.set_range(low, high);
        }
    }

    /// Commands the joint at `q` to stay there.
    pub(super) fn start_at(&mut self, joint: &Joint, q: f64) {
        self.command = if joint.spec.mode == MotorMode::Velocity { 0.0 } else { q };
    }

    /// All motors are enabled: it starts softly from here.
    pub(super) const fn restart(&mut self) {
        self.ramp.restart();
    }

    /// Takes a target, as far as the limits allow.
    pub(super) fn aim(&mut self, motor: usize, target: f64, now: Stamp, notices: &mut Notices) {
        let Some(clamped) = self.limits.clamp(target) else { return };
        if self.clamped.update(clamped.is_beyond, now) {
            notices.notify(Notice::Clamped { motor, target, used: clamped.value });
        }
        self.target = clamped.value;
    }

    /// Aims at the last command, or where it can stop. A joint beyond its limits stays there.
    pub(super) fn hold(&mut self, joint: &Joint) {
        let ([low, high], command) = (self.limits.range(), self.command);
        self.target = match joint.spec.mode {
            MotorMode::Velocity => 0.0,
            _ => self.ramp.stops_at(command).clamp(low.min(command), high.max(command)),
        };
    }

    /// The cycle of a motor that waits for the others, and whose joint a person may push meanwhile.
    pub(super) fn stay(&mut self, joint: &Joint, at: (f64, &Ranges), passed: Duration) {
        self.command = self.limits.slew(self.command, self.bound(joint, at, self.command), passed);
    }

    /// A cycle towards `target`, or back into the limits without one, with the joint at a position and its motor of these
    /// ranges. `is_led`: by an action, after the first one since the start.
    pub(super) fn follow(
        &mut self,
        joint: &Joint,
        at: (f64, &Ranges),
        target: Option<f64>,
        passed: Duration,
        is_led: bool,
    ) -> Commanded {
        let (before, is_velocity) = (self.command, joint.spec.mode == MotorMode::Velocity);
        let wanted = match target {
            None => self.way_back(joint, at, passed),
            Some(target) if is_velocity => self.limits.slew(before, target, passed),
            Some(target) => self.ramp.next(&self.limits, before, target, passed),
        };
        let bound = self.bound(joint, at, wanted);
        // A reported position moves the command no faster than an action does.
        self.command = if is_velocity { bound } else { self.limits.slew(before, bound, passed) };
        self.ramp.took(self.command - before, passed, is_led);
        Commanded { command: self.command, wanted, is_returning: target.is_none() }
    }

    /// The command of the return.
    fn way_back(&self, joint: &Joint, (q, _): (f64, &Ranges), passed: Duration) -> f64 {
        let before = self.command;
        if joint.spec.mode == MotorMode::Velocity {
            let [low, high] = joint.spec.position;
            let away = q.clamp(low, high) - q;
            let wanted = if away == 0.0 { 0.0 } else { RETURN_SPEED.copysign(away) };
            return self.limits.slew(before, wanted, passed);
        }
        let ([low, high], step) = (self.limits.range(), RETURN_SPEED * passed.as_secs_f64());
        before + (before.clamp(low, high) - before).clamp(-step, step)
    }

    /// The command nearest to `command` that the position of the joint allows.
    fn bound(&self, joint: &Joint, (q, ranges): (f64, &Ranges), command: f64) -> f64 {
        match joint.spec.mode {
            MotorMode::Mit { kp, .. } => within_torque(command, q, joint.spec.torque, kp),
            MotorMode::PositionVelocity => command,
            MotorMode::Velocity => self.limits.brake(command, q, joint.within(ranges.position())),
        }
    }

    /// Is the command within the limits?
    pub(super) fn is_back(&self, joint: &Joint) -> bool {
        let [low, high] = self.limits.range();
        joint.spec.mode == MotorMode::Velocity || (low..=high).contains(&self.command)
    }

    /// Is the joint at `q` too far from an action for that to be the first after an arm?
    pub(super) fn is_far(&self, joint: &Joint, q: f64, target: f64) -> bool {
        let [low, high] = self.limits.range();
        // A target beyond the limits is replaced by the limit.
        let far = (target.clamp(low, high) - q).abs() > joint.spec.motion.first_target;
        far && joint.spec.mode != MotorMode::Velocity
    }
}
