//! All streams, recording or not: the position of each, the gaps in its sequence numbers, and the recent masks.

use std::collections::VecDeque;

use rapid_bus::TopicId;
use rapid_core::mask::Bits;
use rapid_core::modality::MAX_MODALITIES;
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;

use super::open_episode::OpenEpisode;

/// What is kept of all samples, recording or not.
pub(super) struct Streams {
    /// The last publications of the mask.
    pub(super) masks: MaskHistory,
    /// The last sample of each modality.
    last: [Option<Last>; MAX_MODALITIES],
    last_mask: Option<Last>,
    last_action: Option<Last>,
}

impl Streams {
    pub(super) fn new() -> Self {
        Self { masks: MaskHistory::new(), last: [None; MAX_MODALITIES], last_mask: None, last_action: None }
    }

    /// Takes a sample, for `open` too if there is one.
    pub(super) fn take(
        &mut self,
        open: Option<&mut OpenEpisode>,
        topic: TopicId,
        header: &SampleHeader,
        payload: &[u8],
    ) {
        match topic {
            TopicId::Modality(id) => {
                let now = Last { seq: header.seq, lost: header.lost, captured: Stamp(header.capture_ns) };
                let hole = self.last.get_mut(id.index()).and_then(|last| last.replace(now)?.hole(now));
                if let Some(open) = open {
                    open.sample(id, header, payload, hole);
                }
            }
            // The frames of an episode are its own: they also know samples that were in transit at a tick.
            TopicId::Observation => {}
            TopicId::Action => {
                let now = Last { seq: header.seq, lost: header.lost, captured: Stamp(header.capture_ns) };
                let hole = self.last_action.replace(now).and_then(|last| last.hole(now));
                if let Some(open) = open {
                    open.action(header, payload, hole);
                }
            }
            TopicId::Mask => {
                let Some((bits, sequence)) = Bits::of_payload(payload) else { return };
                let now = Last { seq: sequence, lost: 0, captured: Stamp(header.capture_ns) };
                let hole = self.last_mask.replace(now).and_then(|last| last.hole(now));
                self.masks.push(header, bits, sequence);
                if let Some(open) = open {
                    open.mask(header, bits, sequence, hole);
                }
            }
        }
    }
}

/// Publications of the mask remembered: 16 s at 500 Hz, more than any queue of it holds.
const MASKS: usize = 8192;

/// The last publications of the mask, in the order of publication.
#[derive(Debug)]
pub(super) struct MaskHistory(VecDeque<(SampleHeader, Bits, u64)>);

impl MaskHistory {
    pub(super) fn new() -> Self {
        Self(VecDeque::with_capacity(MASKS))
    }

    pub(super) fn push(&mut self, header: &SampleHeader, bits: impl Into<Bits>, sequence: u64) {
        if self.0.len() == MASKS {
            self.0.pop_front();
        }
        self.0.push_back((*header, bits.into(), sequence));
    }

    /// The publication in force at `stamp`: the last one at or before it.
    pub(super) fn at(&self, stamp: Stamp) -> Option<&(SampleHeader, Bits, u64)> {
        self.0.iter().rev().find(|(header, ..)| header.capture_ns <= stamp.0)
    }
}

/// The numbers of a sample that show whether others are missing between it and the next.
#[derive(Debug, Clone, Copy)]
struct Last {
    /// Its number.
    seq: u64,
    /// Samples its device lost up to it.
    lost: u64,
    /// When it was captured.
    captured: Stamp,
}

impl Last {
    /// What is missing between this sample and the next one. A number below the expected one is a
    /// restarted publisher: nothing is known to be missing.
    fn hole(self, next: Self) -> Option<Hole> {
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
