//! When the samples of a simulated device are due.

use std::time::Duration;

use crate::time::Stamp;

/// Points in time `1 / rate` apart, from the scenario's beginning; computed from the point's number
/// so that a period that is no whole number of ns does not drift.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grid {
    pub begun: Stamp,
    /// Points a second, at least 1.
    pub rate: u64,
}

impl Grid {
    pub(super) fn stamp(self, point: u64) -> Stamp {
        let after = u128::from(point) * 1_000_000_000 / u128::from(self.rate);
        Stamp(self.begun.0.saturating_add(u64::try_from(after).unwrap_or(u64::MAX)))
    }

    /// The first point later than `now`.
    pub(super) fn first_after(self, now: Stamp) -> u64 {
        let Some(elapsed) = now.0.checked_sub(self.begun.0) else { return 0 };
        let estimate = u128::from(elapsed) * u128::from(self.rate) / 1_000_000_000;
        let mut point = u64::try_from(estimate).unwrap_or(u64::MAX);
        // The rounding in `stamp` puts a point up to 1 ns early: the estimate is at most one short.
        while self.stamp(point) <= now && point < u64::MAX {
            point += 1;
        }
        point
    }

    pub(super) fn period(self) -> Duration {
        Duration::from_nanos(1_000_000_000 / self.rate)
    }
}
