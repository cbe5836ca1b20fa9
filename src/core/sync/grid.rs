//! The observation grid: the moments at which observations are taken.
//!
//! Invariant: tick `k` lies at the grid's beginning plus `k / rate`, rounded down to a whole ns once:
//! the error never exceeds 1 ns, however long the grid runs.

use crate::time::Stamp;

/// ns a second times the micro-hertz of one hertz.
const MICROHERTZ_NS: u128 = 1_000_000_000 * 1_000_000;

/// See the module's comment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    begin: Stamp,
    microhertz: u64,
}

impl Grid {
    /// A grid from `begin` on, tick 0 being `begin` itself. The rate is taken as a whole number of
    /// micro-hertz, at least one: 29.97 means exactly that.
    pub fn new(begin: Stamp, hz: f64) -> Self {
        // A float cast saturates, and NaN becomes 0.
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let microhertz = ((hz * 1e6).round() as u64).max(1);
        Self { begin, microhertz }
    }

    /// The moment of tick `index`, at most the end of time.
    pub fn tick(&self, index: u64) -> Stamp {
        // Below 2^64 * 2^50: no overflow in 128 bits.
        let offset = u128::from(index) * MICROHERTZ_NS / u128::from(self.microhertz);
        Stamp(u64::try_from(u128::from(self.begin.0) + offset).unwrap_or(u64::MAX))
    }

    /// How many ticks lie before `end`.
    pub fn ticks_before(&self, end: Stamp) -> u64 {
        let span = u128::from(end.0.saturating_sub(self.begin.0));
        // The smallest k with floor(k * N / m) >= span is ceil(span * m / N).
        let count = (span * u128::from(self.microhertz)).div_ceil(MICROHERTZ_NS);
        u64::try_from(count).unwrap_or(u64::MAX)
    }
}
