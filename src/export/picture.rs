//! Pictures of a dataset: a JPEG as the camera sent it, without what readers interpret differently, and what is not
//! compressed as PNG, which loses nothing.
//!
//! Grey is written as three equal channels. YUYV becomes red, green and blue first, by the rule of `pixels`: LeRobot
//! and its policies know no other pictures.

use std::borrow::Cow;
use std::fmt;

use rapid_core::sample::Encoding;
use rapid_episode::decode::jpeg_frame;
use rapid_pictures::jpeg::{Walker, plain};
use rapid_pictures::pixels::{LARGEST, Picture, PixelError, Pixels};

use super::rows::Payload;

/// How a dataset has its pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pictures {
    /// A file of each, in the rows.
    #[default]
    Files,
    /// A video of each camera and episode.
    Video(Codec),
}

impl fmt::Display for Pictures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Files => "jpeg",
            Self::Video(codec) => codec.name(),
        })
    }
}

/// How a video is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// AV1: small, and slower.
    Av1,
    /// H.264: what every player can decode.
    H264,
}

impl Codec {
    pub(super) const ALL: [Self; 2] = [Self::Av1, Self::H264];

    /// As ffmpeg and LeRobot call it.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Av1 => "av1",
            Self::H264 => "h264",
        }
    }

    /// The encoder in ffmpeg.
    pub(super) fn encoder(self) -> &'static str {
        match self {
            Self::Av1 => "libsvtav1",
            Self::H264 => "libx264",
        }
    }

    /// Its options: every second frame is a picture of its own, as LeRobot has it, so that any of them is soon decoded. The
    /// quality of AV1 is LeRobot's, that of H.264 the encoder's default. No frame has to wait for a later one: the first is
    /// then at 0.
    pub(super) fn options(self) -> &'static [&'static str] {
        match self {
            Self::Av1 => &["-c:v", "libsvtav1", "-g", "2", "-crf", "30", "-preset", "12"],
            Self::H264 => &["-c:v", "libx264", "-g", "2", "-crf", "23", "-preset", "veryfast", "-bf", "0"],
        }
    }
}

/// Pixels along each side, and values of a pixel: 3, and 1 in the pictures of a camera that sends grey JPEGs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Shape {
    /// Rows.
    pub height: u32,
    /// Pixels per row.
    pub width: u32,
    /// Values of a pixel.
    pub channels: u8,
}

impl Shape {
    /// `None` if no picture of `rapid` has this shape: what a file claims may be anything.
    pub(super) fn new(height: u32, width: u32, channels: u8) -> Option<Self> {
        let is_side = |side: u32| usize::try_from(side).is_ok_and(|side| (1..=LARGEST).contains(&side));
        (is_side(height) && is_side(width) && matches!(channels, 1 | 3)).then_some(Self { height, width, channels })
    }
}

impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)?;
        if self.channels == 1 { write!(f, " grey") } else { Ok(()) }
    }
}

/// The shape that a picture states of itself, whether it can be used or not.
pub(super) fn stated(encoding: Encoding, width: u32, height: u32, bytes: &[u8]) -> Option<Shape> {
    let pixels = usize::try_from(u64::from(width) * u64::from(height)).ok()?;
    let channels = match encoding {
        Encoding::Mjpeg => jpeg_frame(bytes).map(|(_, _, components)| components),
        Encoding::Grey => (bytes.len() == pixels).then_some(3),
        Encoding::Yuyv => (Some(bytes.len()) == pixels.checked_mul(2) && pixels.is_multiple_of(2)).then_some(3),
        Encoding::Bytes | Encoding::F64 | Encoding::Mask | Encoding::Depth => None,
    };
    Shape::new(height, width, channels?)
}

/// The shape of a picture that can be used: of a JPEG, one that is whole.
pub(super) fn shape(payload: &Payload) -> Option<Shape> {
    let Payload::Picture { encoding, width, height, bytes } = payload else { return None };
    let is_whole = *encoding != Encoding::Mjpeg || Walker::default().walk(bytes).is_ok();
    stated(*encoding, *width, *height, bytes).filter(|_| is_whole)
}

