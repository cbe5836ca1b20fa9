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
//! Two parts have invariants of their own, as important as those below: `schedule`, how long a pause between cycles may
//! be; `actions`, which actions are followed.
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

mod actions;
mod brakes;
mod fault;
mod motor;
mod notice;
mod notices;
mod schedule;
mod words;

use std::time::Duration;

use actions::Actions;
pub use brakes::Brakes;
pub use fault::{Fault, Part, Strange};
use motor::{Axis, Motor};
pub use motor::{RETURN_SPEED, SAMPLE_VALUES};
pub use notice::{BusState, Notice, Reason, Refusal};
use notices::Notices;
use schedule::Schedule;
pub use schedule::stalled_after;
pub use words::Words;

use rapid_core::action::Trip;
use rapid_core::time::Stamp;
use rapid_registry::{DamiaoSpec, Stop};

use super::can::CanFrame;
use super::damiao::codec;
use super::damiao::parameter::Reply;
use super::deadman::Verdict;

/// A motor may leave the frames of this many cycles unanswered, however short the configured time.
const SILENT_CYCLES: u32 = 3;
/// An arm that took longer has failed...
const ARM_WITHIN: Duration = Duration::from_secs(1);
/// ...and more cycles: reading a parameter takes one, setting it another, and answers may take several.
const ARM_CYCLES: u32 = 40;
/// A motor that has not reported its parameters after this is named in a notice.
const PROBE_WITHIN: Duration = Duration::from_secs(1);
/// An armed motor must not have been commanded by another program for this long.
const ONE_MASTER: Duration = Duration::from_secs(1);
/// Motors that answer must turn off within this.
const DISABLE_WITHIN: Duration = Duration::from_millis(500);

/// See the module's comment.
#[derive(Debug)]
pub struct MotorBus {
    motors: Vec<Motor>,
    names: Vec<String>,
    state: BusState,
    /// When the state began.
    since: Stamp,
    /// Why the motors are being disabled.
    reason: Reason,
    /// Joints outside their limits are being driven back into them, or will be once they are armed.
    is_returning: bool,
    /// An arm that took longer, the release of brakes included, has failed.
    arm_within: Duration,
    schedule: Schedule,
    actions: Actions,
    /// The motor that another program commanded last, and when.
    other_master: Option<(usize, Stamp)>,
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
        let cycle = schedule::cycle(spec);
        let silent_after = spec.silent_after.max(cycle * SILENT_CYCLES);
        let motors = spec.motors.iter().enumerate();
        Self {
            motors: motors.map(|(index, motor)| Motor::new(index, motor, spec.timeout, silent_after)).collect(),
            names: spec.motors.iter().map(|motor| motor.name.clone()).collect(),
            state: BusState::Probing,
            since: now,
            reason: Reason::Asked,
            is_returning: false,
            arm_within: ARM_WITHIN.max(cycle * ARM_CYCLES) + brakes::slowest(spec),
            schedule: Schedule::new(spec),
            actions: Actions::new(spec, now),
            other_master: None,
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

    /// Are all motors enabled, or being enabled?
    const fn is_arming(&self) -> bool {
        self.is_armed() || matches!(self.state, BusState::Arming)
    }

    /// Names of the motors, for [`Notice::words`].
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The command to each motor as of the last step, rad or rad/s. Means nothing unless armed.
    pub fn commands(&self) -> impl Iterator<Item = f64> {
        self.motors.iter().map(|motor| motor.axis.command())
    }

    /// What has happened so far.
    pub fn counts(&self) -> Counts {
        let clamped = self.motors.iter().map(|motor| motor.axis.clamped()).sum();
        Counts { clamped, lost_notices: self.notices.lost(), ..self.counts }
    }

    /// The oldest notice that was not taken yet.
    pub fn take_notice(&mut self) -> Option<Notice> {
        self.notices.pop()
    }

    /// The brakes that must be released after the last step, one bit per motor; all others must be engaged.
    pub fn releases(&self) -> u16 {
        self.bits(Motor::releases)
    }

    /// The brakes that are to engage at once when this program can no longer command: those of joints that stop by
    /// their brake, and of joints that nothing else keeps from falling.
    pub fn engages_at_death(&self) -> u16 {
        self.bits(|motor| matches!(motor.last_stop(), Stop::Limp | Stop::Brake))
    }

    fn bits(&self, is_set: impl Fn(&Motor) -> bool) -> u16 {
        let set = self.motors.iter().enumerate().filter(|(_, motor)| is_set(motor));
        set.fold(0, |bits, (index, _)| bits | 1 << (index % 16))
    }

    /// A frame per motor that stops it as configured for the fault of another motor, to be sent repeatedly by the
    /// process that outlives this one (`driver::can::guard`) when this one is killed, stopped or hangs; `None` if no motor is
    /// on.
    pub fn last_will(&self) -> Option<impl Iterator<Item = CanFrame> + '_> {
        // Already before the first motor is ordered to turn on.
        let is_on = self.state == BusState::Arming || self.motors.iter().any(|motor| motor.status.may_be_on());
        is_on.then(|| self.motors.iter().map(Motor::last_will))
    }

