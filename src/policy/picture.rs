//! Pictures: from the payload of a camera to the input of an encoder.
//!
//! Decoded to 8-bit colours, divided by 255, resized (bilinear, half-pixel centres, no antialiasing),
//! cropped to the middle, compared with a reference if the policy was trained so, normalised. All of
//! it in memory allocated once; only the JPEG decoder allocates for every picture.
//!
//! Invariant: a refused picture changes neither the observation nor the reference.

use rapid_pictures::pixels::{CHANNELS, PixelError, Pixels};

use super::bundle::{ColorOrder, ImageSpec, Normalization, Operation};
use super::normalize::Normalizer;

pub use rapid_pictures::pixels::Picture;

/// Why a picture cannot be an observation.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PictureError {
    /// The payload has no pixels.
    #[error(transparent)]
    Pixels(#[from] PixelError),
    /// The size does not suit the policy.
    #[error(
        "a picture of {width}x{height}, where the policy takes {wanted_width}x{wanted_height}: set the camera to that, \
         or `resize` in policy.json"
    )]
    Size {
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
        /// Required pixels per row; the minimum if the picture is cropped.
        wanted_width: usize,
        /// Required rows, likewise.
        wanted_height: usize,
    },
}

/// Converts pictures of one camera to observations.
#[derive(Debug)]
pub struct Preprocessor {
    spec: ImageSpec,
    normalizer: Normalizer,
    reference: Option<Reference>,
    pixels: Pixels,
    /// The size that `columns` and `rows` are for.
    size: [usize; 2],
    columns: Vec<Tap>,
    rows: Vec<Tap>,
}

/// The source of a value along an axis: the share of `high`, the rest of `low`.
#[derive(Debug, Clone, Copy)]
struct Tap {
    low: usize,
    high: usize,
    share: f32,
}

/// The reference of later pictures: the first one, kept across unplugs.
#[derive(Debug)]
pub struct Reference {
    values: Vec<f32>,
    taken: bool,
}

impl Reference {
    fn new(len: usize) -> Self {
        Self { values: vec![0.0; len], taken: false }
    }

    /// Whether there was a first picture.
    pub const fn is_taken(&self) -> bool {
        self.taken
    }

    /// A new episode: the next picture is the reference.
    pub fn reset(&mut self) {
        self.taken = false;
    }

    /// `(v - reference) / 2 + 0.5`.
    fn compare(&mut self, values: &mut [f32]) {
        if !self.taken {
            self.values.copy_from_slice(values);
            self.taken = true;
        }
        for (value, reference) in values.iter_mut().zip(&self.values) {
            *value = (*value - reference) / 2.0 + 0.5;
        }
    }
}

impl Preprocessor {
    /// For pictures of `spec`, whose normalisation has one entry a channel.
    pub fn new(spec: ImageSpec, normalization: &Normalization) -> Self {
        let len = CHANNELS * spec.height * spec.width;
        Self {
            spec,
            normalizer: Normalizer::new(normalization, CHANNELS),
            reference: (spec.operation == Some(Operation::DiffToReference)).then(|| Reference::new(len)),
            pixels: Pixels::default(),
            size: [0, 0],
            columns: Vec::with_capacity(spec.width),
            rows: Vec::with_capacity(spec.height),
        }
    }

    /// Numbers of one observation: 3 x height x width.
    pub fn output_len(&self) -> usize {
        CHANNELS * self.spec.height * self.spec.width
    }

    /// The reference that pictures are compared with, if this policy does so.
    pub fn reference(&mut self) -> Option<&mut Reference> {
        self.reference.as_mut()
    }

    /// Writes the observation of a picture, channel by channel, row by row. The first one is the
    /// reference of all others.
    ///
    /// # Errors
    /// When the picture is damaged or of another size than the policy takes. `out` is as it was.
    ///
    /// # Panics
    /// When `out` is not [`Self::output_len`] long.
    pub fn write(&mut self, picture: &Picture<'_>, out: &mut [f32]) -> Result<(), PictureError> {
        assert_eq!(out.len(), self.output_len(), "an observation's place has the length that the bundle gives");
        let size = self.pixels.decode(picture)?;
        if self.size != size {
            self.fit(size)?;
        }
        self.sample(out);
        if let Some(reference) = &mut self.reference {
            reference.compare(out);
        }
        self.normalizer.normalize_planes(out);
        Ok(())
    }

    /// Works out which pixels of a picture of this size each value comes from.
    fn fit(&mut self, size: [usize; 2]) -> Result<(), PictureError> {
        let resized = self.spec.resize.unwrap_or(size);
        let wanted = [self.spec.height, self.spec.width];
        let suits = match self.spec.crop {
            Some(_) => resized[0] >= wanted[0] && resized[1] >= wanted[1],
            None => resized == wanted,
        };
        if !suits {
            let ([height, width], [wanted_height, wanted_width]) = (size, wanted);
            return Err(PictureError::Size { width, height, wanted_width, wanted_height });
        }
        taps(size[0], resized[0], wanted[0], &mut self.rows);
        taps(size[1], resized[1], wanted[1], &mut self.columns);
        self.size = size;
        Ok(())
    }

    /// Values in 0..1, resized and cropped, channel by channel.
    fn sample(&self, out: &mut [f32]) {
        let (height, width) = (self.spec.height, self.spec.width);
        let (stride, pixels) = (CHANNELS * self.size[1], self.pixels.values());
        for (place, plane) in out.chunks_exact_mut(height * width).enumerate() {
            let channel = match self.spec.color {
                ColorOrder::Rgb => place,
                ColorOrder::Bgr => CHANNELS - 1 - place,
            };
            for (values, row) in plane.chunks_exact_mut(width).zip(&self.rows) {
                let low = &pixels[row.low * stride..][..stride];
                let high = &pixels[row.high * stride..][..stride];
                for (value, column) in values.iter_mut().zip(&self.columns) {
                    let (left, right) = (CHANNELS * column.low + channel, CHANNELS * column.high + channel);
                    let mix = |line: &[u8]| {
                        let (left, right) = (f32::from(line[left]), f32::from(line[right]));
                        left * (1.0 - column.share) + right * column.share
                    };
                    *value = (mix(low) * (1.0 - row.share) + mix(high) * row.share) / 255.0;
                }
            }
        }
    }
}

/// The taps of the middle `wanted` of `resized` values made of `size`.
fn taps(size: usize, resized: usize, wanted: usize, taps: &mut Vec<Tap>) {
    let start = crop_start(resized, wanted);
    let scale = size as f64 / resized as f64;
    taps.clear();
    taps.extend((start..start + wanted).map(|at| {
        let place = ((at as f64 + 0.5) * scale - 0.5).max(0.0);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between 0 and the size")]
        let low = (place.floor() as usize).min(size - 1);
        #[expect(clippy::cast_possible_truncation, reason = "a share needs no more")]
        let share = (place - low as f64).min(1.0) as f32;
        Tap { low, high: (low + 1).min(size - 1), share }
    }));
}

/// Where the middle begins: an odd rest is halved to the even side, as torchvision's `CenterCrop` does.
fn crop_start(size: usize, wanted: usize) -> usize {
    let rest = size - wanted;
    rest / 2 + usize::from(rest % 4 == 3)
}

#[cfg(test)]
mod tests;
