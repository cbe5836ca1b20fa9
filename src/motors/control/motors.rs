//! All motors of one CAN bus, as one state machine: when they may move, where to, and what stops them.
//!
//! | state     | motors                         | leaves for                                       |
//! |-----------|--------------------------------|--------------------------------------------------|
//! | Probing   | disabled, parameters are read  | Disarmed, when all have answered                 |
//! | Disarmed  | disabled, positions stream     | Arming, when asked                               |
//! | Arming    | read, cleared, enabled         | Holding, when all are enabled; Faulted, when not |
//! | Following | follow actions                 | Holding, without a fresh action                  |
//! | Holding   | stay                           | Following; Disabling, after a while              |
//! | Disabling | ordered to turn off            | Disarmed, when all have confirmed it             |
//! | Faulted   | ordered off, damped, or hold   | Arming, when asked; Disabling, when asked        |
//! | Stopped   | ordered off by the caller      |                                                  |
//!
//! A cycle: [`MotorBus::feed`] every received frame, [`MotorBus::target`] the newest action, [`MotorBus::step`], and
//! send the frames it returns. Polled motors report their positions without being enabled, in every state but
//! `Stopped`.
//!
//! Every arm reads the parameters again: a motor that lost power has forgotten its mode and its time limit, after which
//! it stops on its own when this program is killed.
//!
//! Invariant: no command is sent before an arm is requested, nor after a disarm or a stop until the next request; after
//! a fault only commands that damp a joint or hold its position.
//! Invariant: one motor that is silent, faulty or hot stops all, each as configured ([`Stop`](rapid_registry::Stop)):
//! a robot arm must not continue without its elbow, nor fall because of it. No motor follows an action before the next
//! arm. An emergency stop is a fault without a motor, with its own configured way to stop.
//! Invariant: the first command is where the joint is. From there a commanded position changes by the
//! slew limit at most, as softly as [`Ramp`] allows, and stays within the limits; for a joint beyond them it stays or
//! comes back. In MIT mode the stiffness requests no more than the torque limit: the command moves towards the joint as
//! fast as permitted, and the stiffness is lowered for the rest.
//! Invariant: a pause between cycles longer than [`stalled_after`] ends an arm: what the motors did meanwhile is
//! unknown.
//! Invariant: the first action after an arm is near the position of every joint; otherwise the arm or the action is
//! refused.
//! Invariant: an action is followed only if its tick is after the arm, after the ticks of all earlier actions, and no
//! older than the deadman allows.
//! Invariant: a sample holds an answer of every motor, each newer than in the previous sample.
//! Invariant: a motor that answers eventually appears in samples, whatever happened to the bus before its ranges were
//! read, unless the ranges are unusable.

mod brakes;
mod due;
mod fault;
mod last_will;
mod motor;
mod notice;
mod notices;
mod refusing;
mod returning;
mod words;

use std::time::Duration;

pub use brakes::Brakes;
pub use fault::{Fault, Part, Strange};
pub use last_will::stalled_after;
use motor::Motor;
pub use motor::{RETURN_SPEED, SAMPLE_VALUES};
pub use notice::{BusState, Notice, Reason, Refusal};
use notices::{Notices, Seldom};
pub use words::Words;

use rapid_core::action::Trip;
use rapid_core::time::Stamp;
use rapid_registry::DamiaoSpec;

use super::can::CanFrame;
use super::damiao::codec;
use super::damiao::parameter::Reply;
use super::deadman::Deadman;
use super::interpolate::Interpolator;

/// A motor may leave the frames of this many cycles unanswered, however short the configured time.
const SILENT_CYCLES: u32 = 3;
/// A step that is later than this many cycles moves no farther than after this many.
const LATE_CYCLES: u32 = 2;

/// See the module's comment.
#[derive(Debug)]
pub struct MotorBus {
    motors: Vec<Motor>,
    names: Vec<String>,
    /// The newest action, followed or not, and its tick.
    asked: (Vec<f64>, Stamp),
    line: Interpolator,
    deadman: Deadman,
    state: BusState,
    /// When the state began.
    since: Stamp,
    reason: Reason,
    cycle: Duration,
    /// The longest release time of any brake.
    slowest_brake: Duration,
    stalled_after: Duration,
    stepped: Option<Stamp>,
    armed: Stamp,
    refusing: Option<Refusal>,
    /// Refused actions are reported once a second at most.
    refused: Seldom,
    /// The motor that another program commanded last, and when.
    other_master: Option<(usize, Stamp)>,
    /// Joints outside their limits are being driven back into them, or will be once they are armed.
    is_returning: bool,
    /// The motor whose frames are sent first; it rotates, so that a full queue does not always hit the same motor.
    first: usize,
    notices: Notices,
    counts: Counts,
}

