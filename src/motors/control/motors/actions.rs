//! Actions: which of them are followed, and what lies between one and the next.
//!
//! Invariant: an action is followed only if its tick is after the arm, after the ticks of all earlier actions, and no
//! older than the deadman allows.
//! Invariant: the first one after an arm is near the position of every joint; otherwise the arm or the action is refused.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::DamiaoSpec;

use super::notice::Refusal;
use super::notices::Seldom;
use super::schedule;
use crate::control::deadman::{Deadman, Verdict};
use crate::control::interpolate::Interpolator;

/// Actions may be this far in the future: the clock is the same, but ticks are rounded.
const EARLY: Duration = Duration::from_millis(100);

#[derive(Debug)]
pub(super) struct Actions {
    /// The newest one, followed or not, and its tick.
    newest: (Vec<f64>, Stamp),
    line: Interpolator,
    deadman: Deadman,
    armed: Stamp,
    /// Why the last one was refused, if it was.
    refusing: Option<Refusal>,
    /// Refused actions are reported once a second at most.
    refused: Seldom,
}

impl Actions {
    pub(super) fn new(spec: &DamiaoSpec, now: Stamp) -> Self {
        let axes = spec.motors.len();
        Self {
            newest: (vec![0.0; axes], Stamp(0)),
            line: Interpolator::new(axes),
            deadman: Deadman::new(spec.deadman, spec.disable_after, schedule::cycle(spec)),
            armed: now,
            refusing: None,
            refused: Seldom::default(),
        }
    }

    /// The motors are armed, with these commands: no action counts that came before.
    pub(super) fn arm(&mut self, commands: impl IntoIterator<Item = f64>, now: Stamp) {
        self.armed = now;
        self.deadman.arm(now);
        self.line.restart(commands);
    }

    /// The motors are busy otherwise: the deadman waits from now on.
    pub(super) const fn postpone(&mut self, now: Stamp) {
        self.deadman.arm(now);
    }

    /// No action is followed until the next one: these targets are held.
    pub(super) fn hold(&mut self, targets: impl IntoIterator<Item = f64>) {
        self.line.hold(targets);
    }

    /// Follows the action of `tick`: from `commands`, in force at `begin`, to `targets`.
    pub(super) fn follow(
        &mut self,
        targets: impl IntoIterator<Item = f64>,
        tick: Stamp,
        commands: impl IntoIterator<Item = f64>,
        (begin, now): (Stamp, Stamp),
    ) {
        self.line.head_for(targets, tick, commands, begin);
        self.deadman.feed(tick.min(now));
    }

    /// The target of an axis at `now`, between the last action and this one.
    pub(super) fn target(&self, axis: usize, now: Stamp) -> f64 {
        self.line.at(axis, now)
    }

    /// Was an action followed since the arm?
    pub(super) const fn is_led(&self) -> bool {
        self.line.tick().is_some()
    }

    /// What the deadman says.
    pub(super) fn verdict(&self, now: Stamp) -> Verdict {
        self.deadman.verdict(now, self.line.period())
    }

    /// The newest action, followed or not, unless it is too old.
    pub(super) fn newest(&self, now: Stamp) -> Option<&[f64]> {
        let (target, tick) = &self.newest;
        (!self.is_old(*tick, now)).then_some(target)
    }

    /// Is an action of this tick after the arm, and after all earlier ones?
    pub(super) fn is_next(&self, tick: Stamp) -> bool {
        tick >= self.armed && self.line.tick().is_none_or(|last| tick > last)
    }

    /// Why an action is refused, if it is. `is_returning`: armed motors are driven back; `far`: the first armed motor that is
    /// too far from it to begin with.
    pub(super) fn refusal(
        &self,
        target: &[f64],
        (tick, now): (Stamp, Stamp),
        is_returning: bool,
        far: impl FnOnce() -> Option<usize>,
    ) -> Option<Refusal> {
        if target.len() != self.newest.0.len() {
            Some(Refusal::Length)
        } else if !target.iter().all(|value| value.is_finite()) {
            Some(Refusal::NotFinite)
        } else if tick > now.after(EARLY) {
            Some(Refusal::Early)
        } else if is_returning {
            Some(Refusal::Returning)
        } else if self.is_old(tick, now) {
            Some(Refusal::Old)
        } else if tick >= self.armed && !self.is_led() {
            far().map(|motor| Refusal::Far { motor })
        } else {
            None
        }
    }

    /// Takes an action that is refused. Is that to be reported?
    pub(super) fn refuse(&mut self, refusal: Refusal, now: Stamp) -> bool {
        let is_same = self.refusing.replace(refusal) == Some(refusal);
        // Another reason begins a new spell.
        self.refused.update(is_same, now) || self.refused.update(true, now)
    }

    /// Takes an action that is not refused.
    pub(super) fn accept(&mut self, target: &[f64], tick: Stamp, now: Stamp) {
        self.refusing = None;
        self.refused.update(false, now);
        if tick >= self.newest.1 {
            self.newest.0.copy_from_slice(target);
            self.newest.1 = tick;
        }
    }

    fn is_old(&self, tick: Stamp, now: Stamp) -> bool {
        now.since(tick) >= self.deadman.patience(self.line.period())
    }
}
