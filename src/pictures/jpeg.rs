//! JPEG pictures (ITU-T T.81) as pixels, and pixels as JPEG pictures: 8 bits a value, row by row from the top.
//!
//! Invariant: no bytes cause a panic, and a picture that is not whole is refused.

mod huffman;
mod walk;

use std::borrow::Cow;

use jpeg_encoder::{ColorType, Encoder, EncodingError};
use zune_jpeg::JpegDecoder;
use zune_jpeg::errors::DecodeErrors;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

pub use walk::{Damage, Frame, Walker};

/// Pixels a picture may have along a side.
pub const LARGEST: usize = 8192;
/// Values of a pixel of three colours.
const CHANNELS: usize = 3;

/// The values of a pixel that is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Values {
    /// One, its luminance.
    Grey,
    /// Red, green and blue; below quality 90 the colours have half the resolution.
    Rgb,
}

/// Why pixels could not be encoded.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct EncodeError(#[from] EncodingError);

/// Appends the picture of these pixels to `out`; `size`: height and width, 1 to 65,535; `quality`: 1 to 100.
///
/// # Errors
/// When there are fewer pixels than `size` needs, or a side is 0.
pub fn encode(
    pixels: &[u8],
    size: [u16; 2],
    values: Values,
    quality: u8,
    out: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    let [height, width] = size;
    let colors = match values {
        Values::Grey => ColorType::Luma,
        Values::Rgb => ColorType::Rgb,
    };
    Ok(Encoder::new(out, quality).encode(pixels, width, height, colors)?)
}

/// Why a picture has no pixels.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// It is not whole.
    #[error(transparent)]
    Damage(#[from] Damage),
    /// It is not of the size that is expected.
    #[error("{found:?} pixels across and down in a sample of {expected:?}")]
    Size {
        /// Pixels of the picture.
        found: [usize; 2],
        /// Pixels of the sample.
        expected: [usize; 2],
    },
    /// The decoder's own reason.
    #[error("{0}")]
    Decoder(String),
}

impl From<DecodeErrors> for DecodeError {
    fn from(error: DecodeErrors) -> Self {
        Self::Decoder(error.to_string())
    }
}

/// Memory of one picture, used again for the next; the library itself allocates for every picture.
#[derive(Debug, Default)]
pub struct Decoder {
    walker: Walker,
    /// The picture with the mark that the library requires.
    marked: Vec<u8>,
}

impl Decoder {
    /// Replaces `values` by red, green and blue of each pixel of a picture with this height and width.
    ///
    /// # Errors
    /// When the picture is damaged, truncated or of another size; `values` are then meaningless.
    pub fn rgb(&mut self, jpeg: &[u8], [height, width]: [usize; 2], values: &mut Vec<u8>) -> Result<(), DecodeError> {
        let frame = self.walker.walk(jpeg)?;
        let found = [frame.width, frame.height].map(usize::from);
        if found != [width, height] {
            return Err(DecodeError::Size { found, expected: [width, height] });
        }
        let mut decoder = self.decoder(picture(jpeg, frame), options(ColorSpace::RGB).set_strict_mode(true));
        decoder.decode_headers()?;
        values.resize(CHANNELS * width * height, 0);
        Ok(decoder.decode_into(values)?)
    }

    /// The luminance of each pixel of a picture of any size.
    ///
    /// # Errors
    /// When the picture is damaged or truncated.
    pub fn luminance(&mut self, jpeg: &[u8]) -> Result<Vec<u8>, DecodeError> {
        let frame = self.walker.walk(jpeg)?;
        Ok(self.decoder(picture(jpeg, frame), options(ColorSpace::Luma)).decode()?)
    }

    /// With the mark (segment APP0) that motion JPEG has in AVI files. Cameras leave out the Huffman tables and imply those
    /// of the standard (ITU-T T.81 K.3); with the mark, the library uses these in place of the missing ones.
    fn decoder(&mut self, jpeg: &[u8], options: DecoderOptions) -> JpegDecoder<ZCursor<&Vec<u8>>> {
        let (start, rest) = jpeg.split_at(jpeg.len().min(2));
        self.marked.clear();
        for part in [start, &[0xff, 0xe0, 0, 8], b"AVI1\0\0", rest] {
            self.marked.extend_from_slice(part);
        }
        JpegDecoder::new_with_options(ZCursor::new(&self.marked), options)
    }
}

/// The sum of the squares of the differences between pixels and those that a lossy encoder made of them.
pub fn squares(found: &[u8], expected: &[u8]) -> u64 {
    found.iter().zip(expected).map(|(found, expected)| u64::from(found.abs_diff(*expected)).pow(2)).sum()
}

/// A whole picture without what is behind its end, and without the metadata by which some readers turn a picture or change its
/// colours while others do not: Exif and XMP (APP1), colour profiles and further pictures (APP2). Its pixels, which are
/// what everything here decodes, stay bit for bit. Borrowed if nothing has to go, or if it is not whole.
pub fn plain(jpeg: &[u8]) -> Cow<'_, [u8]> {
    let Ok(frame) = Walker::default().walk(jpeg) else { return Cow::Borrowed(jpeg) };
    let whole = picture(jpeg, frame);
    let mut kept = Cow::Borrowed(whole);
    let mut at = 2;
    while let Some(&[0xff, marker, high, low]) = whole.get(at..).and_then(|rest| rest.first_chunk()) {
        if marker == 0xff {
            at += 1;
            continue;
        }
        if marker == 0xda {
            break;
        }
        let end = at + 2 + usize::from(u16::from_be_bytes([high, low]));
        if matches!(marker, 0xe1 | 0xe2) {
            // From the end of the picture, whose rest is the same.
            let from = kept.len() - (whole.len() - at);
            kept.to_mut().drain(from..from + (end - at));
        }
        at = end;
    }
    kept
}

/// The bytes of a picture that was walked.
fn picture(jpeg: &[u8], frame: Frame) -> &[u8] {
    jpeg.get(..frame.length).unwrap_or(jpeg)
}

fn options(colors: ColorSpace) -> DecoderOptions {
    DecoderOptions::default().jpeg_set_out_colorspace(colors).set_max_width(LARGEST).set_max_height(LARGEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plain_picture_has_the_same_pixels_and_nothing_to_interpret() {
        let mut jpeg = Vec::new();
        let pixels: Vec<u8> = (0..40 * 24 * 3).map(|at| u8::try_from(at % 251).unwrap()).collect();
        encode(&pixels, [24, 40], Values::Rgb, 85, &mut jpeg).unwrap();
        assert!(matches!(plain(&jpeg), Cow::Borrowed(same) if same == jpeg));
        // Turned by Exif (orientation 6), with a profile, a comment, and bytes behind the end.
        let exif = b"\xff\xe1\x00\x22Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
        let (profile, comment) = (b"\xff\xe2\x00\x06ICC_", b"\xff\xff\xfe\x00\x06seq1");
        let dressed = [&jpeg[..2], exif, comment, profile, &jpeg[2..], b"tail"].concat();
        let bare = plain(&dressed);
        assert_eq!(*bare, [&jpeg[..2], comment, &jpeg[2..]].concat());
        let (mut decoder, mut found, mut expected) = (Decoder::default(), Vec::new(), Vec::new());
        decoder.rgb(&jpeg, [24, 40], &mut expected).unwrap();
        for picture in [&dressed, &*bare] {
            decoder.rgb(picture, [24, 40], &mut found).unwrap();
            assert_eq!(found, expected);
        }
    }
}
