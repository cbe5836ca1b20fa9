//! What is due in a cycle, by the state of the bus.

use std::time::Duration;

use rapid_core::action::Trip;
use rapid_core::time::Stamp;
use rapid_registry::{MotorMode, Stop};

use super::MotorBus;
use super::fault::Fault;
use super::motor::{Motor, Phase};
use super::notice::{BusState, Notice, Reason};
use super::watch::Commanded;
use crate::control::deadman::Verdict;
use crate::control::ramp::Ramp;

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

impl MotorBus {
    /// Handles motors that do not answer.
    pub(super) fn listen(&mut self, now: Stamp) {
        let silent = |motor: &Motor| motor.unanswered(now) >= self.silent_after;
        let Some(motor) = self.motors.iter().position(silent) else { return };
        match self.state {
            BusState::Probing | BusState::Faulted(_) | BusState::Stopped => {}
            _ => self.fail(Fault::Silent { motor }, now),
        }
    }

    /// The fault that a motor reports, if any.
    pub(super) fn judge(&self, index: usize) -> Option<Fault> {
        let motor = self.motors.get(index)?;
        let status = || motor.status_fault();
        match (self.state, motor.phase) {
            (BusState::Disarmed | BusState::Following | BusState::Holding, _)
            | (BusState::Arming, Phase::Enabling | Phase::On) => status().or_else(|| motor.heat_fault()),
            (BusState::Arming, _) => motor.heat_fault(),
            // It was stopped for this fault, as configured.
            (BusState::Faulted(Fault::Hot { motor, .. }), Phase::Kept(_)) if motor == index => status(),
            // It was stopped, and is still on.
            (BusState::Faulted(_), Phase::Kept(_)) => status().or_else(|| motor.heat_fault()),
            _ => None,
        }
    }

