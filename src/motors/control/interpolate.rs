//! From about ten targets a second to hundreds of commands a second between them.
//!
//! The command moves on a straight line from its value at the arrival of a target to that target, within one target
//! period: then the next target is due. After that the target is held. The period is the shorter of the last two
//! intervals between targets: a pause does not lengthen it, and a slow publisher is recognised by its second target.
//!
//! Invariant: a command between two targets lies between their values, on every axis.

use std::time::Duration;

use rapid_core::time::Stamp;

/// The target period before there were two targets.
pub const FIRST_PERIOD: Duration = Duration::from_millis(100);
/// The shortest target period: faster targets are reached in this time too.
const SHORTEST: Duration = Duration::from_millis(1);
/// A longer interval between targets is a pause and does not count for the period.
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
    /// For this many axes, all held at 0.
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

    /// Holds `commands` from now on and forgets the target period.
    pub fn restart(&mut self, commands: impl IntoIterator<Item = f64>) {
        self.hold(commands);
        self.tick = None;
        (self.gap, self.period) = (FIRST_PERIOD, FIRST_PERIOD);
    }

    /// Holds `commands` from now on.
    pub fn hold(&mut self, commands: impl IntoIterator<Item = f64>) {
        for ((from, to), command) in self.from.iter_mut().zip(&mut self.to).zip(commands) {
            (*from, *to) = (command, command);
        }
        self.takes = Duration::ZERO;
    }

    /// Moves from `commands`, in force at `begin`, towards `targets`, the action of `tick`.
    pub fn head_for(
        &mut self,
        targets: impl IntoIterator<Item = f64>,
        tick: Stamp,
        commands: impl IntoIterator<Item = f64>,
        begin: Stamp,
    ) {
        if let Some(apart) = self.tick.map(|last| tick.since(last)).filter(|apart| *apart <= LONGEST) {
            let gap = apart.max(SHORTEST);
            self.period = gap.min(self.gap);
            self.gap = gap;
        }
        self.tick = Some(tick);
        let ends = self.from.iter_mut().zip(&mut self.to);
        for ((from, to), (command, target)) in ends.zip(commands.into_iter().zip(targets)) {
            (*from, *to) = (command, target);
        }
        self.begin = begin;
        self.takes = self.period;
    }

    /// The command of an axis at `now`; 0 for an axis that does not exist.
    pub fn at(&self, axis: usize, now: Stamp) -> f64 {
        let (Some(from), Some(to)) = (self.from.get(axis), self.to.get(axis)) else { return 0.0 };
        let passed = now.since(self.begin);
        if passed >= self.takes {
            return *to;
        }
        let share = passed.as_secs_f64() / self.takes.as_secs_f64();
        // Rounding must not carry the command beyond an end.
        (from + (to - from) * share).clamp(from.min(*to), from.max(*to))
    }

    /// The target period: the shorter of the last two intervals, [`FIRST_PERIOD`] with fewer.
    pub const fn period(&self) -> Duration {
        self.period
    }

    /// The tick of the newest target since the last restart.
    pub const fn tick(&self) -> Option<Stamp> {
        self.tick
    }
}

#[cfg(test)]
mod tests;
