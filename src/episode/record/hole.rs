//! Gaps in the sequence numbers of a stream: how many samples are missing, who lost them, and when.

use rapid_core::time::Stamp;

/// The numbers of a sample that show whether others are missing between it and the next.
#[derive(Debug, Clone, Copy)]
pub(super) struct Last {
    pub(super) seq: u64,
    /// Samples its device lost up to it.
    pub(super) lost: u64,
    pub(super) captured: Stamp,
}

impl Last {
    /// What is missing between this sample and the next one. A number below the expected one is a
    /// restarted publisher: nothing is known to be missing.
    pub(super) fn hole(self, next: Self) -> Option<Hole> {
        let missing = next.seq.checked_sub(self.seq)?.checked_sub(1).filter(|missing| *missing > 0)?;
        let lost = next.lost.saturating_sub(self.lost).min(missing);
        Some(Hole { after: self.captured, before: next.captured, lost, dropped: missing - lost })
    }
}

/// Samples missing between two that came: who lost them, and when they were captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Hole {
    /// Capture of the sample before the hole.
    pub(super) after: Stamp,
    /// Capture of the sample behind the hole.
    pub(super) before: Stamp,
    /// Of the missing ones, those that the device lost.
    pub(super) lost: u64,
    /// Of the missing ones, those lost in transit.
    pub(super) dropped: u64,
}

impl Hole {
    /// How many of `count` samples that are missing here were captured before `moment`, if they lie
    /// at even distances.
    pub(super) fn before(&self, moment: Stamp, count: u64) -> u64 {
        let span = u128::from(self.before.0.saturating_sub(self.after.0));
        let until = u128::from(moment.0.saturating_sub(self.after.0));
        if span == 0 {
            return if moment > self.before { count } else { 0 };
        }
        if until >= span {
            return count;
        }
        // Sample k of n lies at k / (n + 1) of the span. At most 2^64 * 2^64 - 2^64: no overflow.
        let before = (until * (u128::from(count) + 1)).div_ceil(span).saturating_sub(1);
        u64::try_from(before).unwrap_or(u64::MAX).min(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn last(seq: u64, lost: u64) -> Last {
        Last { seq, lost, captured: Stamp(seq * 10) }
    }

    #[test]
    fn a_gap_is_attributed_to_the_device_as_far_as_it_reports_it() {
        let between = |a: Last, b: Last| a.hole(b).map(|hole| (hole.lost, hole.dropped));
        assert_eq!(between(last(4, 1), last(5, 1)), None);
        assert_eq!(between(last(4, 1), last(9, 1)), Some((0, 4)));
        assert_eq!(between(last(4, 1), last(9, 3)), Some((2, 2)));
        assert_eq!(between(last(4, 1), last(9, 5)), Some((4, 0)));
        // A restarted publisher, a repeated number, a nonsensical one.
        assert_eq!(between(last(4, 1), last(0, 0)), None);
        assert_eq!(between(last(4, 1), last(4, 1)), None);
        assert_eq!(between(last(4, 0), last(u64::MAX / 10, u64::MAX)), Some((u64::MAX / 10 - 5, 0)));
        assert_eq!(between(last(9, 7), last(12, 2)), Some((0, 2)));
    }

    #[test]
    fn missing_samples_are_evenly_spaced() {
        let hole = Hole { after: Stamp(100), before: Stamp(200), lost: 0, dropped: 9 };
        let before = |moment| hole.before(Stamp(moment), 9);
        assert_eq!([0, 100, 110, 111, 120, 190, 191, 199, 200, 999].map(before), [0, 0, 0, 1, 1, 8, 9, 9, 9, 9]);
        assert_eq!(
            Hole { after: Stamp(0), before: Stamp(u64::MAX), ..hole }.before(Stamp(u64::MAX - 1), u64::MAX),
            u64::MAX - 1
        );
        // Captured together, or backwards: at the sample that came.
        let hole = Hole { after: Stamp(300), ..hole };
        assert_eq!([200, 201, 400].map(|moment| hole.before(Stamp(moment), 9)), [0, 9, 9]);
    }
}
