//! What an episode holds and whether it can be exported: everything that can refuse it is found here, before anything is
//! written.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use rapid_core::modality::{ModalityId, ModalityKind};
use rapid_core::text;
use rapid_episode::record::inspect::{self, Inspection, Judgement};
use rapid_episode::record_iter::FileEnd;
use rapid_pictures::pixels::{CHANNELS, Picture, Pixels};
use rapid_registry::{ExportSpec, Form, Registry};
use rapid_status::session::Notes;
use rapid_status::{Grade, Verdict};

use super::picture::{self, Shape};
use super::rows::{Form as SampleForm, Index, Listed, Payload, Refusal, Row, Topic, Unfit};
use super::statistics::Column;

/// Of a picture with more pixels along a side, every n-th of each row and column counts for the statistics, so that
/// about 150 are left, as in `lerobot.datasets.compute_stats.auto_downsample_height_width`.
const WIDE: u32 = 300;
const ABOUT_LEFT: u32 = 150;

/// Which verdicts an episode may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdicts<'a> {
    /// GOOD and SUSPECT.
    Fit,
    /// Every one.
    All,
    /// These.
    Only(&'a [Grade]),
}

/// An episode that can be exported.
#[derive(Debug)]
pub struct Survey {
    /// The file.
    pub file: PathBuf,
    /// Its size in bytes.
    pub bytes: u64,
    /// SHA-256 of the file, hexadecimal: by it an episode is recognised in a dataset.
    pub sha256: String,
    /// The verdict on it.
    pub grade: Grade,
    /// What people noted about it; nothing until it is set.
    pub noted: Notes,
    /// Rows it becomes.
    pub rows: usize,
    /// Samples that belong to a row and cannot be used: damaged pictures, numbers that are not finite. Their rows are
    /// black or zero, and not valid.
    pub unusable: u64,
    /// The same by sensor, with the reason; and actions that no row has.
    pub unfit: Vec<Unfit>,
    pub(super) fps: u32,
    pub(super) task: String,
    /// Ascending by bit.
    pub(super) streams: Vec<Stream>,
    /// What `[export]` of its registry chooses; nothing where that cannot be read.
    pub export: ExportSpec,
    /// Why the registry in the episode cannot be read, if it cannot: then nothing chooses columns, and numbers have no names.
    pub unread_registry: Option<String>,
    /// The names of the axes of an action, if its channel has them.
    pub(super) action_names: Vec<String>,
    /// By axis; `None` without actions.
    pub(super) action: Option<Vec<Column>>,
    pub(super) time_ns: Column,
    /// By modality.
    pub(super) kinds: Vec<ModalityKind>,
    /// By modality.
    pub(super) bits: Vec<ModalityId>,
    /// Those with messages.
    pub(super) topics: Vec<Topic>,
}

/// What a modality has in all rows of an episode.
#[derive(Debug)]
pub(super) struct Stream {
    pub(super) name: String,
    pub(super) content: Content,
    /// Of numbers that its registry names: their names.
    pub(super) names: Vec<String>,
    /// A picture's channels or a vector's columns, over the valid rows.
    pub(super) columns: Vec<Column>,
    pub(super) present: Column,
    pub(super) plugged: Column,
    pub(super) valid: Column,
    pub(super) age: Column,
}

/// What the samples of a modality are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Content {
    /// Pictures; their shape, if one is there.
    Camera { found: Option<Shape>, declared: Option<Shape> },
    /// Numbers; how many.
    Vector { found: Option<usize>, declared: Option<usize> },
    /// Bytes, which are not exported.
    Bytes,
}

