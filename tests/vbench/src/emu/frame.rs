//! Pictures with an identity: each contains its number and its send time, which a reader can extract.
//!
//! MJPEG: a COM segment right after SOI with the text `rapid-vbench FRAMENO SEND_NS`. YUYV: the same numbers in the first 16 bytes.
//! Invariant: frames are encoded once; sending one copies bytes and never encodes.

use std::path::Path;

use rapid_pictures::jpeg::{EncodeError, Values};

use super::spec::CAMERAS;

const COM_TAG: &str = "rapid-vbench";
const YUYV_TAG: &[u8; 4] = b"RVBF";
/// Maximum size of the identity in a JPEG, bytes.
pub const STAMP: usize = 64;
/// Number of different pictures that a camera cycles through, so that a frozen picture differs from a live one.
pub const PICTURES: usize = 6;

/// A folder like one of `/sys/class/leds`: while it exists, cameras that send YUYV see this light.
const LIGHT: &str = "/tmp/bench/light";

/// Whether the light is on; `None` without a light.
pub fn light() -> Option<bool> {
    let brightness = std::fs::read(Path::new(LIGHT).join("brightness")).ok()?;
    Some(brightness.first().is_some_and(|first| *first != b'0'))
}

/// Number and send time (CLOCK_MONOTONIC) of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameId {
    /// Counts the frames the camera has sent, starting at its device's `first_number`, across replugs.
    pub number: u32,
    /// When the emulator sent it.
    pub sent_ns: u64,
}

/// Number ranges of devices never overlap, so that a frame or line shows which of two equal units sent it.
pub const NUMBERS_PER_DEVICE: u32 = 1_000_000;

/// The ranges of a device's several cameras begin this far from each other.
pub const NUMBERS_PER_CAMERA: u32 = NUMBERS_PER_DEVICE / CAMERAS as u32;

/// The number of the first frame or line of the `index`-th device.
pub fn first_number(index: usize) -> u32 {
    u32::try_from(index).unwrap_or(0).saturating_mul(NUMBERS_PER_DEVICE)
}

impl FrameId {
    /// The device that sent it.
    pub fn device(self) -> usize {
        (self.number / NUMBERS_PER_DEVICE) as usize
    }

    /// Which of its device's several cameras sent it, counted from 0.
    pub fn camera(self) -> usize {
        (self.number % NUMBERS_PER_DEVICE / NUMBERS_PER_CAMERA) as usize
    }
}

/// The JPEGs a camera of this size cycles through.
pub fn jpegs(width: u16, height: u16) -> Result<Vec<Vec<u8>>, EncodeError> {
    (0..PICTURES)
        .map(|picture| {
            let mut jpeg = Vec::new();
            rapid_pictures::jpeg::encode(&gray(width, height, picture), [height, width], Values::Grey, 80, &mut jpeg)?;
            Ok(jpeg)
        })
        .collect()
}

/// `jpeg` with its identity inserted, written over `out`.
pub fn stamp_jpeg(jpeg: &[u8], id: FrameId, out: &mut Vec<u8>) {
    let text = format!("{COM_TAG} {} {}", id.number, id.sent_ns);
    let length = u16::try_from(text.len() + 2).expect("two numbers and a tag").to_be_bytes();
    out.clear();
    out.extend_from_slice(&[0xff, 0xd8, 0xff, 0xfe, length[0], length[1]]);
    out.extend_from_slice(text.as_bytes());
    out.extend_from_slice(&jpeg[2..]);
}

/// A YUYV frame of one shade that starts with its identity, written over `out`. The shade is that of the light in front
/// of the camera, if there is one, and otherwise follows from the number.
pub fn stamp_yuyv(width: u16, height: u16, id: FrameId, light: Option<bool>, out: &mut Vec<u8>) {
    let shade = match light {
        Some(lit) => {
            if lit {
                230
            } else {
                20
            }
        }
        None => id.number.to_le_bytes()[0],
    };
    out.clear();
    out.resize(usize::from(width) * usize::from(height) * 2, shade);
    out[0..4].copy_from_slice(YUYV_TAG);
    out[4..8].copy_from_slice(&id.number.to_le_bytes());
    out[8..16].copy_from_slice(&id.sent_ns.to_le_bytes());
}

