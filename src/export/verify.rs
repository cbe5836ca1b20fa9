//! A dataset against the episodes it was made of: every picture byte for byte, every number bit for bit, and every frame of
//! a video within what an encoder loses.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use super::cells::{CellMaker, Cells};
use super::error::SetError;
use super::features::{ACTION, AGE, Features, MASK, OWN, PLUGGED, STATE, TIME, VALID};
use super::ffmpeg::{Ffmpeg, FfmpegError, Running};
use super::rows::{Index, Row};
use super::set::DataSet;
use super::table::{Position, RowView, Rows, timestamp};
use super::video::{self, Damaged, FrameMaker, Shown};

/// Differences of an episode that are kept.
const MOST: usize = 20;
/// How near, dB, a frame of a video has to be to the picture of its row, and to black where the camera is absent. A good
/// encoding is at 30 and more; a picture of something else is below 20.
const NEAR: f64 = 20.0;
const NEAR_BLACK: f64 = 30.0;

/// A value that is not as in the episode.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Difference {
    /// The row in its episode; `None` about the episode as a whole.
    pub frame: Option<usize>,
    /// The feature, `None` about the whole row.
    pub feature: Option<String>,
    /// What differs.
    pub what: String,
}

/// What a comparison found.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Verified {
    /// Rows of the dataset.
    pub rows: usize,
    /// The differences, of many the first.
    pub differences: Vec<Difference>,
    /// Of videos: how near the worst frame is to its picture, dB.
    pub psnr_db: Option<f64>,
}

/// Compares the episode of this number with the file at `path`; `ffmpeg` decodes its videos.
///
/// # Errors
/// When the episode cannot be read, or the dataset; also when `stop` is set.
pub fn verify(
    set: &DataSet,
    episode: usize,
    path: &Path,
    ffmpeg: Option<&Ffmpeg>,
    stop: &AtomicBool,
) -> Result<Verified, SetError> {
    let (Some(features), Some(entry)) = (set.features(), set.entries.get(episode)) else {
        return Ok(Verified::default());
    };
    let data = set.data_path(episode as u64);
    let wrong = |source| SetError::Parquet { path: data.clone(), source };
    let mut rows = Rows::open(open(&data)?).map_err(wrong)?;
    let position = Position { episode: episode as u64, first: entry.first, task: entry.task };
    let index = Index::read(path, stop)?;
    let mut found = Findings { features, position, verified: Verified::default() };
    let names: Vec<&str> = index.modalities.iter().map(|modality| modality.name.as_str()).collect();
    if names != features.modalities {
        let (of_set, of_episode) = (features.modalities.join(", "), names.join(", "));
        found.add(None, None, format!("sensors {of_set} of the dataset, {of_episode} of the episode"));
        return Ok(found.verified);
    }
    let kinds = index.modalities.iter().map(|modality| modality.kind).collect();
    let mut maker = CellMaker::new(features, kinds)?;
    let mut videos = ffmpeg.map(|ffmpeg| Videos::open(set, episode, ffmpeg, stop)).transpose()?;
    if let Some(videos) = &mut videos {
        videos.check(&index, &mut found)?;
    }
    index.rows(path, stop, |row| {
        if let Some(videos) = &mut videos {
            videos.compare(row, &mut maker.damaged, &mut found)?;
        }
        let cells = maker.cells(row)?;
        if let Some(view) = rows.advance().map_err(|error| wrong(error.into()))? {
            found.verified.rows += 1;
            found.compare(row.number, &cells, view);
        }
        Ok::<_, SetError>(())
    })?;
    while let Ok(Some(_)) = rows.advance() {
        found.verified.rows += 1;
    }
    let (count, expected) = (found.verified.rows, index.ticks.len());
    if (count, entry.rows) != (expected, expected as u64) {
        let facts = entry.rows;
        found.add(None, None, format!("{count} rows, {facts} by its facts, and {expected} frames in the episode"));
    }
    Ok(found.verified)
}

fn open(path: &Path) -> Result<File, SetError> {
    File::open(path).map_err(|source| SetError::Io { path: path.to_owned(), source })
}

/// The videos of an episode, being decoded.
struct Videos<'a> {
    ffmpeg: &'a Ffmpeg,
    paths: Vec<PathBuf>,
    /// `None` after a video that ended too early.
    running: Vec<Option<Running>>,
    maker: FrameMaker,
    frame: Vec<u8>,
    stop: &'a AtomicBool,
}