    pub(super) fn advance(&mut self, now: Stamp, passed: Duration) {
        let waited = now.since(self.since);
        match self.state {
            BusState::Probing => self.probe(waited, now),
            BusState::Arming => self.enable(waited, now, passed),
            BusState::Following | BusState::Holding => match self.deadman.look(now, self.line.period()) {
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
            // An arm would find the same fault again.
            BusState::Faulted(Fault::Unusable { .. }) => self.keep(waited, now),
            BusState::Stopped => {}
            BusState::Faulted(_) => {
                self.keep(waited, now);
                self.ask_late(now);
            }
            BusState::Disarmed => self.ask_late(now),
        }
    }

    /// Handles motors that were stopped by a fault and are still on.
    fn keep(&mut self, waited: Duration, now: Stamp) {
        for motor in &mut self.motors {
            if motor.was_kept(waited, now) || motor.is_kept() && motor.unanswered(now) >= self.silent_after {
                motor.turn_off();
            }
        }
    }

    /// Queries motors whose ranges are still unknown after probing: they had no power then, or an arm interrupted it.
    fn ask_late(&mut self, now: Stamp) {
        for motor in &mut self.motors {
            let is_silent = motor.unanswered(now) >= self.silent_after;
            match motor.phase {
                Phase::Off { .. } if motor.ranges.is_none() && motor.is_off() && !is_silent => motor.probe(),
                // It may receive although its own frames do not arrive.
                Phase::Asked { .. } | Phase::Probed if is_silent => motor.turn_off(),
                _ => {}
            }
        }
    }

    /// Queries the parameters of motors that are off. Returns whether all have reported them.
    fn ask(&mut self) -> bool {
        for motor in &mut self.motors {
            if matches!(motor.phase, Phase::Off { .. }) && motor.is_off() {
                motor.probe();
            }
        }
        !self.motors.iter().any(|motor| matches!(motor.phase, Phase::Off { .. } | Phase::Asked { .. }))
    }

    fn probe(&mut self, waited: Duration, now: Stamp) {
        if self.ask() {
            self.enter(BusState::Disarmed, now);
            self.notices.notify(Notice::Ready);
        } else if waited >= PROBE_WITHIN {
            let missed = |motor: &Motor| motor.phase != Phase::Probed && !motor.missed;
            while let Some(motor) = self.motors.iter().position(missed) {
                if let Some(missed) = self.motors.get_mut(motor) {
                    missed.missed = true;
                }
                self.notices.notify(Notice::Unanswered { motor });
            }
        }
    }

    /// Another program commands a motor: an arm with a second master is a fault.
    pub(super) fn received_master(&mut self, motor: usize, now: Stamp) {
        let is_news = self.other_master.replace((motor, now)).is_none_or(|(_, last)| now.since(last) >= ONE_MASTER);
        match self.state {
            BusState::Arming | BusState::Following | BusState::Holding => self.fail(Fault::OtherMaster { motor }, now),
            BusState::Probing | BusState::Disarmed | BusState::Disabling | BusState::Faulted(_) if is_news => {
                self.notices.notify(Notice::OtherMaster { motor });
            }
            _ => {}
        }
    }

    fn enable(&mut self, waited: Duration, now: Stamp, passed: Duration) {
        if let Some((motor, last)) = self.other_master
            && now.since(last) < ONE_MASTER
        {
            self.fail(Fault::OtherMaster { motor }, now);
            return;
        }
        let far = (!self.is_returning).then(|| self.far_from_actions(now)).flatten();
        if let Some(fault) = far {
            self.fail(fault, now);
            return;
        }
        if self.ask() {
            let axes = self.motors.iter_mut().zip(&mut self.commands).zip(&mut self.limits);
            let mut enabled = axes.map(|((motor, command), limits)| {
                motor.enable(command, limits, (passed, self.is_returning), &mut self.notices)
            });
            if let Some(fault) = enabled.find_map(Result::err) {
                self.fail(fault, now);
                return;
            }
        }
        if self.motors.iter().all(|motor| motor.phase == Phase::On && motor.is_free(now)) {
            self.armed = now;
            self.deadman.arm(now);
            self.line.restart(&self.commands);
            self.ramps.iter_mut().for_each(Ramp::restart);
            self.hold(now);
            self.notices.notify(if self.is_returning { Notice::Returning } else { Notice::Armed });
        } else if waited >= ARM_WITHIN.max(self.cycle * ARM_CYCLES) + self.slowest_brake
            && let Some(fault) = self.motors.iter().find_map(Motor::arm_fault)
        {
            self.fail(fault, now);
        }
    }

    /// The target of incoming actions, if it is far from a motor that is not enabled yet.
    fn far_from_actions(&self, now: Stamp) -> Option<Fault> {
        let (target, tick) = &self.asked;
        if now.since(*tick) >= self.deadman.patience(self.line.period()) {
            return None;
        }
        let motor = self.far(target)?;
        let position = self.motors.get(motor)?.feedback?.q;
        Some(Fault::Far { motor, position, target: *target.get(motor)? })
    }

    /// Holds the last command, or stops as soon as it can.
    pub(super) fn hold(&mut self, now: Stamp) {
        let axes = self.targets.iter_mut().zip(&self.commands).zip(&self.motors).zip(&self.ramps).zip(&self.limits);
        for ((((target, command), motor), ramp), limits) in axes {
            let [low, high] = limits.range();
            *target = match motor.spec.mode {
                MotorMode::Velocity => 0.0,
                // A joint beyond its limits stays there.
                _ => ramp.stops_at(*command).clamp(low.min(*command), high.max(*command)),
            };
        }
        self.line.hold(&self.targets);
        self.enter(BusState::Holding, now);
    }

    /// The commands of this cycle, and whether each motor follows its own.
    fn follow(&mut self, now: Stamp, passed: Duration) {
        let axes = self.motors.iter_mut().zip(&self.limits).zip(&mut self.commands).zip(&mut self.ramps);
        let (mut first, is_led) = (None, self.line.tick().is_some());
        for (axis, (((motor, limits), command), ramp)) in axes.enumerate() {
            let (before, target) = (*command, self.line.at(axis, now));
            let wanted = match motor.spec.mode {
                _ if self.is_returning => motor.way_back(before, limits, passed),
                MotorMode::Velocity => limits.slew(before, target, passed),
                _ => ramp.next(limits, before, target, passed),
            };
            let bound = motor.bound(wanted, limits);
            // A reported position moves the command no faster than an action does.
            *command = if motor.spec.mode == MotorMode::Velocity { bound } else { limits.slew(before, bound, passed) };
            ramp.took(*command - before, passed, is_led);
            let fault = motor.strange(
                Commanded { command: *command, wanted, is_returning: self.is_returning },
                now,
                &mut self.notices,
            );
            first = first.or(fault);
        }
        if let Some(fault) = first {
            self.fail(fault, now);
        } else if self.is_returning {
            self.look_for_return(now);
        }
    }

    pub(super) fn turn_off(&mut self) {
        self.motors.iter_mut().for_each(Motor::turn_off);
    }

    pub(super) fn disable(&mut self, reason: Reason, now: Stamp) {
        self.turn_off();
        self.reason = reason;
        self.enter(BusState::Disabling, now);
    }

    /// Stops all motors, each as configured; of motors that are already stopped only the one with the fault.
    pub(super) fn fail(&mut self, fault: Fault, now: Stamp) {
        let own = fault.own();
        // The first fault is the one that is reported.
        let is_keeping = matches!(self.state, BusState::Faulted(_)) && self.is_keeping();
        for (index, (motor, command)) in self.motors.iter_mut().zip(&mut self.commands).enumerate() {
            motor.stop_at_fault(Some(index) == own, command);
        }
        if !is_keeping {
            self.enter(BusState::Faulted(fault), now);
        }
        self.report_stopped(fault);
    }

    /// Stops all motors at an emergency stop, each as configured, including those that a fault has left on. Only once
    /// per arm; motors that are disabled, or being disabled, stay so.
    pub(super) fn stop_at_emergency(&mut self, trip: Trip, now: Stamp) {
        let is_news = !matches!(self.state, BusState::Faulted(Fault::EmergencyStop(_)));
        if !(self.is_armed() || self.state == BusState::Arming || is_news && self.is_keeping()) {
            return;
        }
        for (motor, command) in self.motors.iter_mut().zip(&mut self.commands) {
            motor.stop_at_emergency(command);
        }
        self.enter(BusState::Faulted(Fault::EmergencyStop(trip)), now);
        self.report_stopped(Fault::EmergencyStop(trip));
    }

    fn report_stopped(&mut self, fault: Fault) {
        self.counts.faults += 1;
        self.notices.notify(Notice::Fault(fault));
        self.name_latched(Some(fault));
        let braked = self.bits(Motor::waits_for_brake);
        let kept = |stop| self.bits(|motor| motor.phase == Phase::Kept(stop)) & !braked;
        let [damped, held] = [Stop::Damp, Stop::Hold].map(kept);
        if damped | held | braked != 0 {
            self.notices.notify(Notice::Kept { damped, held, braked });
        }
    }

    /// Reports every latched fault once; the next arm clears them.
    pub(super) fn name_latched(&mut self, reported: Option<Fault>) {
        for (motor, latching) in self.motors.iter_mut().enumerate() {
            let Some(status) = latching.status.filter(|status| status.is_fault()) else { continue };
            if latching.named.replace(status) != Some(status) && reported != Some(Fault::Latched { motor, status }) {
                self.notices.notify(Notice::Latched { motor, status });
            }
        }
    }

    /// Is any motor still on that was stopped by a fault?
    pub(super) fn is_keeping(&self) -> bool {
        self.motors.iter().any(Motor::is_kept)
    }

    pub(super) const fn enter(&mut self, state: BusState, now: Stamp) {
        self.state = state;
        self.since = now;
    }
}
