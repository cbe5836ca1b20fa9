//! What is due in a cycle, by the state of the bus.

use std::time::Duration;

use super::MotorBus;
use super::motor::{Motor, Phase};
use super::notice::{BusState, Fault, Notice, Reason};
use crate::control::deadman::Verdict;
use crate::registry::MotorMode;
use crate::time::Stamp;

/// An arm that took longer has failed...
const ARM_WITHIN: Duration = Duration::from_secs(1);
/// ...and more cycles: to read a parameter takes one, to set it another, and answers may take several.
const ARM_CYCLES: u32 = 40;
/// Motors that have not told their parameters after this are told of.
const PROBE_WITHIN: Duration = Duration::from_secs(1);
/// Motors that answer have to turn off within this.
const DISABLE_WITHIN: Duration = Duration::from_millis(500);

impl MotorBus {
    /// Looks after motors that do not answer.
    pub(super) fn listen(&mut self, now: Stamp) {
        let silent = |motor: &Motor| motor.unanswered(now) >= self.silent_after;
        let Some(motor) = self.motors.iter().position(silent) else { return };
        match self.state {
            BusState::Probing | BusState::Faulted(_) | BusState::Stopped => {}
            _ => self.fail(Fault::Silent { motor }, now),
        }
    }

    /// Is something wrong with a motor, by what it says?
    pub(super) fn judge(&self, index: usize) -> Option<Fault> {
        let motor = self.motors.get(index)?;
        let status = || motor.status_fault();
        match (self.state, motor.phase) {
            (BusState::Disarmed | BusState::Following | BusState::Holding, _)
            | (BusState::Arming, Phase::Enabling | Phase::On) => status().or_else(|| motor.heat_fault()),
            (BusState::Arming, _) => motor.heat_fault(),
            _ => None,
        }
    }

    pub(super) fn advance(&mut self, now: Stamp, passed: Duration) {
        let waited = now.since(self.since);
        match self.state {
            BusState::Probing => self.probe(waited, now),
            BusState::Arming => self.enable(waited, now),
            BusState::Following | BusState::Holding => match self.deadman.look(now, self.line.period()) {
                Verdict::Disable => self.disable(Reason::Deadman, now),
                Verdict::Hold if self.state == BusState::Following => {
                    self.hold(now);
                    self.notices.tell(Notice::Holding);
                    self.follow(now, passed);
                }
                Verdict::Hold | Verdict::Follow => self.follow(now, passed),
            },
            BusState::Disabling => match self.motors.iter().position(|motor| !motor.is_off()) {
                None => {
                    self.enter(BusState::Disarmed, now);
                    self.notices.tell(Notice::Disabled(self.reason));
                }
                Some(motor) if waited >= DISABLE_WITHIN => self.fail(Fault::NotDisabled { motor }, now),
                Some(_) => {}
            },
            // It says the same again.
            BusState::Faulted(Fault::Unusable { .. }) | BusState::Stopped => {}
            BusState::Disarmed | BusState::Faulted(_) => self.ask_late(now),
        }
    }

    /// Asks motors whose ranges are not known, though the bus is past its probing: they had no power then, or
    /// an arm came between.
    fn ask_late(&mut self, now: Stamp) {
        for motor in &mut self.motors {
            let is_silent = motor.unanswered(now) >= self.silent_after;
            match motor.phase {
                Phase::Off { .. } if motor.ranges.is_none() && motor.is_off() && !is_silent => motor.probe(),
                // It may hear without being heard.
                Phase::Asked { .. } | Phase::Probed if is_silent => motor.turn_off(),
                _ => {}
            }
        }
    }

    /// Asks motors that are off for their parameters. Says whether all have told them.
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
            self.notices.tell(Notice::Ready);
        } else if waited >= PROBE_WITHIN {
            let missed = |motor: &Motor| motor.phase != Phase::Probed && !motor.missed;
            while let Some(motor) = self.motors.iter().position(missed) {
                if let Some(missed) = self.motors.get_mut(motor) {
                    missed.missed = true;
                }
                self.notices.tell(Notice::Unanswered { motor });
            }
        }
    }

    fn enable(&mut self, waited: Duration, now: Stamp) {
        if self.ask() {
            for ((motor, command), limits) in self.motors.iter_mut().zip(&mut self.commands).zip(&mut self.limits) {
                motor.enable(command, limits);
            }
        }
        if self.motors.iter().all(|motor| motor.phase == Phase::On) {
            self.armed = now;
            self.deadman.arm(now);
            self.line.restart(&self.commands);
            self.hold(now);
            self.notices.tell(Notice::Armed);
        } else if waited >= ARM_WITHIN.max(self.cycle * ARM_CYCLES)
            && let Some(fault) = self.motors.iter().find_map(Motor::arm_fault)
        {
            self.fail(fault, now);
        }
    }

    /// Stays where the last command was.
    fn hold(&mut self, now: Stamp) {
        for ((target, command), motor) in self.targets.iter_mut().zip(&self.commands).zip(&self.motors) {
            *target = if motor.spec.mode == MotorMode::Velocity { 0.0 } else { *command };
        }
        self.line.hold(&self.targets);
        self.enter(BusState::Holding, now);
    }

    /// The commands of this cycle.
    fn follow(&mut self, now: Stamp, passed: Duration) {
        let axes = self.motors.iter().zip(&self.limits).zip(&mut self.commands);
        for (axis, ((motor, limits), command)) in axes.enumerate() {
            *command = motor.bound(limits.slew(*command, self.line.at(axis, now), passed), limits);
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

    pub(super) fn fail(&mut self, fault: Fault, now: Stamp) {
        self.turn_off();
        self.enter(BusState::Faulted(fault), now);
        self.counts.faults += 1;
        self.notices.tell(Notice::Fault(fault));
    }

    pub(super) const fn enter(&mut self, state: BusState, now: Stamp) {
        self.state = state;
        self.since = now;
    }
}