/// The identity inside a frame of either format; `None` if there is none or it is damaged.
pub fn identity(frame: &[u8]) -> Option<FrameId> {
    if let Some(rest) = frame.strip_prefix(YUYV_TAG) {
        let number = u32::from_le_bytes(rest.get(..4)?.try_into().ok()?);
        let sent_ns = u64::from_le_bytes(rest.get(4..12)?.try_into().ok()?);
        return Some(FrameId { number, sent_ns });
    }
    let rest = frame.strip_prefix(&[0xff, 0xd8, 0xff, 0xfe])?;
    let length = usize::from(u16::from_be_bytes([*rest.first()?, *rest.get(1)?]));
    let text = std::str::from_utf8(rest.get(2..length)?).ok()?;
    let mut words = text.split(' ');
    if words.next() != Some(COM_TAG) {
        return None;
    }
    Some(FrameId { number: words.next()?.parse().ok()?, sent_ns: words.next()?.parse().ok()? })
}

/// Whether a JPEG is complete: starts with SOI and ends with EOI (drivers may pad with zeros).
pub fn is_whole_jpeg(frame: &[u8]) -> bool {
    let end = frame.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    frame.starts_with(&[0xff, 0xd8]) && frame[..end].ends_with(&[0xff, 0xd9])
}

/// A gradient with grain (so that sizes are realistic) and a bar that moves from picture to picture.
fn gray(width: u16, height: u16, picture: usize) -> Vec<u8> {
    let (width, height) = (usize::from(width), usize::from(height));
    let bar = width * picture / PICTURES;
    let mut grain: u32 = 0x2545_f491;
    let mut pixels = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            grain ^= grain << 13;
            grain ^= grain >> 17;
            grain ^= grain << 5;
            let slope = (x * 120 / width + y * 80 / height) as u32;
            let value = if x.abs_diff(bar) < width / 32 { 240 } else { 20 + slope + grain % 10 };
            pixels.push(value.min(255) as u8);
        }
    }
    pixels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identity_survives_both_formats() {
        let id = FrameId { number: 4_000_000_001, sent_ns: u64::MAX };
        let mut frame = Vec::new();
        for jpeg in jpegs(64, 48).unwrap() {
            stamp_jpeg(&jpeg, id, &mut frame);
            assert_eq!(identity(&frame), Some(id));
            assert!(is_whole_jpeg(&frame));
            frame.truncate(frame.len() - 1);
            assert!(!is_whole_jpeg(&frame));
        }
        stamp_yuyv(64, 48, id, None, &mut frame);
        assert_eq!((frame.len(), identity(&frame)), (64 * 48 * 2, Some(id)));
    }

    #[test]
    fn a_number_names_device_and_camera() {
        let number = first_number(3) + NUMBERS_PER_CAMERA + 7;
        let id = FrameId { number, sent_ns: 0 };
        assert_eq!((id.device(), id.camera()), (3, 1));
        assert_eq!(FrameId { number: first_number(3), sent_ns: 0 }.camera(), 0);
        assert_eq!(FrameId { number: first_number(4) - 1, sent_ns: 0 }.camera(), CAMERAS - 1);
    }

    #[test]
    fn foreign_or_cut_frames_have_no_identity() {
        for frame in
            [&b""[..], b"RVBF", b"\xff\xd8\xff\xfe\x00", b"\xff\xd8\xff\xfe\x00\x40rapid-vbench 1", b"\xff\xd8\xff\xe0"]
        {
            assert_eq!(identity(frame), None, "{frame:?}");
        }
    }

    #[test]
    fn a_vga_jpeg_is_as_large_as_a_cameras() {
        let size = jpegs(640, 480).unwrap()[0].len();
        assert!((20_000..60_000).contains(&size), "{size} bytes");
    }
}
