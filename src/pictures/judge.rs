//! Which pictures of a run are usable: the one rule of observations, policies, frames, verdicts and exports.
//!
//! A picture is usable if its bytes are those of a whole picture, and if it has the size and kind of its camera's
//! pictures: those of the first, or of the last two that agreed. So one picture of another size is one sample that is not
//! usable, and a camera whose format has changed is back with the second.

use std::sync::Arc;

use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::walked::{PictureShape, WalkedPictures};

use crate::jpeg::Walker;

/// What a sample is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Judgement {
    /// No picture, or one that is usable.
    Usable,
    /// A picture with damage or without a part.
    NotWhole,
    /// A whole picture of another size or kind than its camera's.
    OtherShape,
}

impl Judgement {
    /// Whether it may be in an observation.
    pub fn is_usable(self) -> bool {
        self == Self::Usable
    }
}

/// Judges the samples of a run or a file, those of each modality in their order.
#[derive(Debug)]
pub struct PictureJudge {
    walker: Walker,
    walked: Arc<WalkedPictures>,
    cameras: Vec<Camera>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Camera {
    shape: Option<(Encoding, PictureShape)>,
    /// Of the last picture, if it had another.
    other: Option<(Encoding, PictureShape)>,
}

impl PictureJudge {
    /// A judge that looks up what others have found, and shares what it finds.
    pub fn sharing(walked: Arc<WalkedPictures>) -> Self {
        Self { walker: Walker::default(), walked, cameras: vec![Camera::default(); MAX_MODALITIES] }
    }

    /// A judge of its own.
    pub fn alone() -> Self {
        Self::sharing(Arc::default())
    }

    /// Judges a sample of a run.
    pub fn sample(&mut self, id: ModalityId, header: &SampleHeader, payload: &[u8]) -> Judgement {
        let Some(encoding) = Encoding::from_raw(header.encoding).filter(|encoding| encoding.is_picture()) else {
            return Judgement::Usable;
        };
        let shape = if encoding == Encoding::Mjpeg {
            self.walked.get(id, header).unwrap_or_else(|| {
                let shape = self.walk(payload);
                self.walked.set(id, header, shape);
                shape
            })
        } else {
            raw(encoding, [header.width, header.height], payload)
        };
        self.compare(id, encoding, shape)
    }

    /// Judges a sample of a file.
    pub fn recorded(&mut self, id: ModalityId, encoding: Encoding, sides: [u32; 2], payload: &[u8]) -> Judgement {
        if !encoding.is_picture() {
            return Judgement::Usable;
        }
        let shape = if encoding == Encoding::Mjpeg { self.walk(payload) } else { raw(encoding, sides, payload) };
        self.compare(id, encoding, shape)
    }

    fn walk(&mut self, payload: &[u8]) -> Option<PictureShape> {
        let frame = self.walker.walk(payload).ok()?;
        Some(PictureShape { width: frame.width, height: frame.height, components: frame.components })
    }

    fn compare(&mut self, id: ModalityId, encoding: Encoding, shape: Option<PictureShape>) -> Judgement {
        let Some(shape) = shape else { return Judgement::NotWhole };
        let Some(camera) = self.cameras.get_mut(id.index()) else { return Judgement::Usable };
        let found = Some((encoding, shape));
        if camera.shape.is_none() || camera.shape == found || camera.other == found {
            *camera = Camera { shape: found, other: None };
            return Judgement::Usable;
        }
        camera.other = found;
        Judgement::OtherShape
    }
}

/// The shape of pixels that are not compressed; `None` if these are not as many bytes.
fn raw(encoding: Encoding, [width, height]: [u32; 2], payload: &[u8]) -> Option<PictureShape> {
    let pixels = usize::try_from(u64::from(width) * u64::from(height)).ok()?;
    let is_whole = pixels > 0 && encoding.pixel_bytes()?.checked_mul(pixels)? == payload.len();
    let side = |side: u32| u16::try_from(side).ok();
    is_whole.then_some(PictureShape { width: side(width)?, height: side(height)?, components: 1 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jpeg::{Values, encode};

    fn jpeg([height, width]: [u16; 2], values: Values) -> Vec<u8> {
        let mut jpeg = Vec::new();
        let pixels = vec![90; usize::from(height) * usize::from(width) * if values == Values::Rgb { 3 } else { 1 }];
        encode(&pixels, [height, width], values, 80, &mut jpeg).unwrap();
        jpeg
    }

    #[test]
    fn one_picture_of_another_shape_is_one_sample_and_two_are_a_change() {
        use Judgement::{NotWhole, OtherShape, Usable};
        let (plain, large, grey) =
            (jpeg([16, 24], Values::Rgb), jpeg([32, 24], Values::Rgb), jpeg([16, 24], Values::Grey));
        let torn = &plain[..plain.len() - 9];
        let id = ModalityId::new(5).unwrap();
        let cases: [(&[&[u8]], &[Judgement]); 5] = [
            (&[&plain, &large, &plain, &grey, &plain], &[Usable, OtherShape, Usable, OtherShape, Usable]),
            (&[&plain, &large, &large, &plain, &large], &[Usable, OtherShape, Usable, OtherShape, Usable]),
            (&[&large, &plain, &plain, &plain], &[Usable, OtherShape, Usable, Usable]),
            (&[torn, &plain, torn, &plain], &[NotWhole, Usable, NotWhole, Usable]),
            (
                &[&plain, &large, &grey, &plain, &large, &large],
                &[Usable, OtherShape, OtherShape, Usable, OtherShape, Usable],
            ),
        ];
        for (pictures, expected) in cases {
            let walked = Arc::<WalkedPictures>::default();
            let (mut first, mut second) = (PictureJudge::sharing(Arc::clone(&walked)), PictureJudge::sharing(walked));
            let mut file = PictureJudge::alone();
            for (seq, (picture, expected)) in (0..).zip(pictures.iter().zip(expected)) {
                let header = SampleHeader { seq, encoding: Encoding::Mjpeg as u32, ..SampleHeader::default() };
                assert_eq!(first.sample(id, &header, picture), *expected);
                assert_eq!(second.sample(id, &header, b"looked up, not walked"), *expected);
                assert_eq!(file.recorded(id, Encoding::Mjpeg, [0, 0], picture), *expected);
            }
        }
    }

    #[test]
    fn pixels_have_their_number_of_bytes_and_their_format() {
        use Judgement::{NotWhole, OtherShape, Usable};
        let id = ModalityId::new(0).unwrap();
        let mut judge = PictureJudge::alone();
        for (encoding, sides, bytes, expected) in [
            (Encoding::Yuyv, [4, 2], 16, Usable),
            (Encoding::Yuyv, [4, 2], 15, NotWhole),
            (Encoding::Grey, [4, 4], 16, OtherShape),
            (Encoding::Yuyv, [2, 4], 16, OtherShape),
            (Encoding::Yuyv, [0, 2], 0, NotWhole),
            (Encoding::Yuyv, [4, 2], 16, Usable),
            (Encoding::F64, [3, 0], 1, Usable),
        ] {
            assert_eq!(
                judge.recorded(id, encoding, sides, &vec![1; bytes]),
                expected,
                "{encoding:?} {sides:?} {bytes}"
            );
        }
    }
}
