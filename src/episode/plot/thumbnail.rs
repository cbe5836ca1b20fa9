//! Small pictures: decoded, reduced by the mean of what each pixel covers, and encoded as JPEG.

use std::fmt;

use rapid_pictures::jpeg::Values;
use rapid_pictures::pixels::{CHANNELS, Picture, Pixels};

/// Longest side of one, pixels: twice as many as are shown, for screens with small pixels.
const LONGEST: usize = 176;
const QUALITY: u8 = 72;
/// Pixels of a picture that is decoded, at most: 96 MB of memory.
const LARGEST: u64 = 32 << 20;

#[derive(Clone)]
pub(super) struct Thumbnail {
    /// When it was captured, 0 to 1.
    pub(super) share: f64,
    /// Its shape: width over height.
    pub(super) aspect: f64,
    pub(super) jpeg: Vec<u8>,
}

impl fmt::Debug for Thumbnail {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Thumbnail").field("share", &self.share).field("bytes", &self.jpeg.len()).finish_non_exhaustive()
    }
}

/// Makes them, in memory that is used again.
#[derive(Debug, Default)]
pub(super) struct Thumbnails {
    pixels: Pixels,
}

impl Thumbnails {
    /// Of a picture captured at `share`; `None` if it is damaged.
    pub(super) fn make(&mut self, picture: &Picture<'_>, share: f64) -> Option<Thumbnail> {
        if u64::from(picture.width) * u64::from(picture.height) > LARGEST {
            return None;
        }
        let size = self.pixels.decode(picture).ok()?;
        let [height, width] = reduced(size);
        let small = mean(self.pixels.values(), size, [height, width]);
        let mut jpeg = Vec::new();
        let (columns, rows) = (u16::try_from(width).ok()?, u16::try_from(height).ok()?);
        rapid_pictures::jpeg::encode(&small, [rows, columns], Values::Rgb, QUALITY, &mut jpeg).ok()?;
        Some(Thumbnail { share, aspect: width as f64 / height as f64, jpeg })
    }
}

/// Height and width of the thumbnail of a picture.
fn reduced(size: [usize; 2]) -> [usize; 2] {
    let longest = size[0].max(size[1]).max(1);
    if longest <= LONGEST { size } else { size.map(|side| (side * LONGEST / longest).max(1)) }
}

/// The picture in another size, not larger: each value is the mean of those it covers.
fn mean(pixels: &[u8], from: [usize; 2], to: [usize; 2]) -> Vec<u8> {
    let range = |at: usize, axis: usize| {
        let begin = at * from[axis] / to[axis];
        begin..((at + 1) * from[axis] / to[axis]).max(begin + 1)
    };
    let mut small = Vec::with_capacity(CHANNELS * to[0] * to[1]);
    for row in 0..to[0] {
        for column in 0..to[1] {
            let (mut sum, mut count) = ([0_u64; CHANNELS], 0_u64);
            for line in range(row, 0) {
                let columns = range(column, 1);
                let begin = CHANNELS * (line * from[1] + columns.start);
                let covered = pixels.get(begin..begin + CHANNELS * columns.len()).unwrap_or_default();
                for pixel in covered.chunks_exact(CHANNELS) {
                    count += 1;
                    for (sum, value) in sum.iter_mut().zip(pixel) {
                        *sum += u64::from(*value);
                    }
                }
            }
            small.extend(sum.map(|sum| u8::try_from(sum / count.max(1)).unwrap_or(u8::MAX)));
        }
    }
    small
}

#[cfg(test)]
mod tests {
    use rapid_core::sample::Encoding;

    use super::*;

    #[test]
    fn a_thumbnail_has_the_shape_and_the_shades_of_its_picture() {
        // The left half black, the right half white.
        let (width, height) = (640_u32, 320_u32);
        let bytes: Vec<u8> = (0..width * height).map(|at| if at % width < width / 2 { 0 } else { 255 }).collect();
        let picture = Picture { encoding: Encoding::Grey, width, height, bytes: &bytes };
        let thumbnail = Thumbnails::default().make(&picture, 0.5).unwrap();
        assert!((thumbnail.aspect - 2.0).abs() < 1e-9 && thumbnail.jpeg.len() < 4000, "{thumbnail:?}");
        let mut pixels = Pixels::default();
        let again = Picture { encoding: Encoding::Mjpeg, width: 176, height: 88, bytes: &thumbnail.jpeg };
        assert_eq!(pixels.decode(&again).unwrap(), [88, 176]);
        let at = |x: usize| pixels.values()[CHANNELS * (176 * 44 + x)];
        assert!(at(40) < 8 && at(140) > 247, "{} {}", at(40), at(140));
        let cut = Picture { bytes: &bytes[1..], ..picture };
        assert!(Thumbnails::default().make(&cut, 0.5).is_none());
        let huge = Picture { width: 8000, height: 8000, ..picture };
        assert!(Thumbnails::default().make(&huge, 0.5).is_none());
    }

    #[test]
    fn a_small_picture_stays_as_it_is_and_a_line_keeps_a_pixel() {
        assert_eq!(reduced([48, 64]), [48, 64]);
        assert_eq!(reduced([1, 8192]), [1, LONGEST]);
        assert_eq!(mean(&[10, 20, 30, 30, 40, 50], [1, 2], [1, 1]), [20, 30, 40]);
    }
}
