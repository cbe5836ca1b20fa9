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
//! Invariant: a number of the motor itself is in its frames alone; all others are of its joint (see [`Joint`]).
//!
//! Made of what is asked of it ([`Probe`]), what it reports ([`Report`], [`Status`]) and how that is judged
//! ([`Supervision`]), its [`Brake`], what it is commanded ([`Axis`]), and what is left of a motor that was stopped
//! ([`Kept`]); each owns its state, and the phase decides what goes to which. The bus reads of them what needs no phase.

mod axis;
mod brake;
mod joint;
mod kept;
mod probe;
mod report;
mod status;
mod supervision;

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::{MotorMode, MotorSpec, Stop, StopSpec};

use super::fault::Fault;
use super::notice::Notice;
use super::notices::Notices;
use crate::control::can::CanFrame;
use crate::control::damiao::codec::{Feedback, MotorStatus, Ranges, StateCommand};
use crate::control::damiao::parameter::{self, Reply};
pub(super) use axis::Axis;
pub use axis::RETURN_SPEED;
use brake::Brake;
pub(super) use brake::BrakeIs;
use joint::Joint;
use kept::Kept;
use probe::Probe;
use report::Report;
pub use report::SAMPLE_VALUES;
use status::Status;
use supervision::{Supervision, beyond, hot, is_near, unfit};

/// See the module's comment.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// To be disabled; `reported` is set once a frame was sent.
    Off {
        reported: bool,
    },
    Asked,
    Probed,
    Clearing,
    Enabling,
    On,
    /// Stopped by a fault of the bus, and still enabled.
    Kept(Kept),
}

#[derive(Debug)]
pub(super) struct Motor {
    pub(super) joint: Joint,
    pub(super) report: Report,
    pub(super) status: Status,
    pub(super) brake: Brake,
    pub(super) axis: Axis,
    phase: Phase,
    probe: Probe,
    supervision: Supervision,
}

impl Motor {
    /// A motor in an unknown state, by its position in the entry.
    pub(super) fn new(index: usize, spec: &MotorSpec, timeout: Duration, silent_after: Duration) -> Self {
        Self {
            joint: Joint { index, spec: spec.clone() },
            phase: Phase::Off { reported: false },
            probe: Probe::new(timeout),
            report: Report::new(silent_after),
            status: Status::default(),
            supervision: Supervision::default(),
            brake: Brake::new(spec.brake.clone()),
            axis: Axis::new(spec),
        }
    }

    /// Where its joint is, rad, once that is known.
    pub(super) fn position(&self) -> Option<f64> {
        self.report.feedback().map(|feedback| feedback.q)
    }

    /// Its part of a sample.
    pub(super) fn sample(&mut self) -> Option<[f64; SAMPLE_VALUES]> {
        self.report.sample()
    }

    /// It was ordered to turn off, and has since reported that it is not enabled.
    pub(super) fn is_off(&self) -> bool {
        match self.phase {
            Phase::Off { reported } => reported && self.status.is_off(),
            Phase::Asked | Phase::Probed => true,
            Phase::Clearing | Phase::Enabling | Phase::On | Phase::Kept(_) => false,
        }
    }

    /// It is on, or ordered to turn on.
    pub(super) const fn is_ordered_on(&self) -> bool {
        matches!(self.phase, Phase::Enabling | Phase::On)
    }

    /// It is on, and its brake lets it turn.
    pub(super) fn is_ready(&self, now: Stamp) -> bool {
        self.phase == Phase::On && self.brake.is_free(now)
    }

    /// How it was stopped, if it was stopped by a fault and is still enabled.
    pub(super) const fn kept(&self) -> Option<Stop> {
        if let Phase::Kept(kept) = &self.phase { Some(kept.stop()) } else { None }
    }

    /// It is kept until its brake holds the joint.
    pub(super) const fn waits_for_brake(&self) -> bool {
        matches!(&self.phase, Phase::Kept(kept) if kept.waits_for_brake())
    }

    /// Is its brake to be released? Not before it holds the joint itself, and no longer.
    pub(super) const fn releases(&self) -> bool {
        match &self.phase {
            Phase::On => true,
            Phase::Kept(kept) => kept.releases(),
            _ => false,
        }
    }

    pub(super) fn take_brake(&mut self, is: BrakeIs, now: Stamp, notices: &mut Notices) {
        // A brake that is to be released may already be moving: it counts as engaged only once engagement is wanted.
        let is = if is == BrakeIs::Engaged && self.releases() { BrakeIs::Moving } else { is };
        self.brake.update(is, now);
        if let Phase::Kept(kept) = &mut self.phase
            && kept.misses(&self.brake)
        {
            notices.notify(Notice::NotBraked { motor: self.joint.index });
        }
    }

