//! Previews: the newest sample of a device that a screen looks at, a few times a second.
//!
//! A screen requests them with [`Command::Look`](super::Command::Look), again and again while it looks: they cost nothing
//! while no one does.
//!
//! Invariant: a preview is a sample as it was published, not converted: it is decoded where it is shown.

use std::sync::Arc;
use std::time::Duration;

use rapid_core::modality::ModalityId;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;
use serde::{Deserialize, Serialize};

/// Largest preview, in bytes: a picture of 4096 x 2160 in YUYV.
pub(crate) const LARGEST_PREVIEW: usize = 4096 * 2160 * 2;
/// How long a screen receives previews after it has asked for them.
pub const LOOKED_AT: Duration = Duration::from_secs(2);
/// Time between two previews of pictures and other large samples...
const EVERY: Duration = Duration::from_millis(200);
/// ...and of those with at most [`SMALL`] bytes, which are plotted.
const SMALL_EVERY: Duration = Duration::from_millis(50);
const SMALL: usize = 4096;

/// A sample to be shown.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Preview {
    /// Its modality.
    pub device: ModalityId,
    /// Its number.
    pub seq: u64,
    /// Its capture time.
    pub captured: Stamp,
    /// How `payload` is encoded.
    pub encoding: Encoding,
    /// Image: pixels. Otherwise 0.
    pub width: u32,
    /// Image: pixels. Otherwise 0.
    pub height: u32,
    /// Length of `payload`.
    pub bytes: usize,
    /// The sample as the device gave it.
    #[serde(skip, default = "nothing")]
    pub payload: Arc<[u8]>,
}

fn nothing() -> Arc<[u8]> {
    Arc::from([])
}

impl Preview {
    /// Of a published sample; `None` if its encoding is unknown or it is too large to be sent to a screen.
    pub fn from_sample(device: ModalityId, header: &SampleHeader, payload: &[u8]) -> Option<Self> {
        let encoding = Encoding::from_raw(header.encoding)?;
        (payload.len() <= LARGEST_PREVIEW).then(|| Self {
            device,
            seq: header.seq,
            captured: Stamp(header.capture_ns),
            encoding,
            width: header.width,
            height: header.height,
            bytes: payload.len(),
            payload: payload.into(),
        })
    }

    /// Whether a sample of so many bytes, captured then, is due after this one.
    pub fn is_outdated(&self, captured: Stamp, bytes: usize) -> bool {
        captured.since(self.captured) >= if bytes <= SMALL { SMALL_EVERY } else { EVERY }
    }

    /// Whether it is a picture, if perhaps a damaged one. The header of numbers has a width too: how many there are.
    pub fn is_picture(&self) -> bool {
        self.width > 0 && self.encoding.is_picture()
    }

    /// The numbers of a sample of numbers; empty for any other.
    pub fn numbers(&self) -> Vec<f64> {
        if self.encoding != Encoding::F64 {
            return Vec::new();
        }
        self.payload.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_of_numbers_has_its_numbers_and_a_broken_one_what_is_whole() {
        let payload: Vec<u8> = [1.5_f64, -2.0].iter().flat_map(|number| number.to_le_bytes()).chain([9, 9]).collect();
        let header = SampleHeader { encoding: Encoding::F64 as u32, seq: 7, ..SampleHeader::default() };
        let id = ModalityId::new(3).unwrap();
        let preview = Preview::from_sample(id, &header, &payload).unwrap();
        assert_eq!((preview.numbers(), preview.seq, preview.bytes), (vec![1.5, -2.0], 7, 18));
        assert_eq!(Preview::from_sample(id, &SampleHeader { encoding: 77, ..header }, &payload), None);
    }

    #[test]
    fn pictures_are_shown_less_often_than_numbers() {
        let last = Preview { captured: Stamp(1_000_000_000), ..crate::literal::preview() };
        let after = |ms| last.captured.after(Duration::from_millis(ms));
        assert!(last.is_outdated(after(50), 100) && !last.is_outdated(after(49), 100));
        assert!(last.is_outdated(after(200), 100_000) && !last.is_outdated(after(199), 100_000));
    }
}