    /// Names of the motors that may be on: ordered or reported to be on, and not reported off since the last disable.
    pub fn still_on(&self) -> impl Iterator<Item = &str> {
        self.motors.iter().filter(|motor| motor.status.may_be_on()).map(|motor| motor.joint.name())
    }

    /// Fills `out` with [`SAMPLE_VALUES`] values per motor if every motor has answered since the last sample, and
    /// returns the time of the earliest answer: each is newer than in the previous sample. Also `None` if `out` has another
    /// length.
    ///
    /// A motor that answers eventually appears here, whatever happened to the bus before its ranges were read, unless the
    /// ranges are unusable.
    pub fn sample(&mut self, out: &mut [f64]) -> Option<Stamp> {
        if out.len() != self.motors.len() * SAMPLE_VALUES {
            return None;
        }
        let captured = self.motors.iter().map(|motor| motor.report.unsampled()).min()??;
        for (values, motor) in out.chunks_exact_mut(SAMPLE_VALUES).zip(&mut self.motors) {
            values.copy_from_slice(&motor.sample()?);
        }
        Some(captured)
    }

    /// A frame came from the bus.
    pub fn feed(&mut self, frame: &CanFrame, now: Stamp) {
        let reply = Reply::decode(frame);
        let is_full = codec::data_of(frame).is_some();
        let sender = self.motors.iter().position(|motor| is_full && motor.joint.sent(frame, reply.as_ref()));
        let Some(index) = sender else {
            self.counts.strangers += u64::from(is_full);
            // A command of one or two values may be shorter.
            let is_frame = !(frame.extended || frame.remote || frame.error);
            if let Some(motor) = self.motors.iter().position(|motor| is_frame && motor.joint.is_commanded_by(frame)) {
                self.received_master(motor, now);
            }
            return;
        };
        let Some(motor) = self.motors.get_mut(index) else { return };
        let taken = motor.feed(frame, reply.as_ref(), now, &mut self.notices);
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

    /// The fault that a motor reports, if any.
    fn judge(&self, index: usize) -> Option<Fault> {
        let motor = self.motors.get(index)?;
        let status = || motor.status_fault();
        match self.state {
            BusState::Arming if !motor.is_ordered_on() => motor.heat_fault(),
            BusState::Disarmed | BusState::Arming | BusState::Following | BusState::Holding => {
                status().or_else(|| motor.heat_fault())
            }
            BusState::Faulted(_) if motor.kept().is_none() => None,
            // It was stopped for this fault, as configured.
            BusState::Faulted(Fault::Hot { motor, .. }) if motor == index => status(),
            // It was stopped, and is still on.
            BusState::Faulted(_) => status().or_else(|| motor.heat_fault()),
            BusState::Probing | BusState::Disabling | BusState::Stopped => None,
        }
    }

    /// Another program commands a motor: an arm with a second master is a fault.
    fn received_master(&mut self, motor: usize, now: Stamp) {
        let is_news = self.other_master.replace((motor, now)).is_none_or(|(_, last)| now.since(last) >= ONE_MASTER);
        if self.is_arming() {
            self.fail(Fault::OtherMaster { motor }, now);
        } else if is_news && self.state != BusState::Stopped {
            self.notices.notify(Notice::OtherMaster { motor });
        }
    }

    /// Takes the states of the brakes; to be called before each step if a motor has one. It is a fault if the brake of
    /// a joint that is armed, or being armed, cannot be driven.
    pub fn feed_brakes(&mut self, brakes: Brakes, now: Stamp) {
        for (index, motor) in self.motors.iter_mut().enumerate() {
            motor.take_brake(brakes.state(index), now, &mut self.notices);
        }
        let broken = self.motors.iter().position(|motor| motor.brake.is_broken()).filter(|_| self.is_arming());
        if let Some(motor) = broken {
            self.fail(Fault::Brake { motor }, now);
        }
    }

    /// An action: a number for each motor, and its tick. Returns whether it is followed.
    pub fn target(&mut self, target: &[f64], tick: Stamp, now: Stamp) -> bool {
        let is_armed = self.is_armed();
        let far = || self.far(target).filter(|_| is_armed);
        let refusal = self.actions.refusal(target, (tick, now), is_armed && self.is_returning, far);
        if let Some(refusal) = refusal {
            self.counts.refused += 1;
            if self.actions.refuse(refusal, now) {
                self.notices.notify(Notice::Refused(refusal));
            }
            return false;
        }
        self.actions.accept(target, tick, now);
        if !is_armed || !self.actions.is_next(tick) {
            return false;
        }
        for (motor, target) in self.motors.iter_mut().zip(target) {
            motor.aim(*target, now, &mut self.notices);
        }
        let motors = &self.motors;
        let [targets, commands] =
            [Axis::target, Axis::command].map(|of| motors.iter().map(move |motor| of(&motor.axis)));
        self.actions.follow(targets, tick, commands, (self.schedule.in_force(now), now));
        self.counts.actions += 1;
        if self.state == BusState::Holding {
            self.enter(BusState::Following, now);
            self.notices.notify(Notice::Following);
        }
        true
    }

    /// The first motor that is too far from an action for it to be the first after an arm.
    fn far(&self, target: &[f64]) -> Option<usize> {
        self.motors.iter().zip(target).position(|(motor, target)| motor.is_far(*target))
    }

    /// Enables all motors, after reading their parameters and clearing their faults. A notice reports
    /// whether that succeeded. Does nothing while they are enabled or being enabled.
    pub fn arm(&mut self, now: Stamp) {
        if self.is_arming() || self.state == BusState::Stopped {
            return;
        }
        if let Some(fault) = self.schedule.stall(now) {
            // The order may be that old too.
            self.fail(fault, now);
            return;
        }
        self.turn_off();
        self.is_returning = false;
        self.enter(BusState::Arming, now);
        self.notices.notify(Notice::Arming);
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
        if self.is_arming() || self.is_keeping() {
            self.disable(Reason::Asked, now);
        }
    }

    /// Stops all motors at an emergency stop, each as configured, until the next arm; also those that a fault has left on.
    /// Only once per arm; motors that are disabled, or being disabled, stay so.
    pub fn emergency(&mut self, trip: Trip, now: Stamp) {
        let is_news = !matches!(self.state, BusState::Faulted(Fault::EmergencyStop(_)));
        if self.is_arming() || is_news && self.is_keeping() {
            self.motors.iter_mut().for_each(Motor::stop_at_emergency);
            self.enter(BusState::Faulted(Fault::EmergencyStop(trip)), now);
            self.report_stopped(Fault::EmergencyStop(trip));
        }
    }

    /// The frames that disable every motor, for every way to end. No other frame follows them; they may be taken again.
    pub fn stop_frames(&mut self) -> impl Iterator<Item = CanFrame> + '_ {
        self.state = BusState::Stopped;
        self.motors.iter_mut().map(Motor::stop)
    }