    /// Takes a frame of it, which is a reply or a feedback.
    ///
    /// # Errors
    /// What it reports is a fault, whatever the bus does.
    pub(super) fn feed(
        &mut self,
        frame: &CanFrame,
        reply: Option<&Reply>,
        now: Stamp,
        notices: &mut Notices,
    ) -> Result<(), Fault> {
        match reply {
            Some(reply) => self.take_reply(reply, notices),
            None => self.take_feedback(frame, now, notices),
        }
    }

    fn take_reply(&mut self, reply: &Reply, notices: &mut Notices) -> Result<(), Fault> {
        self.report.answer();
        match self.phase {
            Phase::On | Phase::Kept(_) => self.probe.compare(&self.joint, reply),
            Phase::Asked => {
                let before = self.probe.ranges().copied();
                if self.probe.accept(&self.joint, reply, notices)? {
                    self.phase = Phase::Probed;
                    if self.probe.ranges() != before.as_ref() {
                        self.report.forget();
                    }
                }
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn take_feedback(&mut self, frame: &CanFrame, now: Stamp, notices: &mut Notices) -> Result<(), Fault> {
        let (joint, ranges) = (&self.joint, self.probe.ranges());
        // Before its ranges are known, only its reported state counts.
        let Some(feedback) =
            ranges.copied().or(Ranges::new(1.0, 1.0, 1.0)).and_then(|ranges| joint.feedback(frame, &ranges))
        else {
            return Ok(());
        };
        self.report.answer();
        // One that is off may be turned by hand, and its zero set; one that is damped sinks without regard to where it is.
        let is_steady = match &self.phase {
            Phase::Enabling | Phase::On => true,
            Phase::Kept(kept) => kept.stop() != Stop::Damp,
            _ => false,
        };
        if let Some(ranges) = ranges {
            let before = self.report.feedback().filter(|_| is_steady);
            // Nothing in a damaged frame is trusted.
            if !self.supervision.receive(before, &feedback, (joint, ranges), now, notices)? {
                return Ok(());
            }
            let is_near = |before: &Feedback, passed| is_near(before, &feedback, (&joint.spec, ranges), passed);
            self.report.update(feedback, now, is_near);
        }
        let is_on = matches!(self.phase, Phase::On | Phase::Kept(_));
        let is_ordered_off = matches!(self.phase, Phase::Off { reported: true } | Phase::Asked | Phase::Probed);
        self.status.update(feedback.status, is_on, is_ordered_off);
        self.supervision.feel(joint, &feedback, notices);
        Ok(())
    }

    /// What is wrong with a motor that should be enabled, or disabled, according to its reported state.
    pub(super) fn status_fault(&self) -> Option<Fault> {
        let is_kept = self.kept().is_some();
        self.status.fault(self.joint.index, is_kept || self.phase == Phase::On, is_kept)
    }

    /// Is it hotter than it may be?
    pub(super) fn heat_fault(&self) -> Option<Fault> {
        hot(&self.joint, self.report.feedback()?)
    }

    /// Reports its latched fault, once, unless it is the one that is `reported` already; the next arm clears it.
    pub(super) fn name_latched(&mut self, reported: Option<Fault>, notices: &mut Notices) {
        let motor = self.joint.index;
        if let Some(status) = self.status.name()
            && reported != Some(Fault::Latched { motor, status })
        {
            notices.notify(Notice::Latched { motor, status });
        }
    }

    /// Asks for its parameters if it is off.
    pub(super) fn ask(&mut self) {
        if matches!(self.phase, Phase::Off { .. }) && self.is_off() {
            self.probe.start();
            self.phase = Phase::Asked;
        }
    }

    /// Has it reported its parameters since it was off?
    pub(super) const fn has_told(&self) -> bool {
        !matches!(self.phase, Phase::Off { .. } | Phase::Asked)
    }

    /// As [`Self::ask`], if its ranges are still unknown: it had no power, or an arm interrupted it.
    pub(super) fn ask_late(&mut self, now: Stamp) {
        match self.phase {
            // It may receive although its own frames do not arrive.
            Phase::Asked | Phase::Probed if self.report.is_silent(now) => self.turn_off(),
            Phase::Off { .. } if self.probe.ranges().is_none() && !self.report.is_silent(now) => self.ask(),
            _ => {}
        }
    }

    /// It has not reported its parameters; `true` once.
    pub(super) fn misses_probe(&mut self) -> bool {
        self.phase != Phase::Probed && self.probe.misses()
    }

    /// Enables it once its parameters are read; faults are cleared first. Until then its command is its position.
    ///
    /// # Errors
    /// It must not be armed at its position, or has latched a fault that was not reported yet.
    pub(super) fn enable(&mut self, passed: Duration, is_returning: bool, notices: &mut Notices) -> Result<(), Fault> {
        let (joint, motor) = (&self.joint, self.joint.index);
        let (Some(ranges), Some(feedback), Some(status)) =
            (self.probe.ranges(), self.report.feedback(), self.status.newest())
        else {
            return Ok(());
        };
        if self.phase == Phase::Probed {
            // One of the two frames may be damaged: the position of the joint is unknown.
            if !self.report.agrees() {
                return Ok(());
            }
            if let Some(fault) = unfit(joint, feedback, is_returning) {
                return Err(fault);
            }
            if status.is_fault() {
                if !self.status.is_named(status) {
                    return Err(Fault::Latched { motor, status });
                }
                notices.notify(Notice::Cleared { motor, status });
            }
            self.phase = Phase::Clearing;
            self.axis.narrow(joint, ranges);
        }
        if self.phase == Phase::Clearing && status == MotorStatus::Disabled {
            self.phase = Phase::Enabling;
        }
        if self.phase == Phase::Enabling {
            self.axis.start_at(joint, feedback.q);
            if status == MotorStatus::Enabled {
                self.phase = Phase::On;
            }
        } else if self.phase == Phase::On {
            self.axis.stay(joint, (feedback.q, ranges), passed);
        }
        Ok(())
    }

    /// Why it is not enabled by now, if it is not.
    pub(super) fn arm_fault(&self) -> Option<Fault> {
        let motor = self.joint.index;
        match (self.phase, self.status.newest()) {
            (Phase::On, _) if self.brake.may_hold() => Some(Fault::NotReleased { motor }),
            (Phase::Probed, _) if !self.report.agrees() => Some(Fault::NotEnabled { motor }),
            // Who is probed waits for the others, which come to their own.
            (Phase::On | Phase::Probed, _) => None,
            (Phase::Off { .. }, Some(MotorStatus::Enabled)) | (Phase::Kept(_), _) => Some(Fault::NotDisabled { motor }),
            (Phase::Off { .. }, _) => Some(Fault::Silent { motor }),
            (Phase::Asked, _) => Some(Fault::Unread { motor, parameter: self.probe.asked_for() }),
            (Phase::Clearing, Some(status)) if status != MotorStatus::Disabled => {
                Some(Fault::Latched { motor, status })
            }
            (Phase::Clearing | Phase::Enabling, _) => Some(Fault::NotEnabled { motor }),
        }
    }

    /// All motors are enabled: it starts softly from here.
    pub(super) const fn restart(&mut self) {
        self.axis.restart();
    }

    /// Aims at a target, as far as its limits allow.
    pub(super) fn aim(&mut self, target: f64, now: Stamp, notices: &mut Notices) {
        self.axis.aim(self.joint.index, target, now, notices);
    }

    /// Aims at its last command, or where it can stop.
    pub(super) fn hold(&mut self) {
        self.axis.hold(&self.joint);
    }

    /// Is it too far from an action for that to be the first after an arm?
    pub(super) fn is_far(&self, target: f64) -> bool {
        self.position().is_some_and(|q| self.axis.is_far(&self.joint, q, target))
    }

    /// A cycle of its command, towards `target` or back into its limits; see [`Axis::follow`]. A joint whose position is
    /// unknown is not moved. Returns what is wrong with what it does, once that is a fault.
    pub(super) fn follow(
        &mut self,
        target: Option<f64>,
        (now, passed): (Stamp, Duration),
        is_led: bool,
        notices: &mut Notices,
    ) -> Option<Fault> {
        let (joint, feedback) = (&self.joint, self.report.feedback()?);
        let commanded = self.axis.follow(joint, (feedback.q, self.probe.ranges()?), target, passed, is_led);
        self.supervision.check(joint, feedback, commanded, now, notices)
    }

    /// Has it returned into its limits?
    pub(super) fn is_back(&self) -> bool {
        let is_within = |feedback| beyond(&self.joint.spec, feedback).is_none();
        self.axis.is_back(&self.joint) && self.report.feedback().is_some_and(is_within)
    }

    /// Turns it off, from the next frame on.
    pub(super) fn turn_off(&mut self) {
        self.supervision.reset();
        self.phase = Phase::Off { reported: false };
    }

    /// Turns it off for the last time, by this frame, which may be taken again.
    pub(super) fn stop(&mut self) -> CanFrame {
        if self.phase != (Phase::Off { reported: true }) {
            self.phase = Phase::Off { reported: true };
            self.status.order_off();
        }
        self.state_frame(StateCommand::Disable)
    }

    /// Stops it at a fault; `is_own`: its own. One that is not on is turned off; one that is kept already stays so, but for
    /// a fault of its own, with which nothing is known of it any more.
    pub(super) fn stop_at_fault(&mut self, is_own: bool) {
        let StopSpec { own_fault, other_fault, .. } = self.joint.spec.stop;
        match (self.phase, is_own) {
            (Phase::Kept(_), true) => self.turn_off(),
            (Phase::Kept(_), false) => {}
            (_, true) => self.stop_as(own_fault),
            (_, false) => self.stop_as(other_fault),
        }
    }

    /// Stops it at an emergency stop. What a fault has left on may hold no more than before.
    pub(super) fn stop_at_emergency(&mut self) {
        let stop = self.joint.spec.stop.emergency;
        let Phase::Kept(kept) = &mut self.phase else { return self.stop_as(stop) };
        if !kept.stop_at_emergency(stop, &self.brake) {
            self.turn_off();
        }
    }

    fn stop_as(&mut self, stop: Stop) {
        let has_damping = matches!(self.joint.spec.mode, MotorMode::Mit { .. });
        let stop = if stop == Stop::Damp && !has_damping { Stop::Hold } else { stop };
        // One that has turned itself off, or reports a fault, follows no command.
        match Kept::new(stop).filter(|_| self.phase == Phase::On && self.status.may_follow()) {
            Some(kept) => {
                self.supervision.reset();
                self.phase = Phase::Kept(kept);
            }
            None => self.turn_off(),
        }
    }

    /// Turns it off if it was kept for long enough, `waited` after the stop, or does not answer.
    pub(super) fn let_go(&mut self, waited: Duration, now: Stamp) {
        let hold_for = self.joint.spec.stop.hold_for;
        if let Phase::Kept(kept) = &mut self.phase
            && (kept.is_over(hold_for, &self.brake, (waited, now)) || self.report.is_silent(now))
        {
            self.turn_off();
        }
    }

    /// A cycle: its frames, in the order in which they are to be sent.
    pub(super) fn step(&mut self, now: Stamp) -> impl Iterator<Item = CanFrame> + use<> {
        if matches!(self.phase, Phase::Asked | Phase::Probed) && self.status.is_enabled() {
            self.turn_off();
        }
        let refresh = parameter::refresh(self.joint.spec.slave);
        let frames = match self.phase {
            Phase::Off { .. } if self.is_off() && !self.report.is_silent(now) => [Some(refresh), None],
            Phase::Off { reported } => {
                if !reported {
                    self.status.order_off();
                }
                self.phase = Phase::Off { reported: true };
                [Some(self.state_frame(StateCommand::Disable)), None]
            }
            Phase::Asked => [Some(self.probe.question(&self.joint)), Some(refresh)],
            Phase::Probed => [Some(refresh), None],
            Phase::Clearing => [Some(self.state_frame(StateCommand::ClearError)), Some(refresh)],
            Phase::Enabling => {
                self.status.order_on();
                [Some(self.state_frame(StateCommand::Enable)), self.frame_to(self.axis.command())]
            }
            Phase::On => [self.frame_to(self.axis.command()), self.probe.look_again(&self.joint, now)],
            Phase::Kept(kept) => [self.stop_frame(kept.stop()), None],
        };
        self.report.ask(now);
        frames.into_iter().flatten()
    }

    /// The frame that keeps the motor from falling, or from falling fast, while no program reads what it reports; one that
    /// disables it where it is to be limp.
    ///
    /// A joint in MIT mode that is to hold is damped: with nothing to lower the stiffness, a joint that is pushed away
    /// would push back with more than its torque limit.
    pub(super) fn last_will(&self) -> CanFrame {
        let kept = if self.last_stop() == Stop::Limp { None } else { self.stop_frame(Stop::Damp) };
        kept.unwrap_or_else(|| self.state_frame(StateCommand::Disable))
    }

    /// How it stops when this program can command it no more.
    pub(super) const fn last_stop(&self) -> Stop {
        match &self.phase {
            Phase::On => self.joint.spec.stop.other_fault,
            Phase::Kept(kept) => kept.stop(),
            _ => Stop::Limp,
        }
    }

    const fn state_frame(&self, command: StateCommand) -> CanFrame {
        command.frame(self.joint.spec.slave)
    }

    /// Commands are finite: targets are, and so are the values of a motor.
    fn frame_to(&self, command: f64) -> Option<CanFrame> {
        self.joint.command(command, self.report.feedback()?.q, self.probe.ranges()?)
    }

    /// What damps it, or keeps it where it is: at rest if its command is a velocity.
    fn stop_frame(&self, stop: Stop) -> Option<CanFrame> {
        match self.joint.spec.mode {
            MotorMode::Mit { .. } if stop == Stop::Damp => {
                self.joint.damping(self.report.feedback()?.q, self.probe.ranges()?)
            }
            MotorMode::Velocity => self.frame_to(0.0),
            _ => self.frame_to(self.axis.command()),
        }
    }
}
