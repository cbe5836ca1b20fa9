//! The videos of an episode: one of each camera, with a frame for each row, in whose place a picture has its pixels.
//!
//! Pictures go to the encoder row by row, to all cameras at once. A frame is black where the camera is absent, and also where
//! its picture cannot be decoded: a video, unlike a table of JPEGs, cannot have what no one can see.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use rapid_pictures::pixels::{CHANNELS, Picture, Pixels};

use super::error::SetError;
use super::features::Features;
use super::ffmpeg::{Ffmpeg, Running, Stop};
use super::files::{NewFile, VIDEOS};
use super::picture::{self, Shape};
use super::rows::{Index, Payload, Row};
use super::survey::Survey;

/// Rows of which a camera's picture cannot be decoded: the place of the camera among the modalities, and the row.
pub(super) type Damaged = BTreeSet<(usize, usize)>;

/// The videos of an episode, complete, without their names.
#[derive(Debug, Default)]
pub struct Encoded {
    pub(super) videos: Vec<NewFile>,
    pub(super) damaged: Damaged,
}

/// What a frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shown {
    Picture,
    /// Nothing: the camera is absent.
    Black,
    /// Nothing: its picture cannot be decoded.
    Damaged,
}

/// Decodes the pictures of a row.
#[derive(Debug, Default)]
pub(super) struct FrameMaker {
    pixels: Pixels,
    black: Vec<u8>,
}

impl FrameMaker {
    /// The pixels of a camera's frame: red, green, blue, row by row.
    pub(super) fn frame(&mut self, row: &Row<'_>, place: usize, shape: Shape) -> (&[u8], Shown) {
        let usable = row.samples.get(place).and_then(|sample| sample.as_deref());
        let shown = match usable.filter(|payload| picture::shape(payload).is_some()) {
            Some(Payload::Picture { encoding, width, height, bytes }) => {
                let (encoding, width, height) = (*encoding, *width, *height);
                let decoded = self.pixels.decode(&Picture { encoding, width, height, bytes });
                // Another size is in no row.
                let is_whole = decoded.is_ok() && self.pixels.values().len() == length(shape);
                if is_whole { Shown::Picture } else { Shown::Damaged }
            }
            _ => Shown::Black,
        };
        if shown == Shown::Picture {
            return (self.pixels.values(), shown);
        }
        self.black.clear();
        self.black.resize(length(shape), 0);
        (&self.black, shown)
    }
}

/// Bytes of a frame.
pub(super) fn length(shape: Shape) -> usize {
    let side = |side: u32| usize::try_from(side).unwrap_or_default();
    CHANNELS * side(shape.height) * side(shape.width)
}

/// Who may end the encoding: the user, or what failed beside it.
#[derive(Debug, Clone, Copy)]
pub struct Ends<'a> {
    /// The user.
    pub stop: &'a AtomicBool,
    /// The export, after an error.
    pub failed: &'a AtomicBool,
}

impl Ends<'_> {
    fn is_over(self) -> bool {
        self.stop.load(Ordering::Relaxed) || self.failed.load(Ordering::Relaxed)
    }
}

/// Encodes the videos of an episode for the dataset in `folder`; `frames` counts those of all cameras.
///
/// # Errors
/// When ffmpeg fails, a file cannot be written, or the episode has changed since it was surveyed; also at its end by `ends`.
pub fn encode(
    folder: &Path,
    episode: &Survey,
    features: &Features,
    ffmpeg: &Ffmpeg,
    ends: Ends<'_>,
    frames: &AtomicUsize,
) -> Result<Encoded, SetError> {
    let stop: Stop<'_> = &|| ends.is_over();
    let mut encoded = Encoded::default();
    let mut running: Vec<Running> = Vec::new();
    for (key, shape) in features.videos() {
        // Its number is not known yet: episodes before it may still turn out not to fit.
        let new = NewFile::create(&folder.join(VIDEOS).join(key).join(format!("{}.mp4", episode.sha256)))?;
        running.push(ffmpeg.encode(shape, features.fps, new.again()?)?);
        encoded.videos.push(new);
    }
    let index = Index::read(&episode.file, ends.stop)?;
    let mut maker = FrameMaker::default();
    index.rows(&episode.file, ends.stop, |row| {
        for ((place, shape), running) in features.cameras.iter().zip(&mut running) {
            let (frame, shown) = maker.frame(row, *place, *shape);
            running.write(frame, stop)?;
            if shown == Shown::Damaged {
                encoded.damaged.insert((*place, row.number));
            }
            frames.fetch_add(1, Ordering::Relaxed);
        }
        Ok::<_, SetError>(())
    })?;
    for (running, new) in running.iter_mut().zip(&encoded.videos) {
        running.end(stop)?;
        ffmpeg.check(new.again()?, index.ticks.len(), features.fps, stop)?;
    }
    Ok(encoded)
}

/// How near a frame is to the picture that it was made of: the ratio of signal to noise, dB; 100 if they are equal.
pub(super) fn psnr(found: &[u8], expected: &[u8]) -> f64 {
    let squares = rapid_pictures::jpeg::squares(found, expected);
    (10.0 * (255.0_f64.powi(2) * expected.len() as f64 / squares as f64).log10()).min(100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ratio_of_signal_to_noise_is_that_of_the_squares() {
        // 10 log10(255² / 16²)
        assert!((psnr(&[16; 30], &[0; 30]) - 24.048).abs() < 1e-3);
        assert!(psnr(&[7; 30], &[7; 30]) > 99.0);
    }
}