    /// To be called before feeding frames that waited while nothing ran; [`Self::step`] does so itself.
    ///
    /// After a pause longer than [`stalled_after`] the motors may have been stopped by their own limit or by the guard,
    /// and the positions of the joints are unknown. The pause is reported as the fault, not its consequences.
    pub fn look_for_stall(&mut self, now: Stamp) {
        if let Some(fault) = self.schedule.stall(now).filter(|_| self.is_arming()) {
            self.fail(fault, now);
        }
    }

    /// One cycle: decides what is due and passes its frames to `send`, at most two per motor. Feed all received frames
    /// first.
    pub fn step(&mut self, now: Stamp, mut send: impl FnMut(CanFrame)) {
        if self.state == BusState::Stopped {
            return;
        }
        self.look_for_stall(now);
        let passed = self.schedule.begin(now);
        self.listen(now);
        self.advance(now, passed);
        for index in self.schedule.turn(self.motors.len()) {
            if let Some(motor) = self.motors.get_mut(index) {
                motor.step(now).for_each(&mut send);
            }
        }
    }

    /// Handles motors that do not answer.
    fn listen(&mut self, now: Stamp) {
        let Some(motor) = self.motors.iter().position(|motor| motor.report.is_silent(now)) else { return };
        if !matches!(self.state, BusState::Probing | BusState::Faulted(_)) {
            self.fail(Fault::Silent { motor }, now);
        }
    }

