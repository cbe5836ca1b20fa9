//! What was found of the pictures of a run: each is walked once, by the first that needs to know, and the others look it up.
//!
//! Invariant: wait-free; an entry is written as a whole, and one that is not of the sample in question says nothing.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::modality::{MAX_MODALITIES, ModalityId};
use crate::sample::SampleHeader;

/// Newest pictures of a modality that are remembered: a second of a fast camera, far more than readers lie apart.
const REMEMBERED: usize = 128;
/// Bits of a side, at most 8192.
const SIDE_BITS: u32 = 14;

/// Sides and values of a pixel of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PictureShape {
    /// Pixels per row, below 16,384.
    pub width: u16,
    /// Rows, below 16,384.
    pub height: u16,
    /// Values of a pixel, below 8; 0 in a picture that is not whole.
    pub components: u8,
}

/// See the module's comment.
#[derive(Debug)]
pub struct WalkedPictures {
    /// Of each modality and remembered place: 33 bits that identify the sample, then the shape.
    entries: Box<[AtomicU64]>,
}

impl Default for WalkedPictures {
    fn default() -> Self {
        Self { entries: (0..MAX_MODALITIES * REMEMBERED).map(|_| AtomicU64::new(0)).collect() }
    }
}

impl WalkedPictures {
    /// The shape of a picture; `Some(None)` if it is not whole, `None` if it was not walked or is too old.
    pub fn get(&self, id: ModalityId, header: &SampleHeader) -> Option<Option<PictureShape>> {
        let entry = self.entry(id, header)?.load(Ordering::Relaxed);
        if entry >> (2 * SIDE_BITS + 3) != key(header) {
            return None;
        }
        let side = |shift: u32| u16::try_from(entry >> shift & ((1 << SIDE_BITS) - 1)).unwrap_or_default();
        let components = u8::try_from(entry & 7).unwrap_or_default();
        let shape = PictureShape { width: side(SIDE_BITS + 3), height: side(3), components };
        Some((components > 0).then_some(shape))
    }

    /// Remembers what was found.
    pub fn set(&self, id: ModalityId, header: &SampleHeader, shape: Option<PictureShape>) {
        let Some(entry) = self.entry(id, header) else { return };
        let found = shape.map_or(0, |shape| {
            u64::from(shape.width) << (SIDE_BITS + 3) | u64::from(shape.height) << 3 | u64::from(shape.components & 7)
        });
        entry.store(key(header) << (2 * SIDE_BITS + 3) | found, Ordering::Relaxed);
    }

    fn entry(&self, id: ModalityId, header: &SampleHeader) -> Option<&AtomicU64> {
        let place = usize::try_from(header.seq % REMEMBERED as u64).unwrap_or_default();
        self.entries.get(id.index() * REMEMBERED + place)
    }
}

/// Identifies a sample among those with the same place: never 0, which an entry has at first.
fn key(header: &SampleHeader) -> u64 {
    let mixed = (header.seq ^ header.capture_ns.rotate_left(20) ^ u64::from(header.epoch) << 50)
        .wrapping_mul(0x9e37_79b9_7f4a_7c15);
    (mixed >> (2 * SIDE_BITS + 3)) | 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_sample_that_was_walked_is_found() {
        let walked = WalkedPictures::default();
        let ids = [0, 63].map(|bit| ModalityId::new(bit).expect("a bit"));
        let header = |seq: u64| SampleHeader { seq, capture_ns: 1_000_000 * seq, epoch: 1, ..SampleHeader::default() };
        let shape = PictureShape { width: 8192, height: 3, components: 4 };
        for seq in 0..1000 {
            walked.set(ids[0], &header(seq), (seq % 3 > 0).then_some(shape));
        }
        for seq in 0..1000 {
            let found = walked.get(ids[0], &header(seq));
            let expected = (seq >= 1000 - REMEMBERED as u64).then_some((seq % 3 > 0).then_some(shape));
            assert_eq!(found, expected, "{seq}");
            assert_eq!(walked.get(ids[1], &header(seq)), None);
            assert_eq!(walked.get(ids[0], &SampleHeader { epoch: 2, ..header(seq) }), None);
        }
    }
}