/// What has happened so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Frames that no motor of the entry sends.
    pub strangers: u64,
    /// Actions that were followed.
    pub actions: u64,
    /// Actions that were refused.
    pub refused: u64,
    /// Values of actions beyond their limits.
    pub clamped: u64,
    /// Times that all motors were disabled by a fault.
    pub faults: u64,
    /// Notices that were not read in time.
    pub lost_notices: u64,
}

impl MotorBus {
    /// All motors of an entry, in an unknown state.
    pub fn new(spec: &DamiaoSpec, now: Stamp) -> Self {
        let cycle = Duration::from_secs(1) / spec.hz.max(1);
        let axes = spec.motors.len();
        let silent_after = spec.silent_after.max(cycle * SILENT_CYCLES);
        let motors = spec.motors.iter().enumerate();
        Self {
            motors: motors.map(|(index, motor)| Motor::new(index, motor, spec.timeout, silent_after)).collect(),
            names: spec.motors.iter().map(|motor| motor.name.clone()).collect(),
            asked: (vec![0.0; axes], Stamp(0)),
            line: Interpolator::new(axes),
            deadman: Deadman::new(spec.deadman, spec.disable_after, cycle),
            state: BusState::Probing,
            since: now,
            reason: Reason::Asked,
            cycle,
            slowest_brake: brakes::slowest(spec),
            stalled_after: stalled_after(spec),
            stepped: None,
            armed: now,
            refusing: None,
            refused: Seldom::default(),
            other_master: None,
            is_returning: false,
            first: 0,
            notices: Notices::new(),
            counts: Counts::default(),
        }
    }

    /// The state of the bus.
    pub const fn state(&self) -> BusState {
        self.state
    }

    /// Are all motors enabled?
    pub const fn is_armed(&self) -> bool {
        matches!(self.state, BusState::Following | BusState::Holding)
    }

    /// Names of the motors, for [`Notice::words`].
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The command to each motor as of the last step, rad or rad/s. Means nothing unless armed.
    pub fn commands(&self) -> impl Iterator<Item = f64> {
        self.motors.iter().map(Motor::command)
    }

    /// What has happened so far.
    pub fn counts(&self) -> Counts {
        let clamped = self.motors.iter().map(Motor::clamped).sum();
        Counts { clamped, lost_notices: self.notices.lost(), ..self.counts }
    }

    /// The oldest notice that was not taken yet.
    pub fn take_notice(&mut self) -> Option<Notice> {
        self.notices.take()
    }

    /// A frame came from the bus.
    pub fn feed(&mut self, frame: &CanFrame, now: Stamp) {
        if codec::data_of(frame).is_none() {
            // A command of one or two values may be shorter.
            let is_frame = !(frame.extended || frame.remote || frame.error);
            if let Some(motor) = self.motors.iter().position(|motor| is_frame && motor.is_commanded_by(frame)) {
                self.received_master(motor, now);
            }
            return;
        }
        let reply = Reply::decode(frame);
        let Some(index) = self.motors.iter().position(|motor| motor.sent(frame, reply.as_ref())) else {
            self.counts.strangers += 1;
            if let Some(motor) = self.motors.iter().position(|motor| motor.is_commanded_by(frame)) {
                self.received_master(motor, now);
            }
            return;
        };
        let Some(motor) = self.motors.get_mut(index) else { return };
        let taken = motor.take(frame, reply.as_ref(), now, &mut self.notices);
        // At once: the next report of a motor must not mask it.
        if self.state != BusState::Stopped
            && let Some(fault) = taken.err().or_else(|| self.judge(index))
        {
            self.fail(fault, now);
        }
        if matches!(self.state, BusState::Faulted(_)) {
            self.name_latched(None);
        }
    }