/// Looks at the episode at `path`; `sha256` is that of the file. One with another verdict than `verdicts` is refused.
///
/// # Errors
/// When it cannot be exported, whatever the dataset; also when `stop` is set.
pub fn survey(path: &Path, sha256: String, verdicts: Verdicts<'_>, stop: &AtomicBool) -> Result<Survey, Refusal> {
    let inspection = inspect::inspect(path)?;
    let grade = judged(&inspection, verdicts)?;
    let index = Index::read(path, stop)?;
    if index.modalities.iter().all(|modality| matches!(modality.kind, ModalityKind::Bytes | ModalityKind::Depth)) {
        return Err(Refusal::Nothing);
    }
    let mut found = RowCollector::new(&index);
    index.rows(path, stop, |row| {
        found.add(row);
        Ok::<_, Refusal>(())
    })?;
    let RowCollector { gatherers, time_ns: mut times, actions } = found;
    let unusable = gatherers.iter().map(|gatherer| gatherer.unusable as u64).sum();
    let unfit = unfit(&index, &gatherers);
    let rows = index.ticks.len();
    let (registry, unread_registry) = registry_of(&index.registry);
    let named = |gatherer: Gatherer| {
        let form = registry.as_ref().and_then(|registry| registry.named(&gatherer.name)?.form.as_ref());
        Stream { names: form.map(Form::names).unwrap_or_default(), ..gatherer.stream(rows) }
    };
    Ok(Survey {
        file: path.to_owned(),
        bytes: inspection.bytes,
        sha256,
        grade,
        noted: Notes::default(),
        rows,
        unusable,
        unfit,
        fps: index.fps,
        task: index.task.clone(),
        streams: gatherers.into_iter().map(named).collect(),
        export: registry.as_ref().map(|registry| registry.export.clone()).unwrap_or_default(),
        unread_registry,
        action_names: index.action_names.clone(),
        action: index.action_length().map(|_| columns(actions)),
        time_ns: Column::from_values(&mut times),
        kinds: index.modalities.iter().map(|modality| modality.kind).collect(),
        bits: index.modalities.iter().map(|modality| modality.bit).collect(),
        topics: index.topics,
    })
}

/// The registry in an episode, or why it cannot be read; neither if the episode carries none. What an earlier version wrote
/// may not be read any more.
fn registry_of(text: &str) -> (Option<Registry>, Option<String>) {
    if text.is_empty() {
        return (None, None);
    }
    match Registry::parse(text, None) {
        Ok(loaded) => (Some(loaded.registry), None),
        Err(errors) => (None, Some(errors.to_string())),
    }
}

/// The verdict, of a whole file.
fn judged(inspection: &Inspection, verdicts: Verdicts<'_>) -> Result<Grade, Refusal> {
    let Judgement::Episode(Verdict { grade, .. }) = &inspection.verdict else { return Err(Refusal::NotOurs) };
    match inspection.end {
        FileEnd::Finished => {}
        FileEnd::Unfinished => return Err(Refusal::Unfinished),
        FileEnd::Torn => return Err(Refusal::Damaged("its end is missing".to_owned())),
        FileEnd::Damaged => return Err(Refusal::Damaged("its end is not a record".to_owned())),
    }
    let (chunks, bytes) = (inspection.damaged_chunks, inspection.unread_bytes);
    if chunks > 0 || bytes > 0 || inspection.left_out != inspect::LeftOut::default() {
        let chunks = text::counted(chunks, "damaged chunk");
        return Err(Refusal::Damaged(format!("{chunks}, {} that cannot be read", text::size(bytes))));
    }
    match verdicts {
        Verdicts::Fit if *grade == Grade::Bad => Err(Refusal::Bad(inspection.verdict.reasons().join("; "))),
        Verdicts::Only(grades) if !grades.contains(grade) => Err(Refusal::NotSelected(*grade)),
        Verdicts::Fit | Verdicts::All | Verdicts::Only(_) => Ok(*grade),
    }
}

/// Collects what is in the rows.
struct RowCollector {
    gatherers: Vec<Gatherer>,
    time_ns: Vec<f64>,
    /// By axis.
    actions: Vec<Vec<f64>>,
}

impl RowCollector {
    fn new(index: &Index) -> Self {
        let of = |(at, modality)| Gatherer::new(modality, pictured_rows(index, at));
        let gatherers = index.modalities.iter().enumerate().map(of).collect();
        let actions = vec![Vec::new(); index.action_length().unwrap_or_default()];
        Self { gatherers, time_ns: Vec::new(), actions }
    }

