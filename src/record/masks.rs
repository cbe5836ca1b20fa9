//! The mask as it was published, recording or not.

use std::collections::VecDeque;

use crate::mask::PhysicalMask;
use crate::sample::SampleHeader;
use crate::time::Stamp;

/// Publications of the mask remembered: 16 s at 500 Hz, more than any queue of it holds.
const MASKS: usize = 8192;

/// The last publications of the mask, in the order of publication.
#[derive(Debug)]
pub(super) struct MaskHistory(VecDeque<(SampleHeader, PhysicalMask, u64)>);

impl MaskHistory {
    pub(super) fn new() -> Self {
        Self(VecDeque::with_capacity(MASKS))
    }

    pub(super) fn push(&mut self, header: &SampleHeader, mask: PhysicalMask, sequence: u64) {
        if self.0.len() == MASKS {
            self.0.pop_front();
        }
        self.0.push_back((*header, mask, sequence));
    }

    /// The publication in force at `stamp`: the last one at or before it.
    pub(super) fn at(&self, stamp: Stamp) -> Option<&(SampleHeader, PhysicalMask, u64)> {
        self.0.iter().rev().find(|(header, ..)| header.capture_ns <= stamp.0)
    }
}
