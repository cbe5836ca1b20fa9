//! One motor: its phase, and what it reported.
//!
//! | phase    | sent each cycle                        | until                                   |
//! |----------|----------------------------------------|-----------------------------------------|
//! | Off      | disable, then refresh                  | it reported that it is not enabled      |
//! | Asked    | read or write of a parameter, refresh  | all parameters are as they are to be    |
//! | Probed   | refresh                                | the bus is armed                        |
//! | Clearing | clear error, refresh                   | it reports no fault                     |
//! | Enabling | enable, then a command to stay         | it reported that it is enabled          |
//! | On       | a command                              | the bus is disarmed, or has a fault     |
//! | Kept     | damping, or the last command           | the bus is disarmed, or it has a fault  |
//!
//! Invariant: a new command is sent only in `Enabling` and `On`; in `Kept` the last one is repeated.
//! Invariant: a motor found enabled without an arm is disabled.
//! Invariant: a number of the motor itself is in its frames alone; all others are of its joint (see `frames`).

mod brake;
mod frames;
mod judged;
mod last_will;
mod parameters;
mod stopping;

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::{MotorMode, MotorSpec, Stop};

use super::fault::{Fault, Part};
use super::notice::Notice;
use super::notices::Notices;
use super::watch::{Supervision, is_near};
use crate::control::can::CanFrame;
use crate::control::damiao::codec::{Feedback, MotorStatus, Ranges, StateCommand};
use crate::control::damiao::parameter::{self, Parameter, Reply, TIMEOUT_UNIT_US, Value};
use crate::control::limits::{Limits, stiffness, within_torque};
use crate::control::ramp::Ramp;
use brake::Brake;
pub(super) use brake::BrakeIs;
use frames::within;
use parameters::PROBE;

/// Ids of commands, relative to the motor's own.
const COMMANDS: [u32; 4] = [0, 0x100, 0x200, 0x300];
/// A motor counts as warm from this many °C below its limit...
const WARM: f64 = 10.0;
/// ...until it has cooled by this much.
const COOLER: f64 = 5.0;

/// See the module's comment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Phase {
    /// To be disabled; `reported` is set once a frame was sent.
    Off {
        reported: bool,
    },
    /// Asked for `PROBE[at]`, or ordered to change it from its old value.
    Asked {
        at: usize,
        setting: Option<Value>,
    },
    Probed,
    Clearing,
    Enabling,
    On,
    /// Stopped by a fault of the bus, and still enabled.
    Kept(Stop),
}

/// The limits of a motor's axis.
pub(super) fn limits(spec: &MotorSpec) -> Limits {
    match spec.mode {
        MotorMode::Velocity => Limits::new(-spec.velocity, spec.velocity, spec.slew),
        MotorMode::Mit { .. } | MotorMode::PositionVelocity => {
            let [low, high] = spec.position;
            Limits::new(low, high, spec.slew.min(spec.velocity))
        }
    }
}

/// How the command of a motor's axis starts and changes.
pub(super) const fn ramp(spec: &MotorSpec) -> Ramp {
    Ramp::new(spec.motion.acceleration, spec.motion.soft_start)
}

/// See the module's comment.
#[derive(Debug)]
#[expect(clippy::struct_excessive_bools, reason = "each is a fact of its own about the motor")]
pub(super) struct Motor {
    pub(super) spec: MotorSpec,
    pub(super) phase: Phase,
    /// The ranges it encodes; `None` until they were read.
    pub(super) ranges: Option<Ranges>,
    /// Its newest feedback, of its joint, once its ranges are known.
    pub(super) feedback: Option<Feedback>,
    /// When the feedback arrived.
    pub(super) seen: Stamp,
    /// The feedback is newer than the last sample.
    pub(super) is_new: bool,
    /// Its status since it was last ordered to turn off.
    pub(super) status: Option<MotorStatus>,
    /// Time of the first frame sent since its last answer.
    asked: Option<Stamp>,
    /// Consecutive frames that report it as not enabled although it was.
    off_frames: u8,
    /// Its newest two positions are consistent.
    agrees: bool,
    index: usize,
    timeout: u32,
    read: [f64; 3],
    warm: [bool; 2],
    watch: Supervision,
    brake: Brake,
    /// When the next parameter is read again, and which.
    look: Option<Stamp>,
    looks: usize,
    differs: bool,
    /// Its latched fault, once reported: the next arm clears it.
    pub(super) named: Option<MotorStatus>,
    /// Its silence was reported.
    pub(super) missed: bool,
    /// It was ordered or reported to be on, and has not reported off since the last disable.
    pub(super) may_be_on: bool,
}