    /// An action: a number for each motor, and its tick. Returns whether it is followed.
    pub fn target(&mut self, target: &[f64], tick: Stamp, now: Stamp) -> bool {
        let refusal = self.refuse(target, tick, now);
        let is_same = self.refusing == refusal;
        self.refusing = refusal;
        if let Some(refusal) = refusal {
            self.counts.refused += 1;
            // Another reason begins a new spell.
            if self.refused.look(is_same, now) || self.refused.look(true, now) {
                self.notices.notify(Notice::Refused(refusal));
            }
        } else {
            self.refused.look(false, now);
        }
        if refusal.is_none() && tick >= self.asked.1 {
            self.asked.0.copy_from_slice(target);
            self.asked.1 = tick;
        }
        let is_newer = self.line.tick().is_none_or(|last| tick > last);
        if refusal.is_some() || !self.is_armed() || tick < self.armed || !is_newer {
            return false;
        }
        for (motor, target) in self.motors.iter_mut().zip(target) {
            motor.aim(*target, now, &mut self.notices);
        }
        // The line begins at the last step, whose command is in force, so that the next step already moves.
        let begin = self.stepped.map_or(now, |last| last.max(now.before(self.cycle * LATE_CYCLES)));
        let motors = &self.motors;
        self.line.head_for(motors.iter().map(Motor::target), tick, motors.iter().map(Motor::command), begin);
        self.deadman.feed(tick.min(now));
        self.counts.actions += 1;
        if self.state == BusState::Holding {
            self.enter(BusState::Following, now);
            self.notices.notify(Notice::Following);
        }
        true
    }

    /// Enables all motors, after reading their parameters and clearing their faults. A notice reports
    /// whether that succeeded. Does nothing while they are enabled or being enabled.
    pub fn arm(&mut self, now: Stamp) {
        if matches!(self.state, BusState::Probing | BusState::Disarmed | BusState::Faulted(_) | BusState::Disabling) {
            let passed = self.stepped.map_or(Duration::ZERO, |last| now.since(last));
            if passed >= self.stalled_after {
                // The order may be that old too.
                self.fail(Fault::Stalled { after: passed }, now);
                return;
            }
            self.turn_off();
            self.is_returning = false;
            self.enter(BusState::Arming, now);
            self.notices.notify(Notice::Arming);
        }
    }

    /// Stops all motors at an emergency stop, each as configured, until the next arm.
    pub fn emergency(&mut self, trip: Trip, now: Stamp) {
        self.stop_at_emergency(trip, now);
    }

    /// As [`Self::arm`], also where joints are outside their limits: those are driven back first, at
    /// [`RETURN_SPEED`], and no action is followed meanwhile.
    pub fn arm_back(&mut self, now: Stamp) {
        let was_armed = self.is_armed();
        self.arm(now);
        self.is_returning |= self.state == BusState::Arming && !was_armed;
    }

    /// Disables all motors.
    pub fn disarm(&mut self, now: Stamp) {
        if self.is_armed() || self.state == BusState::Arming || self.is_keeping() {
            self.disable(Reason::Asked, now);
        }
    }

    /// The frames that disable every motor, for every way to end. No other frame follows them; they may be taken again.
    pub fn stop_frames(&mut self) -> impl Iterator<Item = CanFrame> + '_ {
        self.state = BusState::Stopped;
        self.motors.iter_mut().map(Motor::stop)
    }

    /// Names of the motors that may be on: ordered or reported to be on, and not reported off since the last disable.
    pub fn still_on(&self) -> impl Iterator<Item = &str> {
        self.motors.iter().filter(|motor| motor.may_be_on()).map(Motor::name)
    }

    /// Fills `out` with [`SAMPLE_VALUES`] values per motor if every motor has answered since the last sample, and
    /// returns the time of the earliest answer. Also `None` if `out` has another length.
    pub fn sample(&mut self, out: &mut [f64]) -> Option<Stamp> {
        if out.len() != self.motors.len() * SAMPLE_VALUES
            || !self.motors.iter().all(|motor| motor.unsampled().is_some())
        {
            return None;
        }
        let captured = self.motors.iter().filter_map(Motor::unsampled).min()?;
        for (values, motor) in out.chunks_exact_mut(SAMPLE_VALUES).zip(&mut self.motors) {
            values.copy_from_slice(&motor.sample()?);
        }
        Some(captured)
    }

    /// One cycle: decides what is due and passes its frames to `send`, at most two per motor. Feed all received frames
    /// first.
    pub fn step(&mut self, now: Stamp, mut send: impl FnMut(CanFrame)) {
        if self.state == BusState::Stopped {
            return;
        }
        self.look_for_stall(now);
        let passed = self.stepped.map_or(self.cycle, |last| now.since(last)).min(self.cycle * LATE_CYCLES);
        self.stepped = Some(now);
        self.listen(now);
        self.advance(now, passed);
        let count = self.motors.len().max(1);
        for at in self.first..self.first + count {
            let Some(motor) = self.motors.get_mut(at % count) else { continue };
            motor.step(now).for_each(&mut send);
        }
        self.first = (self.first + 1) % count;
    }
}

#[cfg(test)]
mod tests;
