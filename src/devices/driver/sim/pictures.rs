//! The pictures of a simulated camera: encoded once, and numbered when they are sent.

use rapid_pictures::jpeg::Values;

use super::super::DriverError;

/// Number of different pictures of a simulated camera.
pub(super) const PICTURES: u32 = 8;
const JPEG_QUALITY: u8 = 80;

/// Pictures encoded once, when the device is opened.
#[derive(Debug)]
pub(super) struct Pictures {
    pub(super) width: u32,
    pub(super) height: u32,
    seed: u64,
    encoded: Vec<Vec<u8>>,
    /// The picture while the light in front of it is on.
    lit: Option<Vec<u8>>,
}

impl Pictures {
    /// `has_light`: a switched light is in front of the camera.
    pub(super) fn new(width: u32, height: u32, seed: u64, bytes: usize, has_light: bool) -> Result<Self, DriverError> {
        let lit = has_light.then(|| white(width, height)).transpose()?;
        let picture = |index| Ok(fill(encode(width, height, seed, index)?, bytes, seed, index));
        let encoded = (0..PICTURES).map(picture).collect::<Result<_, DriverError>>()?;
        Ok(Self { width, height, seed, encoded, lit })
    }

    pub(super) fn largest(&self) -> usize {
        // 64 bytes are enough for the longest comment.
        self.encoded.iter().chain(&self.lit).map(Vec::len).max().unwrap_or(0) + 64
    }

    pub(super) fn shows_light(&self) -> bool {
        self.lit.is_some()
    }

    pub(super) fn write(&self, sequence: u32, lit: bool, payload: &mut Vec<u8>) {
        let usual = || self.encoded.get((sequence % PICTURES) as usize);
        let picture = self.lit.as_ref().filter(|_| lit).or_else(usual).map_or(&[][..], Vec::as_slice);
        write_picture(picture, self.seed, sequence, payload);
    }
}

/// The picture with a comment segment after its start of image (JPEG, ITU-T T.81 B.2.4.5: marker
/// FFFE, length of what follows it as big-endian u16 with its own two bytes).
pub(super) fn write_picture(picture: &[u8], seed: u64, sequence: u32, payload: &mut Vec<u8>) {
    use std::io::Write as _;
    let (start, rest) = picture.split_at(picture.len().min(2));
    payload.clear();
    payload.extend_from_slice(start);
    payload.extend_from_slice(&[0xff, 0xfe, 0, 0]);
    let at = payload.len();
    // Writing to a Vec cannot fail.
    let _ = write!(payload, "rapid-sim {seed} {sequence}");
    let length = u16::try_from(payload.len() - at + 2).unwrap_or(u16::MAX).to_be_bytes();
    if let Some(place) = payload.get_mut(at - 2..at) {
        place.copy_from_slice(&length);
    }
    payload.extend_from_slice(rest);
}

/// The picture with comment segments after its start of image that extend it to at least `bytes`, filled with noise
/// that does not compress, as the coefficients of a real scene do not.
pub(super) fn fill(picture: Vec<u8>, bytes: usize, seed: u64, index: u32) -> Vec<u8> {
    // Content bytes per segment, besides marker and length.
    const SEGMENT: usize = 65_533;
    if picture.len() >= bytes {
        return picture;
    }
    let (start, rest) = picture.split_at(picture.len().min(2));
    let mut filled = Vec::with_capacity(bytes + SEGMENT);
    filled.extend_from_slice(start);
    // xorshift64 (Marsaglia 2003), which needs a non-zero seed.
    let mut state = seed.wrapping_mul(u64::from(PICTURES)).wrapping_add(u64::from(index)) | 1 << 63;
    while filled.len() + rest.len() < bytes {
        let content = (bytes - filled.len() - rest.len()).saturating_sub(4).clamp(1, SEGMENT);
        let length = u16::try_from(content + 2).unwrap_or(u16::MAX);
        filled.extend_from_slice(&[0xff, 0xfe]);
        filled.extend_from_slice(&length.to_be_bytes());
        filled.extend((0..content).map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state.to_le_bytes()[0]
        }));
    }
    filled.extend_from_slice(rest);
    filled
}

/// A gradient tinted by the seed, with a bright square that moves from picture to picture.
pub(super) fn encode(width: u32, height: u32, seed: u64, index: u32) -> Result<Vec<u8>, DriverError> {
    let height_and_width = sides(width, height)?;
    let side = (width.min(height) / 4).max(1);
    let left = (width - side) * index / PICTURES;
    let top = height / 3;
    let tint = seed.to_le_bytes()[0];
    let share = |at: u32, of: u32| (at * 255 / of).to_le_bytes()[0];
    let mut row: Vec<[u8; 3]> = (0..width).map(|x| [share(x, width), 0, tint]).collect();
    let square = vec![[255, 240, 32]; side as usize];
    let mut pixels = Vec::with_capacity(3 * (width * height) as usize);
    for y in 0..height {
        let down = share(y, height);
        for [_, green, _] in &mut row {
            *green = down;
        }
        pixels.extend_from_slice(row.as_flattened());
        let place = pixels.len() - 3 * (width - left) as usize;
        if (top..top + side).contains(&y)
            && let Some(covered) = pixels.get_mut(place..place + 3 * side as usize)
        {
            covered.copy_from_slice(square.as_flattened());
        }
    }
    jpeg(&pixels, height_and_width)
}

/// A floor from 0.5 m to 2 m in mm, a nearer square that moves across it, and columns without a distance at its left, as a
/// stereo camera has; the first pixels of the last row are the sequence.
pub(super) fn write_depth((width, height): (u32, u32), seed: u64, sequence: u32, payload: &mut Vec<u8>) {
    let side = (width.min(height) / 4).max(1);
    let left = (width - side.min(width)) * (sequence % PICTURES) / PICTURES;
    let top = height / 3;
    let near = 300 + u16::from(seed.to_le_bytes()[0]);
    payload.clear();
    for y in 0..height {
        let floor = u16::try_from(2000 - y * 1500 / height.max(1)).unwrap_or(0);
        for x in 0..width {
            let is_inside = (left..left + side).contains(&x) && (top..top + side).contains(&y);
            let count = if is_inside { near } else { floor * u16::from(x >= width / 16) };
            payload.extend_from_slice(&count.to_le_bytes());
        }
    }
    let at = 2 * (width * height.saturating_sub(1)) as usize;
    if let Some(place) = payload.get_mut(at..at + 4) {
        place.copy_from_slice(&sequence.to_le_bytes());
    }
}

/// The light fills the picture.
fn white(width: u32, height: u32) -> Result<Vec<u8>, DriverError> {
    let size = sides(width, height)?;
    jpeg(&vec![255; 3 * (width * height) as usize], size)
}

/// Height and width, if a picture can have these.
fn sides(width: u32, height: u32) -> Result<[u16; 2], DriverError> {
    let side = |side: u32| u16::try_from(side).ok().filter(|side| (1..=8192).contains(side));
    side(height).zip(side(width)).map(Into::into).ok_or_else(|| {
        DriverError::Fatal(format!("a simulated picture cannot be {width}x{height}: use 1..=8192 pixels"))
    })
}

fn jpeg(pixels: &[u8], size: [u16; 2]) -> Result<Vec<u8>, DriverError> {
    let mut encoded = Vec::new();
    rapid_pictures::jpeg::encode(pixels, size, Values::Rgb, JPEG_QUALITY, &mut encoded)
        .map_err(|error| DriverError::Fatal(format!("a simulated picture: {error}")))?;
    Ok(encoded)
}
