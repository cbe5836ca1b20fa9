//! Pictures of a camera as pixels: 8-bit red, green, blue, row by row.
//!
//! Depth becomes shades for people: from white at 0 to black at 16 x 255 counts (4 m in mm) and where there is none.
//!
//! Invariant: no bytes cause a panic, and a picture that is not whole is refused.

use rapid_core::sample::Encoding;

use crate::jpeg::{DecodeError, Decoder};

/// Values of a pixel.
pub const CHANNELS: usize = 3;
/// Pixels a picture may have along a side, as in the registry.
pub const LARGEST: usize = crate::jpeg::LARGEST;

/// Why a payload has no pixels.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PixelError {
    /// The samples are not pictures.
    #[error("the samples are {0:?}, not pictures")]
    NoPicture(Encoding),
    /// It cannot be decoded.
    #[error("damaged picture: {0}")]
    Damaged(String),
    /// Not as many bytes as pixels of this format have.
    #[error("{found} bytes, where a picture of {width}x{height} has {expected}")]
    Length {
        /// Bytes there are.
        found: usize,
        /// Bytes there should be.
        expected: usize,
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
    },
}

impl From<DecodeError> for PixelError {
    fn from(error: DecodeError) -> Self {
        Self::Damaged(error.to_string())
    }
}

/// A picture as received from the bus.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'a> {
    /// How `bytes` are encoded.
    pub encoding: Encoding,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The payload.
    pub bytes: &'a [u8],
}

/// Memory for the pixels of one picture, reused for the next; only the JPEG decoder allocates for every picture.
#[derive(Debug, Default)]
pub struct Pixels {
    decoder: Decoder,
    values: Vec<u8>,
}

impl Pixels {
    /// Decodes a picture; returns height and width.
    ///
    /// # Errors
    /// When it is damaged, or not a picture. The pixels are then meaningless.
    pub fn decode(&mut self, picture: &Picture<'_>) -> Result<[usize; 2], PixelError> {
        let side = |side: u32| usize::try_from(side).unwrap_or(usize::MAX);
        let (width, height) = (side(picture.width), side(picture.height));
        if !(1..=LARGEST).contains(&width) || !(1..=LARGEST).contains(&height) {
            return Err(PixelError::Damaged(format!("{width}x{height} pixels")));
        }
        let whole = |bytes_per_pixel: usize| {
            let (found, expected) = (picture.bytes.len(), bytes_per_pixel * width * height);
            let error = PixelError::Length { found, expected, width, height };
            if found == expected { Ok(()) } else { Err(error) }
        };
        match picture.encoding {
            Encoding::Grey => {
                whole(1)?;
                self.values.clear();
                self.values.extend(picture.bytes.iter().flat_map(|grey| [*grey; CHANNELS]));
            }
            Encoding::Yuyv => {
                whole(2)?;
                self.values.clear();
                self.values.extend(picture.bytes.chunks_exact(4).flat_map(colors));
                if self.values.len() != CHANNELS * width * height {
                    return Err(PixelError::Damaged("an odd number of pixels in YUYV".to_owned()));
                }
            }
            Encoding::Depth => {
                whole(2)?;
                self.values.clear();
                self.values.extend(picture.bytes.as_chunks::<2>().0.iter().flat_map(|count| [shade(*count); CHANNELS]));
            }
            Encoding::Mjpeg => self.decoder.rgb(picture.bytes, [height, width], &mut self.values)?,
            other => return Err(PixelError::NoPicture(other)),
        }
        Ok([height, width])
    }

    /// The pixels of the picture decoded last: red, green, blue, row by row.
    pub fn values(&self) -> &[u8] {
        &self.values
    }
}

fn shade(count: [u8; 2]) -> u8 {
    match u16::from_le_bytes(count) {
        0 => 0,
        count => u8::MAX - u8::try_from(count / 16).unwrap_or(u8::MAX),
    }
}

/// Every n-th pixel of every n-th row of a picture of this height and width: width, height and the pixels.
pub fn every(step: usize, [height, width]: [usize; 2], rgb: &[u8]) -> (usize, usize, Vec<u8>) {
    let rows = rgb.chunks_exact((width * CHANNELS).max(1)).step_by(step);
    let thinned = rows.flat_map(|row| row.chunks_exact(CHANNELS).step_by(step).flatten().copied()).collect();
    (width.div_ceil(step), height.div_ceil(step), thinned)
}

/// Two pixels of YUYV in red, green and blue: ITU-R BT.601 of limited range, what V4L2 means by YUYV
/// unless it states otherwise; coefficients in 1/65536.
fn colors(yuyv: &[u8]) -> [u8; 2 * CHANNELS] {
    let at = |index: usize| yuyv.get(index).copied().map_or(0, i32::from);
    let (u, v) = (at(1) - 128, at(3) - 128);
    let [first, second] = [at(0), at(2)].map(|y| {
        let y = 76_309 * (y - 16);
        [y + 104_597 * v, y - 25_675 * u - 53_279 * v, y + 132_201 * u]
            .map(|color| u8::try_from(((color + 32_768) >> 16).clamp(0, 255)).unwrap_or(u8::MAX))
    });
    [first[0], first[1], first[2], second[0], second[1], second[2]]
}

#[cfg(test)]
mod tests;
