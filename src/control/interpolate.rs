//! From targets, ten a second or so, to the commands between them, hundreds a second.
//!
//! A target is reached on a straight line from the command in force at its arrival, in the time between two
//! targets: then the next one is due. After that the target is held. The time between two targets is the
//! shorter one of the last two: a pause is none, and who is slow is known by the second.
//!
//! Invariant: what is between two targets lies between them, on every axis.

use std::time::Duration;

use crate::time::Stamp;

/// The time between two targets before there were two.
pub const FIRST_PERIOD: Duration = Duration::from_millis(100);
/// Targets that come quicker are reached in this time all the same.
const SHORTEST: Duration = Duration::from_millis(1);
/// Targets farther apart than this had a pause between them, which does not count for their rate.
const LONGEST: Duration = Duration::from_secs(1);

/// See the module's comment.
#[derive(Debug, Clone)]
pub struct Interpolator {
    from: Vec<f64>,
    to: Vec<f64>,
    begin: Stamp,
    takes: Duration,
    tick: Option<Stamp>,
    /// Between the last two targets.
    gap: Duration,
    period: Duration,
}

impl Interpolator {
    /// For so many axes, all held at 0.
    #[must_use]
    pub fn new(axes: usize) -> Self {
        Self {
            from: vec![0.0; axes],
            to: vec![0.0; axes],
            begin: Stamp(0),
            takes: Duration::ZERO,
            tick: None,
            gap: FIRST_PERIOD,
            period: FIRST_PERIOD,
        }
    }

    /// Holds `command` from now on. The time between targets is known no more.
    pub fn restart(&mut self, command: &[f64]) {
        self.hold(command);
        self.tick = None;
        (self.gap, self.period) = (FIRST_PERIOD, FIRST_PERIOD);
    }

    /// Holds `command` from now on.
    pub fn hold(&mut self, command: &[f64]) {
        for ((from, to), command) in self.from.iter_mut().zip(&mut self.to).zip(command) {
            *from = *command;
            *to = *command;
        }
        self.takes = Duration::ZERO;
    }

    /// Heads for `target`, the one of `tick`, from `command`, the one of `begin`.
    pub fn head_for(&mut self, target: &[f64], tick: Stamp, command: &[f64], begin: Stamp) {
        if let Some(apart) = self.tick.map(|last| tick.since(last)).filter(|apart| *apart <= LONGEST) {
            let gap = apart.max(SHORTEST);
            self.period = gap.min(self.gap);
            self.gap = gap;
        }
        self.tick = Some(tick);
        for ((from, to), (command, target)) in self.from.iter_mut().zip(&mut self.to).zip(command.iter().zip(target)) {
            *from = *command;
            *to = *target;
        }
        self.begin = begin;
        self.takes = self.period;
    }

    /// What to command on an axis at `now`; 0 on one that is not there.
    #[must_use]
    pub fn at(&self, axis: usize, now: Stamp) -> f64 {
        let (Some(from), Some(to)) = (self.from.get(axis), self.to.get(axis)) else { return 0.0 };
        let passed = now.since(self.begin);
        if passed >= self.takes {
            return *to;
        }
        let share = passed.as_secs_f64() / self.takes.as_secs_f64();
        // Rounding must not carry it beyond an end.
        (from + (to - from) * share).clamp(from.min(*to), from.max(*to))
    }

    /// The time between two targets: the shorter one of the last two, [`FIRST_PERIOD`] where there were fewer.
    #[must_use]
    pub const fn period(&self) -> Duration {
        self.period
    }

    /// The tick of the newest target since the last restart.
    #[must_use]
    pub const fn tick(&self) -> Option<Stamp> {
        self.tick
    }
}

#[cfg(test)]
mod tests;