/// The file of a picture.
///
/// # Errors
/// When it has no pixels.
pub(super) fn file<'a>(payload: &'a Payload, pixels: &mut Pixels) -> Result<Cow<'a, [u8]>, PixelError> {
    match payload {
        Payload::Picture { encoding: Encoding::Mjpeg, bytes, .. } => Ok(plain(bytes)),
        Payload::Picture { encoding, width, height, bytes } => {
            let (encoding, width, height) = (*encoding, *width, *height);
            pixels.decode(&Picture { encoding, width, height, bytes })?;
            png(Shape { height, width, channels: 3 }, pixels.values()).map(Cow::Owned)
        }
        Payload::Numbers(_) => Err(PixelError::NoPicture(Encoding::F64)),
    }
}

/// The file of a black picture.
///
/// # Errors
/// When it is too large.
pub(super) fn black(shape: Shape) -> Result<Vec<u8>, PixelError> {
    let values = u64::from(shape.width) * u64::from(shape.height) * u64::from(shape.channels);
    png(shape, &vec![0; usize::try_from(values).unwrap_or(usize::MAX)])
}

fn png(shape: Shape, values: &[u8]) -> Result<Vec<u8>, PixelError> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, shape.width, shape.height);
    encoder.set_color(if shape.channels == 1 { png::ColorType::Grayscale } else { png::ColorType::Rgb });
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(values)?;
        writer.finish()
    });
    written.map_err(|error| PixelError::Damaged(error.to_string()))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(file: &[u8]) -> (u32, u32, Vec<u8>) {
        let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
        let mut values = vec![0; reader.output_buffer_size().unwrap()];
        let frame = reader.next_frame(&mut values).unwrap();
        (frame.width, frame.height, values)
    }

    #[test]
    fn what_is_not_compressed_loses_nothing() {
        let mut pixels = Pixels::default();
        let bytes: Vec<u8> = (0..=255).cycle().take(40 * 30).collect();
        let grey = Payload::Picture { encoding: Encoding::Grey, width: 40, height: 30, bytes: bytes.clone() };
        assert_eq!(shape(&grey), Some(Shape { height: 30, width: 40, channels: 3 }));
        let values: Vec<u8> = bytes.iter().flat_map(|grey| [*grey; 3]).collect();
        assert_eq!(decoded(&file(&grey, &mut pixels).unwrap()), (40, 30, values));
        let yuyv = Payload::Picture { encoding: Encoding::Yuyv, width: 20, height: 30, bytes: bytes.clone() };
        let (_, _, values) = decoded(&file(&yuyv, &mut pixels).unwrap());
        assert_eq!(values, pixels.values());
        let short = Payload::Picture { encoding: Encoding::Grey, width: 41, height: 30, bytes };
        assert_eq!(shape(&short), None);
    }

    #[test]
    fn a_jpeg_is_not_changed_and_needs_its_end() {
        let picture =
            |bytes: &[u8]| Payload::Picture { encoding: Encoding::Mjpeg, width: 8, height: 4, bytes: bytes.to_vec() };
        let mut jpeg = Vec::new();
        rapid_pictures::jpeg::encode(&[9; 32], [4, 8], rapid_pictures::jpeg::Values::Grey, 90, &mut jpeg).unwrap();
        let whole = picture(&jpeg);
        assert_eq!(shape(&whole), Some(Shape { height: 4, width: 8, channels: 1 }));
        assert_eq!(file(&whole, &mut Pixels::default()).unwrap(), jpeg);
        assert_eq!(shape(&picture(&jpeg[..jpeg.len() - 2])), None);
        assert_eq!(decoded(&black(shape(&whole).unwrap()).unwrap()), (8, 4, vec![0; 32]));
    }
}
