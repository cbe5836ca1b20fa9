//! A data set against the episodes it was made of: every picture byte for byte, every number bit for bit.

use std::fs::File;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use super::cells::{CellMaker, Cells};
use super::features::{ACTION, AGE, Features, IMAGES, MASK, OWN, STATE, TIME, VALID};
use super::rows::{Index, Refusal};
use super::set::{DataSet, SetError};
use super::table::{Position, RowView, Rows, timestamp};

/// Differences of an episode that are kept.
const MOST: usize = 20;

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

/// Compares the episode of this number with the file at `path`; returns the number of rows, and the differences, of many the
/// first.
///
/// # Errors
/// When the episode cannot be read, or the data set; also when `stop` is set.
pub fn verify(
    set: &DataSet,
    episode: usize,
    path: &Path,
    stop: &AtomicBool,
) -> Result<(usize, Vec<Difference>), SetError> {
    let (Some(features), Some(entry)) = (set.features(), set.entries.get(episode)) else { return Ok((0, Vec::new())) };
    let data = set.data_path(episode as u64);
    let file = File::open(&data).map_err(|source| SetError::Io { path: data.clone(), source })?;
    let mut rows = Rows::open(file).map_err(|source| SetError::Parquet { path: data.clone(), source })?;
    let position = Position { episode: episode as u64, first: entry.first, task: entry.task };
    let index = Index::read(path, stop)?;
    let mut found = Found { features, position, differences: Vec::new() };
    let names: Vec<&str> = index.modalities.iter().map(|modality| modality.name.as_str()).collect();
    if names != features.modalities {
        found.add(
            None,
            None,
            format!("sensors {} of the data set, {} of the episode", features.modalities.join(", "), names.join(", ")),
        );
        return Ok((0, found.differences));
    }
    let kinds = index.modalities.iter().map(|modality| modality.kind).collect();
    let mut maker = CellMaker::new(features, kinds)?;
    let mut count = 0;
    let mut broken = None;
    index
        .rows(path, stop, |row| {
            let cells = maker.cells(row)?;
            match rows.advance() {
                Ok(Some(view)) => {
                    count += 1;
                    found.compare(row.number, &cells, view);
                    Ok(())
                }
                Ok(None) => Ok(()),
                Err(error) => {
                    broken = Some(error);
                    // Only ends the reading.
                    Err(Refusal::Interrupted)
                }
            }
        })
        .or_else(|refusal| if broken.is_some() { Ok(()) } else { Err(refusal) })?;
    if let Some(error) = broken {
        return Err(SetError::Parquet { path: data, source: error.into() });
    }
    while let Ok(Some(_)) = rows.advance() {
        count += 1;
    }
    let expected = index.ticks.len();
    if (count, entry.rows) != (expected, expected as u64) {
        let facts = entry.rows;
        found.add(None, None, format!("{count} rows, {facts} by its facts, and {expected} frames in the episode"));
    }
    Ok((count, found.differences))
}

struct Found<'a> {
    features: &'a Features,
    position: Position,
    differences: Vec<Difference>,
}

impl Found<'_> {
    fn add(&mut self, frame: Option<usize>, feature: Option<&str>, what: String) {
        if self.differences.len() < MOST {
            self.differences.push(Difference { frame, feature: feature.map(str::to_owned), what });
        }
    }

    fn compare(&mut self, frame: usize, cells: &Cells<'_>, view: RowView<'_>) {
        let features = self.features;
        for ((place, _), expected) in features.cameras.iter().zip(&cells.pictures) {
            let key = format!("{IMAGES}{}", features.modalities.get(*place).map_or("", String::as_str));
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
