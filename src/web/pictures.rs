//! Small pictures for the page: the newest of a camera, decoded, thinned and encoded again.
//!
//! Cameras leave out the tables that a browser needs, send pixels that are not compressed, or pictures of many megapixels:
//! each becomes the same kind of small JPEG.
//!
//! Invariant: a picture is encoded once, however many pages show it. A damaged one is not shown.

use hyper::body::Bytes;
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_pictures::jpeg::Values;
use rapid_pictures::pixels::{self, Pixels};
use rapid_status::preview::Preview;

/// Longest side, in pixels: as wide as the screen of a phone, in its own pixels.
const LARGEST: usize = 640;
const QUALITY: u8 = 70;

/// The newest picture of each camera.
#[derive(Debug, Default)]
pub(super) struct Pictures {
    pixels: Pixels,
    made: Vec<(ModalityId, u64, Bytes)>,
}

impl Pictures {
    /// The preview as a small JPEG.
    ///
    /// # Errors
    /// When it is damaged, or no picture: why.
    pub(super) fn jpeg(&mut self, preview: &Preview) -> Result<Bytes, String> {
        let made = self.made.iter().find(|(device, seq, _)| (*device, *seq) == (preview.device, preview.seq));
        if let Some((.., jpeg)) = made {
            return Ok(jpeg.clone());
        }
        let jpeg = self.encode(preview)?;
        self.made.retain(|(device, ..)| *device != preview.device);
        debug_assert!(self.made.len() < MAX_MODALITIES, "one for each device");
        self.made.push((preview.device, preview.seq, jpeg.clone()));
        Ok(jpeg)
    }

    fn encode(&mut self, preview: &Preview) -> Result<Bytes, String> {
        let Preview { encoding, width, height, .. } = *preview;
        let picture = pixels::Picture { encoding, width, height, bytes: &preview.payload };
        let [height, width] = self.pixels.decode(&picture).map_err(|error| error.to_string())?;
        let step = width.max(height).div_ceil(LARGEST).max(1);
        let (width, height, rgb) = pixels::every(step, [height, width], self.pixels.values());
        let side = |side: usize| u16::try_from(side).unwrap_or(u16::MAX);
        let mut jpeg = Vec::new();
        rapid_pictures::jpeg::encode(&rgb, [side(height), side(width)], Values::Rgb, QUALITY, &mut jpeg)
            .map_err(|error| error.to_string())?;
        Ok(jpeg.into())
    }
}

#[cfg(test)]
mod tests {
    use rapid_core::sample::Encoding;

    use super::*;

    fn preview(encoding: Encoding, [width, height]: [u32; 2], payload: &[u8]) -> Preview {
        Preview { encoding, width, height, bytes: payload.len(), payload: payload.into(), ..crate::literal::preview() }
    }

    #[test]
    fn every_picture_becomes_a_small_jpeg() {
        let mut pictures = Pictures::default();
        let grey = preview(Encoding::Grey, [1600, 1200], &vec![90; 1600 * 1200]);
        let jpeg = pictures.jpeg(&grey).unwrap();
        let small = preview(Encoding::Mjpeg, [534, 400], &jpeg);
        let mut pixels = Pixels::default();
        let of = |preview: &Preview| {
            let Preview { encoding, width, height, .. } = *preview;
            pixels.decode(&pixels::Picture { encoding, width, height, bytes: &preview.payload })
        };
        assert_eq!({ of }(&small), Ok([400, 534]));
        assert!(pixels.values().iter().all(|value| value.abs_diff(90) < 3));
        // Another sample of the same camera replaces it; the same one is the same bytes.
        assert_eq!(pictures.jpeg(&grey).unwrap().as_ptr(), jpeg.as_ptr());
        let next = Preview { seq: 1, ..preview(Encoding::Yuyv, [2, 1], &[128; 4]) };
        assert_ne!(pictures.jpeg(&next).unwrap(), jpeg);
        assert_eq!(pictures.made.len(), 1);
    }

    #[test]
    fn what_is_damaged_is_no_picture() {
        let mut pictures = Pictures::default();
        for damaged in [
            preview(Encoding::Mjpeg, [64, 64], b"\xff\xd8\xff\xd9"),
            preview(Encoding::Grey, [64, 64], &[0; 7]),
            preview(Encoding::F64, [3, 1], &[0; 24]),
            preview(Encoding::Grey, [0, 0], &[]),
        ] {
            assert!(pictures.jpeg(&damaged).is_err(), "{damaged:?}");
        }
        assert!(pictures.made.is_empty());
    }
}