impl<'a> Videos<'a> {
    fn open(set: &DataSet, episode: usize, ffmpeg: &'a Ffmpeg, stop: &'a AtomicBool) -> Result<Self, SetError> {
        let paths = set.video_paths(episode as u64);
        let decoded = |path: &PathBuf| Ok::<_, SetError>(Some(ffmpeg.decode(open(path)?)?));
        let running = paths.iter().map(decoded).collect::<Result<_, _>>()?;
        Ok(Self { ffmpeg, paths, running, maker: FrameMaker::default(), frame: Vec::new(), stop })
    }

    /// Each has a frame for each row, at its time.
    fn check(&self, index: &Index, found: &mut Findings<'_>) -> Result<(), SetError> {
        for (path, (key, _)) in self.paths.iter().zip(found.features.videos()) {
            let stop = || self.stop.load(Ordering::Relaxed);
            match self.ffmpeg.check(open(path)?, index.ticks.len(), index.fps, &stop) {
                Ok(()) => {}
                Err(error @ FfmpegError::Failed { .. }) => found.add(None, Some(&key), error.to_string()),
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// Compares the frames of a row with its pictures, which are added to `damaged` where they have none.
    fn compare(&mut self, row: &Row<'_>, damaged: &mut Damaged, found: &mut Findings<'_>) -> Result<(), SetError> {
        let features = found.features;
        for ((place, shape), running) in features.cameras.iter().zip(&mut self.running) {
            let (expected, shown) = self.maker.frame(row, *place, *shape);
            if shown == Shown::Damaged {
                damaged.insert((*place, row.number));
            }
            let Some(decoder) = running else { continue };
            self.frame.resize(video::length(*shape), 0);
            let (key, at) = (features.camera_key(*place), Some(row.number));
            if decoder.read(&mut self.frame, &|| self.stop.load(Ordering::Relaxed))? < self.frame.len() {
                // How many it has is checked before.
                found.add(at, Some(&key), "the video cannot be decoded from here on".to_owned());
                *running = None;
                continue;
            }
            let psnr = video::psnr(&self.frame, expected);
            match shown {
                Shown::Picture => {
                    let worst = found.verified.psnr_db.map_or(psnr, |worst| worst.min(psnr));
                    found.verified.psnr_db = Some(worst);
                    if psnr < NEAR {
                        found.add(at, Some(&key), format!("another picture: {psnr:.1} dB, wanted {NEAR} or more"));
                    }
                }
                Shown::Black | Shown::Damaged if psnr < NEAR_BLACK => {
                    found.add(at, Some(&key), "a picture, where the camera has none".to_owned());
                }
                Shown::Black | Shown::Damaged => {}
            }
        }
        Ok(())
    }
}

struct Findings<'a> {
    features: &'a Features,
    position: Position,
    verified: Verified,
}

impl Findings<'_> {
    fn add(&mut self, frame: Option<usize>, feature: Option<&str>, what: String) {
        if self.verified.differences.len() < MOST {
            self.verified.differences.push(Difference { frame, feature: feature.map(str::to_owned), what });
        }
    }

    fn compare(&mut self, frame: usize, cells: &Cells<'_>, view: RowView<'_>) {
        let features = self.features;
        for ((place, _), expected) in features.cameras.iter().zip(&cells.pictures) {
            let key = features.camera_key(*place);
            let Some(picture) = view.picture(&key) else {
                self.add(Some(frame), Some(&key), "no picture".to_owned());
                continue;
            };
            if picture != &**expected {
                let at = picture.iter().zip(&**expected).take_while(|(found, expected)| found == expected).count();
                let (found, expected) = (picture.len(), expected.len());
                let what = format!("another picture, from byte {at} on ({found} bytes, {expected} of the episode)");
                self.add(Some(frame), Some(&key), what);
            }
        }
        let wide = |values: &[f32]| values.iter().map(|value| f64::from(*value)).collect::<Vec<_>>();
        let row = frame as u64;
        let vectors = [
            (STATE, wide(&cells.state)),
            (ACTION, wide(&cells.action)),
            (MASK, wide(&cells.mask)),
            (PLUGGED, wide(&cells.plugged)),
            (VALID, wide(&cells.valid)),
            (AGE, cells.age.clone()),
            (OWN[0], vec![timestamp(row, features.fps).into()]),
        ];
        for (key, expected) in vectors.into_iter().filter(|(_, expected)| !expected.is_empty()) {
            let found = view.numbers(key);
            let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
            if found.as_deref().map(bits) != Some(bits(&expected)) {
                self.add(Some(frame), Some(key), format!("{found:?}, {expected:?} of the episode"));
            }
        }
        let [_, own @ ..] = OWN;
        let integers = own.into_iter().zip(self.position.own(row)).chain([(TIME, cells.time_ns)]);
        for (key, expected) in integers {
            let found = view.integer(key);
            if found != Some(expected) {
                self.add(Some(frame), Some(key), format!("{found:?}, {expected} of the episode"));
            }
        }
    }
}
