//! Samples: the header that accompanies every payload, and how payloads are encoded.
//!
//! Owns the header's memory layout: other processes and other languages read it directly from shared
//! memory, so a change of a field is a change of the interface.

use serde::{Deserialize, Serialize};

/// Incarnation of an attachment: +1 each time a device of a modality is started. Reports from an older
/// epoch change nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Epoch(pub u32);

impl Epoch {
    /// The next incarnation.
    #[must_use]
    pub const fn next(self) -> Self {
        Self(self.0.wrapping_add(1))
    }
}

/// How a payload is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[repr(u32)]
#[serde(rename_all = "lowercase")]
pub enum Encoding {
    /// Bytes as the device sent them.
    Bytes = 0,
    /// One JPEG picture.
    Mjpeg = 1,
    /// Packed YUV 4:2:2, 2 bytes a pixel.
    Yuyv = 2,
    /// 8-bit luminance, 1 byte a pixel.
    Grey = 3,
    /// Little-endian 64-bit floats.
    F64 = 4,
    /// A mask value: u64 mask, u64 sequence, little endian.
    Mask = 5,
    /// 16-bit depth, little-endian, row by row; 0 where there is none. V4L2 calls it `Z16 `.
    Depth = 6,
}

impl Encoding {
    /// The encoding of a number found in a header; `None` if it is unknown.
    pub const fn from_raw(raw: u32) -> Option<Self> {
        Some(match raw {
            0 => Self::Bytes,
            1 => Self::Mjpeg,
            2 => Self::Yuyv,
            3 => Self::Grey,
            4 => Self::F64,
            5 => Self::Mask,
            6 => Self::Depth,
            _ => return None,
        })
    }

    /// Bytes of a pixel, if these are pixels that are not compressed.
    pub const fn pixel_bytes(self) -> Option<usize> {
        match self {
            Self::Grey => Some(1),
            Self::Yuyv | Self::Depth => Some(2),
            Self::Bytes | Self::Mjpeg | Self::F64 | Self::Mask => None,
        }
    }

    /// Whether these are pixels, compressed or not.
    pub const fn is_picture(self) -> bool {
        matches!(self, Self::Mjpeg) || self.pixel_bytes().is_some()
    }
}

/// Header flag: this payload is damaged, as its device or driver reported or by its content ([`damage`]).
pub const FLAG_ERROR: u32 = 1;
/// Header flag: the capture time comes from the kernel or the device, not from the moment of arrival.
pub const FLAG_DEVICE_TIME: u32 = 2;
/// Header flag: its source gave it the number of the sample before it. It may be that sample again, and what the source
/// lost does not show.
pub const FLAG_SAME_NUMBER: u32 = 4;

/// Whether the numbers of an [`Encoding::F64`] payload can be used: there is one at least, and each is finite, also in the
/// 32 bits that a policy and a dataset have for it. Any other sample of numbers is damaged, whoever sent it.
pub fn are_usable_numbers(payload: &[u8]) -> bool {
    let (numbers, rest) = payload.as_chunks();
    #[expect(clippy::cast_possible_truncation, reason = "what is too large for 32 bits becomes infinite")]
    let is_finite = |number: &[u8; 8]| (f64::from_le_bytes(*number) as f32).is_finite();
    !numbers.is_empty() && rest.is_empty() && numbers.iter().all(is_finite)
}

/// [`FLAG_ERROR`] if what a payload holds shows that it is damaged, else no flag.
pub fn damage(encoding: Encoding, payload: &[u8]) -> u32 {
    if encoding == Encoding::F64 && !are_usable_numbers(payload) { FLAG_ERROR } else { 0 }
}

/// Accompanies every payload, as iceoryx2 user header. 56 bytes, native alignment 8.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C)]
pub struct SampleHeader {
    /// Counts the samples of this modality within a run of `rapid`, from 0, over all epochs: a gap
    /// is a lost sample, or several.
    pub seq: u64,
    /// Of all gaps in `seq` so far, the number of samples that the device lost before `rapid` received
    /// them; over all epochs. Its increase over a gap is the part lost by the device; the rest did not
    /// reach this reader.
    pub lost: u64,
    /// Capture time, `CLOCK_MONOTONIC` ns; from the kernel where it provides one.
    pub capture_ns: u64,
    /// When `rapid` had received the bytes, `CLOCK_MONOTONIC` ns.
    pub recv_ns: u64,
    /// The modality's number.
    pub id: u32,
    /// Incarnation of the attachment.
    pub epoch: u32,
    /// An [`Encoding`].
    pub encoding: u32,
    /// `FLAG_*`.
    pub flags: u32,
    /// Image: pixels. Otherwise 0.
    pub width: u32,
    /// Image: pixels. Otherwise 0.
    pub height: u32,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_header_has_56_bytes_and_no_padding() {
        assert_eq!(std::mem::size_of::<SampleHeader>(), 56);
        assert_eq!(std::mem::offset_of!(SampleHeader, id), 32);
        assert_eq!(std::mem::offset_of!(SampleHeader, height), 52);
    }

    #[test]
    fn numbers_that_are_not_finite_are_damaged() {
        let bytes = |numbers: &[f64]| numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>();
        for fine in [&[0.0][..], &[1.5, -2.0, 1e-300], &[f64::from(f32::MAX), f64::from(f32::MIN), -0.0]] {
            assert_eq!(damage(Encoding::F64, &bytes(fine)), 0, "{fine:?}");
        }
        for bad in [f64::NAN, -f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e39, f64::MIN] {
            for numbers in [&[bad][..], &[bad, 0.0, 0.0], &[0.0, bad, 0.0], &[0.0, 0.0, bad]] {
                assert_eq!(damage(Encoding::F64, &bytes(numbers)), FLAG_ERROR, "{numbers:?}");
                // Bytes mean nothing by themselves, and pixels are any.
                for other in [Encoding::Bytes, Encoding::Grey, Encoding::Depth] {
                    assert_eq!(damage(other, &bytes(numbers)), 0, "{numbers:?} as {other:?}");
                }
            }
        }
        for none in [&[][..], &[0; 7], &[0; 9]] {
            assert_eq!(damage(Encoding::F64, none), FLAG_ERROR, "{none:?}");
        }
    }

    #[test]
    fn encodings_survive_the_header() {
        for raw in 0..7 {
            assert_eq!(Encoding::from_raw(raw).map(|e| e as u32), Some(raw));
        }
        assert_eq!(Encoding::from_raw(7), None);
    }
}