impl Motor {
    pub(super) fn new(index: usize, spec: &MotorSpec, timeout: Duration) -> Self {
        let units = timeout.as_micros().div_ceil(u128::from(TIMEOUT_UNIT_US)).max(1);
        Self {
            spec: spec.clone(),
            phase: Phase::Off { reported: false },
            ranges: None,
            feedback: None,
            seen: Stamp(0),
            is_new: false,
            status: None,
            asked: None,
            off_frames: 0,
            agrees: false,
            index,
            timeout: u32::try_from(units).unwrap_or(u32::MAX),
            read: [0.0; 3],
            warm: [false; 2],
            watch: Supervision::default(),
            brake: Brake::default(),
            look: None,
            looks: 0,
            differs: false,
            named: None,
            missed: false,
            may_be_on: false,
        }
    }

    /// Is this frame one of its answers?
    pub(super) fn sent(&self, frame: &CanFrame, reply: Option<&Reply>) -> bool {
        let id = u16::from(frame.data[0] & 0xf);
        let slave_fits = reply.map_or(self.spec.slave & 0xf == id, |reply| reply.slave == self.spec.slave);
        frame.id == u32::from(self.spec.master) && slave_fits
    }

    /// Does another program command it, or set one of its parameters, by this frame? Our own frames are not received.
    pub(super) fn is_commanded_by(&self, frame: &CanFrame) -> bool {
        let slave = u32::from(self.spec.slave);
        let writes = parameter::is_write(frame) == Some(self.spec.slave);
        writes || frame.id.checked_sub(slave).is_some_and(|offset| COMMANDS.contains(&offset))
    }

    /// Turns it off, from the next frame on.
    pub(super) fn turn_off(&mut self) {
        self.watch.reset();
        self.dismiss_brake();
        self.phase = Phase::Off { reported: false };
    }

    /// It was stopped by a fault and is still enabled.
    pub(super) const fn is_kept(&self) -> bool {
        matches!(self.phase, Phase::Kept(_))
    }

    /// Marks it as ordered to turn off for the last time.
    pub(super) const fn stop(&mut self) {
        if !matches!(self.phase, Phase::Off { reported: true }) {
            self.phase = Phase::Off { reported: true };
            self.status = None;
        }
    }

    /// It was ordered to turn off, and has since reported that it is not enabled.
    pub(super) fn is_off(&self) -> bool {
        match self.phase {
            Phase::Off { reported } => reported && self.status.is_some_and(|status| status != MotorStatus::Enabled),
            Phase::Asked { .. } | Phase::Probed => true,
            Phase::Clearing | Phase::Enabling | Phase::On | Phase::Kept(_) => false,
        }
    }

    /// How long it has left our frames unanswered.
    pub(super) fn unanswered(&self, now: Stamp) -> Duration {
        self.asked.map_or(Duration::ZERO, |asked| now.since(asked))
    }

    /// Takes its feedback.
    pub(super) fn take_feedback(&mut self, frame: &CanFrame, now: Stamp, notices: &mut Notices) -> Result<(), Fault> {
        // Before its ranges are known, only its reported state counts.
        let Some(feedback) = self.ranges.or(Ranges::new(1.0, 1.0, 1.0)).and_then(|r| self.read_feedback(frame, &r))
        else {
            return Ok(());
        };
        self.asked = None;
        let mut is_possible = true;
        if let Some(ranges) = self.ranges {
            is_possible = self.is_possible(&feedback, &ranges, now, notices)?;
        }
        // Nothing in a damaged frame is trusted.
        if !is_possible {
            return Ok(());
        }
        self.count_as_off(feedback.status);
        self.status = Some(feedback.status);
        self.named = self.named.filter(|named| *named == feedback.status);
        self.may_be_on = feedback.status == MotorStatus::Enabled || self.may_be_on && !self.is_off();
        if let Some(ranges) = self.ranges {
            self.agrees = self
                .feedback
                .is_some_and(|before| is_near(&before, &feedback, (&self.spec, &ranges), now.since(self.seen)));
            self.feedback = Some(feedback);
            self.seen = now;
            self.is_new = true;
        }
        for (at, (part, celsius, limit)) in self.temperatures(&feedback).into_iter().enumerate() {
            let Some(warm) = self.warm.get_mut(at) else { continue };
            if celsius >= limit - WARM && !*warm {
                *warm = true;
                notices.notify(Notice::Warm { motor: self.index, part, celsius, limit });
            } else if celsius < limit - WARM - COOLER {
                *warm = false;
            }
        }
        Ok(())
    }

    fn temperatures(&self, feedback: &Feedback) -> [(Part, f64, f64); 2] {
        [
            (Part::Mos, f64::from(feedback.mos), self.spec.max_mos),
            (Part::Rotor, f64::from(feedback.rotor), self.spec.max_rotor),
        ]
    }