    fn add(&mut self, row: &Row<'_>) {
        self.time_ns.push(row.time_ns as f64);
        for (axis, value) in self.actions.iter_mut().zip(row.action) {
            // In the precision of the dataset.
            axis.push(f64::from(narrow(*value)));
        }
        for ((gatherer, slot), sample) in self.gatherers.iter_mut().zip(row.slots).zip(row.samples) {
            let is_usable = match sample {
                Some(payload) => gatherer.add(row.number, payload, slot.valid),
                None => false,
            };
            gatherer.unusable += usize::from(sample.is_some() && !is_usable);
            gatherer.present += u64::from(slot.present);
            gatherer.plugged += u64::from(slot.plugged);
            if slot.valid && is_usable {
                gatherer.ages.push(slot.age_ns as f64 / 1e9);
            }
        }
    }
}

/// What no row shows, by sensor: samples of another form, and those that are damaged.
fn unfit(index: &Index, gatherers: &[Gatherer]) -> Vec<Unfit> {
    let damaged = |gatherer: &Gatherer| {
        let others = index.unfit.iter().filter(|unfit| unfit.name == gatherer.name).map(|unfit| unfit.count);
        let count = gatherer.unusable.saturating_sub(others.sum());
        (count > 0).then(|| Unfit { name: gatherer.name.clone(), count, reason: "damaged".to_owned() })
    };
    index.unfit.iter().cloned().chain(gatherers.iter().filter_map(damaged)).collect()
}

/// The nearest number of the precision that a dataset has.
pub(super) fn narrow(value: f64) -> f32 {
    #[expect(clippy::cast_possible_truncation, reason = "features of LeRobot are f32")]
    let narrow = value as f32;
    narrow
}

fn columns(values: Vec<Vec<f64>>) -> Vec<Column> {
    values.into_iter().map(|mut values| Column::from_values(&mut values)).collect()
}

/// Can a sample of this kind of modality be used?
pub(super) fn is_usable(kind: ModalityKind, payload: &Payload) -> bool {
    match (kind, payload) {
        (ModalityKind::Image, payload) => picture::shape(payload).is_some(),
        (ModalityKind::Scalars, Payload::Numbers(numbers)) => {
            !numbers.is_empty() && numbers.iter().all(|number| narrow(*number).is_finite())
        }
        (ModalityKind::Scalars, Payload::Picture { .. }) => false,
        (ModalityKind::Bytes | ModalityKind::Depth, _) => true,
    }
}

/// Rows of which the picture is decoded for the statistics, ascending: as many as
/// `lerobot.datasets.compute_stats.estimate_num_samples` takes of so many, at equal distances among the valid ones.
fn pictured_rows(index: &Index, modality: usize) -> Vec<usize> {
    let is_valid = |row: &usize| index.slots(*row).get(modality).is_some_and(|slot| slot.valid);
    let valid: Vec<usize> = (0..index.ticks.len()).filter(is_valid).collect();
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "less than the number of rows")]
    let wanted = ((valid.len() as f64).powf(0.75) as usize).clamp(100, 10_000).min(valid.len());
    (0..wanted).filter_map(|at| valid.get(at * valid.len() / wanted).copied()).collect()
}

/// Collects what one modality has.
struct Gatherer {
    name: String,
    kind: ModalityKind,
    content: Content,
    present: u64,
    plugged: u64,
    /// Rows whose sample cannot be used.
    unusable: usize,
    ages: Vec<f64>,
    /// By column, of the valid rows.
    numbers: Vec<Vec<f64>>,
    /// By channel.
    levels: [[u64; 256]; CHANNELS],
    pictured: Vec<usize>,
    pixels: Pixels,
}

impl Gatherer {
    fn new(modality: &Listed, pictured: Vec<usize>) -> Self {
        let content = match (modality.kind, modality.declared()) {
            (ModalityKind::Image, Some(SampleForm::Picture(shape))) => {
                Content::Camera { found: None, declared: Some(shape) }
            }
            (ModalityKind::Image, _) => Content::Camera { found: None, declared: None },
            (ModalityKind::Scalars, Some(SampleForm::Numbers(length))) => {
                Content::Vector { found: None, declared: Some(length) }
            }
            (ModalityKind::Scalars, _) => Content::Vector { found: None, declared: None },
            (ModalityKind::Bytes | ModalityKind::Depth, _) => Content::Bytes,
        };
        Self {
            name: modality.name.clone(),
            kind: modality.kind,
            content,
            present: 0,
            plugged: 0,
            unusable: 0,
            ages: Vec::new(),
            numbers: Vec::new(),
            levels: [[0; 256]; CHANNELS],
            pictured,
            pixels: Pixels::default(),
        }
    }

