//! The mean brightness of a picture.

use rapid_core::sample::Encoding;
use rapid_pictures::jpeg::{DecodeError, Decoder};

/// Why a picture has no brightness.
#[derive(Debug, thiserror::Error)]
pub enum BrightnessError {
    /// It is not a picture.
    #[error("the samples are not pictures")]
    NoPicture,
    /// It cannot be decoded.
    #[error("{0}")]
    Damaged(String),
}

impl From<DecodeError> for BrightnessError {
    fn from(error: DecodeError) -> Self {
        Self::Damaged(error.to_string())
    }
}

/// The mean luminance of a picture, 0 (black) to 255 (white).
///
/// # Errors
/// When the bytes are not a picture, or a damaged one.
pub fn brightness(encoding: Encoding, bytes: &[u8]) -> Result<f64, BrightnessError> {
    match encoding {
        Encoding::Grey => mean(bytes.iter()),
        // Y0 U Y1 V: every other byte is luminance.
        Encoding::Yuyv => mean(bytes.iter().step_by(2)),
        Encoding::Mjpeg => mean(Decoder::default().luminance(bytes)?.iter()),
        Encoding::Bytes | Encoding::F64 | Encoding::Mask | Encoding::Depth => Err(BrightnessError::NoPicture),
    }
}

fn mean<'a>(luminance: impl Iterator<Item = &'a u8>) -> Result<f64, BrightnessError> {
    let (sum, count) =
        luminance.fold((0_u64, 0_u64), |(sum, count), luminance| (sum + u64::from(*luminance), count + 1));
    if count == 0 {
        return Err(BrightnessError::Damaged("the picture is empty".to_owned()));
    }
    Ok(sum as f64 / count as f64)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rapid_pictures::jpeg::{Values, encode};

    use super::*;

    fn jpeg(shade: u8) -> Vec<u8> {
        let mut jpeg = Vec::new();
        encode(&[shade; 3 * 64 * 48], [48, 64], Values::Rgb, 80, &mut jpeg).unwrap();
        jpeg
    }

    /// The JPEG without its Huffman tables (marker FFC4), as many cameras send it.
    fn without_tables(jpeg: &[u8]) -> Vec<u8> {
        let mut rest = &jpeg[2..];
        let mut bare = jpeg[..2].to_vec();
        while rest[1] != 0xda {
            let length = 2 + usize::from(u16::from_be_bytes([rest[2], rest[3]]));
            if rest[1] != 0xc4 {
                bare.extend_from_slice(&rest[..length]);
            }
            rest = &rest[length..];
        }
        bare.extend_from_slice(rest);
        bare
    }

    #[test]
    fn each_encoding_has_its_luminance() {
        assert!((brightness(Encoding::Grey, &[10, 30]).unwrap() - 20.0).abs() < 1e-9);
        assert!((brightness(Encoding::Yuyv, &[10, 255, 30, 0]).unwrap() - 20.0).abs() < 1e-9);
        for shade in [0, 77, 200, 255] {
            let whole = jpeg(shade);
            assert!((brightness(Encoding::Mjpeg, &whole).unwrap() - f64::from(shade)).abs() < 2.0, "{shade}");
            let bare = without_tables(&whole);
            assert!(bare.len() < whole.len() - 100);
            assert!((brightness(Encoding::Mjpeg, &bare).unwrap() - f64::from(shade)).abs() < 2.0, "{shade}");
        }
        assert!(brightness(Encoding::Grey, &[]).is_err() && brightness(Encoding::F64, &[0; 8]).is_err());
        assert!(brightness(Encoding::Mjpeg, b"no picture").is_err());
    }

    proptest! {
        #[test]
        fn damaged_pictures_are_refused_or_decoded_without_a_panic(
            places in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20), cut in any::<prop::sample::Index>(),
        ) {
            let mut bytes = jpeg(90);
            for (place, value) in places {
                let at = place.index(bytes.len());
                bytes[at] = value;
            }
            bytes.truncate(1 + cut.index(bytes.len()));
            if let Ok(mean) = brightness(Encoding::Mjpeg, &bytes) {
                prop_assert!((0.0..=255.0).contains(&mean));
            }
        }
    }
}
