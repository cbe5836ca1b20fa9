//! What thread `control` counts: how punctual its cycles were, and what went wrong.

use std::fmt;
use std::time::Duration;

use hdrhistogram::Histogram;
use rapid_core::text;
use rapid_core::time::nanoseconds;
use rapid_motors::control::motors::Counts;

/// Longest time the statistics distinguish, ns.
const LONGEST: u64 = 10_000_000_000;

/// How punctual the thread's cycles were.
#[derive(Debug, Clone, PartialEq)]
pub struct Punctuality {
    /// Cycles of the grid: early ones are not counted.
    pub cycles: u64,
    /// Cycles that began early, for a fresh action or an order to stop.
    pub early: u64,
    /// How late the cycles of the grid began, ms: the median, all but one in a thousand, all.
    pub late_ms: [f64; 3],
    /// Actions that were followed by a command.
    pub actions: u64,
    /// From their tick to the first command after it, ms: the median, all but one in a hundred.
    pub wire_ms: [f64; 2],
}

impl fmt::Display for Punctuality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p999, max] = self.late_ms;
        write!(f, "{} cycles of thread `control`: late by p50 {p50:.3} p99.9 {p999:.3} max {max:.3} ms", self.cycles)?;
        write!(f, ", {} more begun early", self.early)?;
        let [p50, p99] = self.wire_ms;
        match self.actions {
            0 => Ok(()),
            actions => write!(f, "; {actions} actions on the wire p50 {p50:.2} p99 {p99:.2} ms after their tick"),
        }
    }
}

#[derive(Debug)]
pub(super) struct LoopStatistics {
    /// How late cycles began, ns.
    lateness: Histogram<u64>,
    /// Cycles that began early.
    pub(super) early: u64,
    /// From the tick of an action to the first command after it, ns.
    latency: Histogram<u64>,
    /// Frames that were lost before they could be read.
    pub(super) lost_frames: u64,
    /// Frames for which there was no room to the bus.
    pub(super) full: u64,
    /// Frames that the adapter accepted and reported as not sent.
    pub(super) unsent: u64,
    /// Samples that were not read in time.
    pub(super) lost_samples: u64,
}

impl LoopStatistics {
    pub(super) fn new() -> Self {
        let (lateness, latency) = (histogram(), histogram());
        Self { lateness, early: 0, latency, lost_frames: 0, full: 0, unsent: 0, lost_samples: 0 }
    }

    /// Counts a cycle of the grid that began this late.
    pub(super) fn late(&mut self, late: Duration) {
        self.lateness.saturating_record(nanoseconds(late));
    }

    /// Counts an action of this age at the first command after it.
    pub(super) fn on_the_wire(&mut self, ns: u64) {
        self.latency.saturating_record(ns);
    }

    pub(super) fn punctuality(&self) -> Punctuality {
        let ms = |histogram: &Histogram<u64>, quantile| histogram.value_at_quantile(quantile) as f64 / 1e6;
        Punctuality {
            cycles: self.lateness.len(),
            early: self.early,
            late_ms: [0.5, 0.999, 1.0].map(|quantile| ms(&self.lateness, quantile)),
            actions: self.latency.len(),
            wire_ms: [0.5, 0.99].map(|quantile| ms(&self.latency, quantile)),
        }
    }

    /// What went wrong, with what the motors' bus counted, for people; `None` if nothing did.
    pub(super) fn mishaps(&self, bus: &Counts) -> Option<String> {
        let all = [
            (bus.faults, "fault", ""),
            (bus.refused, "action", " refused"),
            (bus.clamped, "value", " beyond the limits"),
            (self.full, "frame", " without room in the queue to the bus"),
            (self.unsent, "frame", " not sent by the adapter"),
            (self.lost_frames, "frame", " lost before being read"),
            (bus.strangers, "frame", " of no motor of the entry"),
            (self.lost_samples, "sample", " not read in time"),
            (bus.lost_notices, "notice", " not read in time"),
        ];
        let counted = all.iter().filter(|(count, ..)| *count > 0);
        let counted = counted.map(|(count, what, how)| format!("{}{how}", text::counted(*count, what)));
        let counted = counted.collect::<Vec<_>>().join(", ");
        (!counted.is_empty()).then_some(counted)
    }
}

fn histogram() -> Histogram<u64> {
    // Its bounds are in range: the highest is more than twice the lowest, the digits at most 5.
    #[expect(clippy::expect_used, reason = "constants, checked by a test")]
    Histogram::new_with_bounds(1, LONGEST, 2).expect("bounds of a histogram")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bounds_of_the_histogram_are_valid() {
        let mut statistics = LoopStatistics::new();
        statistics.late(Duration::MAX);
        assert_eq!(statistics.punctuality().cycles, 1);
    }

    #[test]
    fn counts_of_zero_are_not_reported() {
        let mut statistics = LoopStatistics::new();
        assert_eq!(statistics.mishaps(&Counts::default()), None);
        statistics.full = 3;
        let bus = Counts { actions: 9, faults: 1, ..Counts::default() };
        assert_eq!(statistics.mishaps(&bus).as_deref(), Some("1 fault, 3 frames without room in the queue to the bus"));
    }
}
