//! Distributions: of times, in a fixed amount of memory.

use hdrhistogram::Histogram;
use serde::Serialize;

/// Longest time told apart, microseconds: an hour.
const LONGEST_US: u64 = 3_600_000_000;
/// Two digits: values are off by one part in a hundred at most, and a distribution takes 13 KiB.
const DIGITS: u8 = 2;

/// Times of one kind.
#[derive(Debug)]
pub(in crate::record) struct Tally {
    /// `None` only if the bounds above made no sense.
    times: Option<Histogram<u32>>,
    longest_ns: u64,
    count: u64,
}

/// Median, a high percentile and the longest of some times, ms.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Longest.
    pub max: f64,
}

impl Tally {
    pub(in crate::record) fn new() -> Self {
        Self { times: Histogram::new_with_bounds(1, LONGEST_US, DIGITS).ok(), longest_ns: 0, count: 0 }
    }

    pub(in crate::record) fn push(&mut self, time_ns: u64) {
        self.longest_ns = self.longest_ns.max(time_ns);
        self.count += 1;
        if let Some(times) = &mut self.times {
            times.saturating_record(time_ns / 1000);
        }
    }

    /// What the times come to; `None` without any.
    pub(in crate::record) fn spread(&self) -> Option<Spread> {
        let times = self.times.as_ref().filter(|_| self.count > 0)?;
        let max = self.longest_ns as f64 / 1e6;
        // The histogram answers with the upper end of a cell.
        let at = |quantile| (times.value_at_quantile(quantile) as f64 / 1e3).min(max);
        Some(Spread { p50: at(0.5), p95: at(0.95), p99: at(0.99), max })
    }
}