    /// What is due in a cycle, by the state of the bus.
    fn advance(&mut self, now: Stamp, passed: Duration) {
        let waited = now.since(self.since);
        match self.state {
            BusState::Probing => self.probe(waited, now),
            BusState::Arming => self.enable(waited, now, passed),
            BusState::Following | BusState::Holding => match self.actions.verdict(now) {
                Verdict::Disable => self.disable(Reason::Deadman, now),
                Verdict::Hold if self.state == BusState::Following => {
                    self.hold(now);
                    self.notices.notify(Notice::Holding);
                    self.follow(now, passed);
                }
                Verdict::Hold | Verdict::Follow => self.follow(now, passed),
            },
            BusState::Disabling => match self.motors.iter().position(|motor| !motor.is_off()) {
                None => {
                    self.enter(BusState::Disarmed, now);
                    self.notices.notify(Notice::Disabled(self.reason));
                }
                Some(motor) if waited >= DISABLE_WITHIN => self.fail(Fault::NotDisabled { motor }, now),
                Some(_) => {}
            },
            BusState::Faulted(fault) => {
                self.motors.iter_mut().for_each(|motor| motor.let_go(waited, now));
                // An arm would find the same fault again.
                if !matches!(fault, Fault::Unusable { .. }) {
                    self.ask_late(now);
                }
            }
            BusState::Disarmed => self.ask_late(now),
            BusState::Stopped => {}
        }
    }

    /// Queries motors whose ranges are still unknown after probing: they had no power then, or an arm interrupted it.
    fn ask_late(&mut self, now: Stamp) {
        self.motors.iter_mut().for_each(|motor| motor.ask_late(now));
    }

    /// Queries the parameters of motors that are off. Returns whether all have reported them.
    fn ask(&mut self) -> bool {
        self.motors.iter_mut().for_each(Motor::ask);
        self.motors.iter().all(Motor::has_told)
    }

    fn probe(&mut self, waited: Duration, now: Stamp) {
        if self.ask() {
            self.enter(BusState::Disarmed, now);
            self.notices.notify(Notice::Ready);
        } else if waited >= PROBE_WITHIN {
            for (motor, asked) in self.motors.iter_mut().enumerate() {
                if asked.misses_probe() {
                    self.notices.notify(Notice::Unanswered { motor });
                }
            }
        }
    }

    fn enable(&mut self, waited: Duration, now: Stamp, passed: Duration) {
        let other = self.other_master.filter(|(_, last)| now.since(*last) < ONE_MASTER);
        let other = other.map(|(motor, _)| Fault::OtherMaster { motor });
        if let Some(fault) = other.or_else(|| self.far_from_actions(now)) {
            self.fail(fault, now);
            return;
        }
        if self.ask() {
            let mut motors = self.motors.iter_mut();
            let enabled = motors.try_for_each(|motor| motor.enable(passed, self.is_returning, &mut self.notices));
            if let Err(fault) = enabled {
                self.fail(fault, now);
                return;
            }
        }
        if self.motors.iter().all(|motor| motor.is_ready(now)) {
            self.motors.iter_mut().for_each(Motor::restart);
            self.actions.arm(self.motors.iter().map(|motor| motor.axis.command()), now);
            self.hold(now);
            self.notices.notify(if self.is_returning { Notice::Returning } else { Notice::Armed });
        } else if waited >= self.arm_within
            && let Some(fault) = self.motors.iter().find_map(Motor::arm_fault)
        {
            self.fail(fault, now);
        }
    }