    /// Enables it once its parameters are read; faults are cleared first. Until then its command is its position.
    ///
    /// # Errors
    /// It must not be armed at its position, or has latched a fault that was not reported yet.
    pub(super) fn enable(
        &mut self,
        command: &mut f64,
        limits: &mut Limits,
        (passed, is_returning): (Duration, bool),
        notices: &mut Notices,
    ) -> Result<(), Fault> {
        let (Some(ranges), Some(feedback), Some(status)) = (self.ranges, self.feedback, self.status) else {
            return Ok(());
        };
        if self.phase == Phase::Probed {
            // One of the two frames may be damaged: the position of the joint is unknown.
            if !self.agrees {
                return Ok(());
            }
            if let Some(fault) = self.unfit(is_returning) {
                return Err(fault);
            }
            if status.is_fault() && self.named != Some(status) {
                return Err(Fault::Latched { motor: self.index, status });
            }
            self.phase = Phase::Clearing;
            if status.is_fault() {
                notices.notify(Notice::Cleared { motor: self.index, status });
            }
            if self.spec.mode != MotorMode::Velocity {
                let [low, high] = within(&self.spec, ranges.position());
                limits.set_range(low, high);
            }
        }
        if self.phase == Phase::Clearing && status == MotorStatus::Disabled {
            self.phase = Phase::Enabling;
        }
        if self.phase == Phase::Enabling {
            *command = if self.spec.mode == MotorMode::Velocity { 0.0 } else { feedback.q };
            if status == MotorStatus::Enabled {
                self.phase = Phase::On;
            }
        } else if self.phase == Phase::On {
            // It waits for the others, and a person may push it meanwhile.
            *command = limits.slew(*command, self.bound(*command, limits), passed);
        }
        Ok(())
    }

    /// The command nearest to `command` that the position of the joint allows.
    pub(super) fn bound(&self, command: f64, limits: &Limits) -> f64 {
        let (Some(Feedback { q, .. }), Some(ranges)) = (self.feedback, &self.ranges) else { return command };
        match self.spec.mode {
            MotorMode::Mit { kp, .. } => within_torque(command, q, self.spec.torque, kp),
            MotorMode::PositionVelocity => command,
            MotorMode::Velocity => limits.brake(command, q, within(&self.spec, ranges.position())),
        }
    }

    /// Sends the frames of this cycle. `command` is the current position or velocity command.
    pub(super) fn step(&mut self, command: f64, now: Stamp, is_silent: bool, send: &mut impl FnMut(CanFrame)) {
        let slave = self.spec.slave;
        if matches!(self.phase, Phase::Asked { .. } | Phase::Probed) && self.status == Some(MotorStatus::Enabled) {
            self.turn_off();
        }
        match self.phase {
            Phase::Off { .. } if self.is_off() && !is_silent => send(parameter::refresh(slave)),
            Phase::Off { reported } => {
                send(StateCommand::Disable.frame(slave));
                if !reported {
                    // An earlier report does not answer this.
                    self.status = None;
                }
                self.phase = Phase::Off { reported: true };
            }
            Phase::Asked { at, setting } => {
                let parameter = PROBE.get(at).copied().unwrap_or(Parameter::ControlMode);
                send(match self.wanted(parameter).filter(|_| setting.is_some()) {
                    Some(value) => parameter::write(slave, parameter, value),
                    None => parameter::read(slave, parameter),
                });
                send(parameter::refresh(slave));
            }
            Phase::Probed => send(parameter::refresh(slave)),
            Phase::Clearing => {
                send(StateCommand::ClearError.frame(slave));
                send(parameter::refresh(slave));
            }
            Phase::Enabling => {
                send(StateCommand::Enable.frame(slave));
                self.may_be_on = true;
                self.command(command, send);
            }
            Phase::On => {
                self.command(command, send);
                self.look_again(now, send);
            }
            Phase::Kept(stop) => self.keep(stop, command, send),
        }
        self.asked.get_or_insert(now);
    }

    /// Holds or damps it.
    fn keep(&self, stop: Stop, command: f64, send: &mut impl FnMut(CanFrame)) {
        let (MotorMode::Mit { kd, .. }, Stop::Damp) = (self.spec.mode, stop) else {
            return self.command(command, send);
        };
        let (Some(ranges), Some(Feedback { q, .. })) = (&self.ranges, self.feedback) else { return };
        if let Ok(frame) = self.mit_frame(q, [0.0, kd], ranges) {
            send(frame);
        }
    }

    fn command(&self, command: f64, send: &mut impl FnMut(CanFrame)) {
        let Some(ranges) = &self.ranges else { return };
        let frame = match self.spec.mode {
            MotorMode::Mit { kp, kd } => {
                let error = self.feedback.map_or(0.0, |feedback| command - feedback.q);
                self.mit_frame(command, [stiffness(kp, error, self.spec.torque), kd], ranges)
            }
            MotorMode::PositionVelocity => self.position_frame(command),
            MotorMode::Velocity => self.velocity_frame(command),
        };
        // Commands are finite: targets are, and so are the values of a motor.
        if let Ok(frame) = frame {
            send(frame);
        }
    }
}
