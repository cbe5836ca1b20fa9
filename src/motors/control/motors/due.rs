//! What is due in a cycle, by the state of the bus.

use std::time::Duration;

use rapid_core::action::Trip;
use rapid_core::time::Stamp;
use rapid_registry::Stop;

use super::MotorBus;
use super::fault::Fault;
use super::motor::Motor;
use super::notice::{BusState, Notice, Reason};
use crate::control::deadman::Verdict;

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
        let Some(motor) = self.motors.iter().position(|motor| motor.is_silent(now)) else { return };
        match self.state {
            BusState::Probing | BusState::Faulted(_) | BusState::Stopped => {}
            _ => self.fail(Fault::Silent { motor }, now),
        }
    }

    /// The fault that a motor reports, if any.
    pub(super) fn judge(&self, index: usize) -> Option<Fault> {
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
        self.motors.iter_mut().for_each(|motor| motor.let_go(waited, now));
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
            let mut motors = self.motors.iter_mut();
            let enabled = motors.try_for_each(|motor| motor.enable(passed, self.is_returning, &mut self.notices));
            if let Err(fault) = enabled {
                self.fail(fault, now);
                return;
            }
        }
        if self.motors.iter().all(|motor| motor.is_ready(now)) {
            self.armed = now;
            self.deadman.arm(now);
            self.line.restart(self.motors.iter().map(Motor::command));
            self.motors.iter_mut().for_each(Motor::restart);
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
        let position = self.motors.get(motor)?.position()?;
        Some(Fault::Far { motor, position, target: *target.get(motor)? })
    }

    /// Holds the last command, or stops as soon as it can.
    pub(super) fn hold(&mut self, now: Stamp) {
        self.motors.iter_mut().for_each(Motor::hold);
        self.line.hold(self.motors.iter().map(Motor::target));
        self.enter(BusState::Holding, now);
    }

    /// The commands of this cycle, and whether each motor follows its own.
    fn follow(&mut self, now: Stamp, passed: Duration) {
        let (mut first, is_led) = (None, self.line.tick().is_some());
        for (axis, motor) in self.motors.iter_mut().enumerate() {
            let target = (!self.is_returning).then(|| self.line.at(axis, now));
            // Each follows, even after one that is at fault.
            first = first.or(motor.follow(target, (now, passed), is_led, &mut self.notices));
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
        for (index, motor) in self.motors.iter_mut().enumerate() {
            motor.stop_at_fault(Some(index) == own);
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
        self.motors.iter_mut().for_each(Motor::stop_at_emergency);
        self.enter(BusState::Faulted(Fault::EmergencyStop(trip)), now);
        self.report_stopped(Fault::EmergencyStop(trip));
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
    pub(super) fn name_latched(&mut self, reported: Option<Fault>) {
        self.motors.iter_mut().for_each(|motor| motor.name_latched(reported, &mut self.notices));
    }

    /// Is any motor still on that was stopped by a fault?
    pub(super) fn is_keeping(&self) -> bool {
        self.motors.iter().any(|motor| motor.kept().is_some())
    }

    pub(super) const fn enter(&mut self, state: BusState, now: Stamp) {
        self.state = state;
        self.since = now;
    }
}
