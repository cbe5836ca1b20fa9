//! When a bus of motors has had its cycles, and whose frames come first in the next.
//!
//! Invariant: a pause between cycles of [`stalled_after`] or more is a fault, which ends an arm: what the motors did
//! meanwhile is unknown.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::DamiaoSpec;

use super::fault::Fault;

/// A step that is later than this many cycles moves no farther than after this many.
const LATE_CYCLES: u32 = 2;
/// A program that misses this many cycles has not stalled yet.
const SLOW_CYCLES: u32 = 3;

/// From one cycle of the motors of an entry to the next.
pub(super) fn cycle(spec: &DamiaoSpec) -> Duration {
    Duration::from_secs(1) / spec.hz.max(1)
}

/// Without a cycle for this long the program that commands the motors of an entry counts as dead: some time before the
/// motors' own limit, so that they stop as configured.
pub fn stalled_after(spec: &DamiaoSpec) -> Duration {
    (spec.timeout * 3 / 4).max(cycle(spec) * SLOW_CYCLES)
}

#[derive(Debug)]
pub(super) struct Schedule {
    cycle: Duration,
    stalled_after: Duration,
    /// When the last cycle began.
    stepped: Option<Stamp>,
    /// The motor whose frames are sent first; it rotates, so that a full queue does not always hit the same motor.
    first: usize,
}

impl Schedule {
    pub(super) fn new(spec: &DamiaoSpec) -> Self {
        Self { cycle: cycle(spec), stalled_after: stalled_after(spec), stepped: None, first: 0 }
    }

    /// A pause that has become too long.
    pub(super) fn stall(&self, now: Stamp) -> Option<Fault> {
        let after = self.stepped.map_or(Duration::ZERO, |last| now.since(last));
        (after >= self.stalled_after).then_some(Fault::Stalled { after })
    }

    /// A cycle begins. Returns for how long its commands move on.
    pub(super) fn begin(&mut self, now: Stamp) -> Duration {
        let last = self.stepped.replace(now);
        last.map_or(self.cycle, |last| now.since(last)).min(self.cycle * LATE_CYCLES)
    }

    /// Since when the commands are in force, to begin a line with: the next cycle then already moves.
    pub(super) fn in_force(&self, now: Stamp) -> Stamp {
        self.stepped.map_or(now, |last| last.max(now.before(self.cycle * LATE_CYCLES)))
    }

    /// Which motors are sent their frames, one after the other.
    pub(super) fn turn(&mut self, motors: usize) -> impl Iterator<Item = usize> + use<> {
        let first = self.first;
        self.first = if first + 1 < motors { first + 1 } else { 0 };
        (first..motors).chain(0..first)
    }
}