    /// The target of incoming actions, if it is far from a motor that is not enabled yet. Joints that are driven back may be
    /// anywhere.
    fn far_from_actions(&self, now: Stamp) -> Option<Fault> {
        let target = self.actions.newest(now).filter(|_| !self.is_returning)?;
        let motor = self.far(target)?;
        let position = self.motors.get(motor)?.position()?;
        Some(Fault::Far { motor, position, target: *target.get(motor)? })
    }

    /// Holds the last command, or stops as soon as it can.
    fn hold(&mut self, now: Stamp) {
        self.motors.iter_mut().for_each(Motor::hold);
        self.actions.hold(self.motors.iter().map(|motor| motor.axis.target()));
        self.enter(BusState::Holding, now);
    }

    /// The commands of this cycle, and whether each motor follows its own.
    fn follow(&mut self, now: Stamp, passed: Duration) {
        let (mut first, is_led) = (None, self.actions.is_led());
        for (axis, motor) in self.motors.iter_mut().enumerate() {
            let target = (!self.is_returning).then(|| self.actions.target(axis, now));
            // Each follows, even after one that is at fault.
            first = first.or(motor.follow(target, (now, passed), is_led, &mut self.notices));
        }
        if let Some(fault) = first {
            self.fail(fault, now);
        } else if self.is_returning {
            self.look_for_return(now);
        }
    }

    /// Ends the return once every joint is within its limits.
    fn look_for_return(&mut self, now: Stamp) {
        // The return needs no actions, however long it takes.
        self.actions.postpone(now);
        if self.motors.iter().all(Motor::is_back) {
            self.is_returning = false;
            self.hold(now);
            self.notices.notify(Notice::Returned);
        }
    }

    fn turn_off(&mut self) {
        self.motors.iter_mut().for_each(Motor::turn_off);
    }

    fn disable(&mut self, reason: Reason, now: Stamp) {
        self.turn_off();
        self.reason = reason;
        self.enter(BusState::Disabling, now);
    }

    /// Stops all motors, each as configured; of motors that are already stopped only the one with the fault.
    fn fail(&mut self, fault: Fault, now: Stamp) {
        let own = fault.own();
        // The first fault is the one that is reported.
        let is_keeping = matches!(self.state, BusState::Faulted(_)) && self.is_keeping();
        for (index, motor) in self.motors.iter_mut().enumerate() {
            motor.stop_at_fault(Some(index) == own);
        }
        if !is_keeping {
            self.enter(BusState::Faulted(fault), now);
        }
        self.report_stopped(fault);
    }

    fn report_stopped(&mut self, fault: Fault) {
        self.counts.faults += 1;
        self.notices.notify(Notice::Fault(fault));
        self.name_latched(Some(fault));
        let braked = self.bits(Motor::waits_for_brake);
        let kept = |stop| self.bits(|motor| motor.kept() == Some(stop)) & !braked;
        let [damped, held] = [Stop::Damp, Stop::Hold].map(kept);
        if damped | held | braked != 0 {
            self.notices.notify(Notice::Kept { damped, held, braked });
        }
    }

    /// Reports every latched fault once; the next arm clears them.
    fn name_latched(&mut self, reported: Option<Fault>) {
        self.motors.iter_mut().for_each(|motor| motor.name_latched(reported, &mut self.notices));
    }

    /// Is any motor still on that was stopped by a fault?
    fn is_keeping(&self) -> bool {
        self.motors.iter().any(|motor| motor.kept().is_some())
    }

    const fn enter(&mut self, state: BusState, now: Stamp) {
        self.state = state;
        self.since = now;
    }
}

#[cfg(test)]
mod tests;