    /// Takes the sample of a row; returns whether it can be used. All have one form.
    fn add(&mut self, row: usize, payload: &Payload, is_valid: bool) -> bool {
        if !is_usable(self.kind, payload) {
            return false;
        }
        match (&mut self.content, payload) {
            (Content::Camera { found, .. }, Payload::Picture { encoding, width, height, bytes }) => {
                *found = found.or_else(|| picture::shape(payload));
                if is_valid && self.pictured.binary_search(&row).is_ok() {
                    let picture = Picture { encoding: *encoding, width: *width, height: *height, bytes };
                    self.count_levels(&picture);
                }
            }
            (Content::Vector { found, .. }, Payload::Numbers(numbers)) => {
                *found = Some(numbers.len());
                self.numbers.resize(numbers.len(), Vec::new());
                if is_valid {
                    for (column, number) in self.numbers.iter_mut().zip(numbers) {
                        column.push(f64::from(narrow(*number)));
                    }
                }
            }
            _ => {}
        }
        true
    }

    /// Counts the levels of a picture's pixels; one that is damaged within does not count.
    fn count_levels(&mut self, picture: &Picture<'_>) {
        let Ok([height, width]) = self.pixels.decode(picture) else { return };
        let longest = picture.width.max(picture.height);
        let step = usize::try_from(if longest < WIDE { 1 } else { longest / ABOUT_LEFT }).unwrap_or(1).max(1);
        for row in (0..height).step_by(step) {
            let line = self.pixels.values().get(CHANNELS * width * row..CHANNELS * width * (row + 1));
            for pixel in line.unwrap_or_default().chunks_exact(CHANNELS).step_by(step) {
                for (levels, value) in self.levels.iter_mut().zip(pixel) {
                    if let Some(count) = levels.get_mut(usize::from(*value)) {
                        *count += 1;
                    }
                }
            }
        }
    }

    fn stream(mut self, rows: usize) -> Stream {
        let (rows, valid) = (rows as u64, self.ages.len() as u64);
        let columns = match self.content {
            Content::Camera { found, .. } => {
                let channels = found.map_or(CHANNELS, |shape| usize::from(shape.channels));
                self.levels.iter().take(channels).map(|levels| Column::of_levels(levels, valid)).collect()
            }
            Content::Vector { found, declared } => {
                self.numbers.resize(found.or(declared).unwrap_or_default(), Vec::new());
                columns(self.numbers)
            }
            Content::Bytes => Vec::new(),
        };
        Stream {
            name: self.name,
            content: self.content,
            names: Vec::new(),
            columns,
            present: Column::of_flags(self.present, rows),
            plugged: Column::of_flags(self.plugged, rows),
            valid: Column::of_flags(valid, rows),
            age: Column::from_values(&mut self.ages),
        }
    }
}

impl Survey {
    /// How many axes an action has; `None` without any on `/action`.
    pub(super) fn action_length(&self) -> Option<usize> {
        self.action.as_ref().map(Vec::len)
    }

    /// The task in words: LeRobot needs one.
    pub(super) fn task(&self) -> &str {
        if self.task.is_empty() { "episode" } else { &self.task }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn why_a_registry_in_an_episode_cannot_be_read_is_reported() {
        let (registry, reason) = registry_of(rapid_registry::BUILTIN);
        assert_eq!((registry.is_some(), reason), (true, None));
        let (registry, reason) = registry_of("[rig]\nobservation_hertz = 30\n");
        assert!(registry.is_none() && reason.is_some_and(|reason| reason.contains("observation_hertz")));
        let (registry, reason) = registry_of("");
        assert!(registry.is_none() && reason.is_none());
    }
}
