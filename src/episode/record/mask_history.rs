//! The recent masks.

use std::collections::VecDeque;

use rapid_core::mask::Bits;
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;

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
