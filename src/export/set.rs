//! A dataset on the disk: a file of rows and a file of facts for each episode, and what is true of all of them.
//!
//! | file | |
//! |---|---|
//! | `data/chunk-CCC/file-FFF.parquet` | the rows of an episode |
//! | `videos/KEY/chunk-CCC/file-FFF.mp4` | the pictures of a camera, if they are in videos |
//! | `meta/episodes/chunk-CCC/file-FFF.parquet` | its length, task and statistics, and the file that it was made of (`rapid/...`) |
//! | `meta/tasks.parquet` | the tasks by number, as pandas writes them |
//! | `meta/stats.json`, `meta/info.json` | the statistics of all episodes; how many there are, and the features |
//!
//! Invariant: files get their names in this order when they are complete, so that a set whose writer was killed has all
//! its earlier episodes, or all and the last one.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use arrow_array::builder::{Float64Builder, Int64Builder, ListBuilder, StringBuilder};
use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int64Type};
use arrow_array::{Array, ArrayRef, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow_schema::{ArrowError, DataType, Field, Schema};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use rapid_episode::sha256;
use rapid_status::session::{Label, Notes};
use rapid_system::folder::{Folder, Links, Missing};
use rustix::fs::FlockOperation;
use serde_json::{Map, Value, json};

use super::cells::CellMaker;
use super::error::SetError;
use super::features::{Features, IMAGES, OWN};
use super::files::{self, CHUNK, NewFile, VIDEOS, numbered, write, write_parquet};
use super::owned;
use super::picture::Pictures;
use super::rows::{Index, Refusal};
use super::statistics::Column;
use super::survey::Survey;
use super::table::{Position, Table, one_row, timestamp};
use super::video::{Damaged, Encoded};

/// Bytes of a file in JSON, at most.
const LARGEST_JSON: u64 = 64 << 20;
/// Column of an episode's facts: the file's name, its SHA-256, its size, the verdict; and by modality the valid rows.
const SOURCE: &str = "rapid/source";
const SHA256: &str = "rapid/sha256";
const BYTES: &str = "rapid/bytes";
const VERDICT: &str = "rapid/verdict";
/// What people noted about the episode; empty where they did not.
const LABEL: &str = "rapid/label";
const LABEL_REASON: &str = "rapid/label_reason";
const NOTE: &str = "rapid/note";
const MARKS: &str = "rapid/marks";
/// As pandas names an index without a name.
const TASK: &str = "__index_level_0__";

/// An episode of a dataset.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub(super) source: String,
    sha256: String,
    pub(super) first: u64,
    pub(super) rows: u64,
    pub(super) task: u64,
    statistics: Statistics,
    /// `None` of an earlier version, which did not keep it.
    noted: Option<Notes>,
}

/// By feature, a column of it after the other.
type Statistics = BTreeMap<String, Vec<Column>>;

/// See the module's comment.
#[derive(Debug)]
pub struct DataSet {
    folder: PathBuf,
    /// Held open for its lock; `None` if there is none yet.
    lock: Option<Folder>,
    features: Option<Features>,
    tasks: Vec<String>,
    pub(super) entries: Vec<Entry>,
    statistics: Statistics,
}

impl DataSet {
    /// Opens the dataset in `folder`, or prepares a new one: a folder that does not exist is created with the first
    /// episode. What a program left that was killed is removed.
    ///
    /// # Errors
    /// When the folder holds anything else, or another program writes to it.
    pub fn open(folder: &Path) -> Result<Self, SetError> {
        let mut set = Self {
            folder: folder.to_owned(),
            lock: None,
            features: None,
            tasks: Vec::new(),
            entries: Vec::new(),
            statistics: Statistics::new(),
        };
        if !folder.exists() {
            return Ok(set);
        }
        set.lock(Missing::Refused)?;
        let info = folder.join("meta/info.json");
        if std::fs::symlink_metadata(&info).is_err() {
            owned::check(folder, None)?;
            return Ok(set);
        }
        let foreign = |problem: &str| SetError::Foreign { path: info.clone(), problem: problem.to_owned() };
        let text = rapid_system::folder::read_text(&info, LARGEST_JSON)
            .map_err(|source| SetError::Io { path: info.clone(), source })?;
        let value: Value = serde_json::from_str(&text).map_err(|error| foreign(&error.to_string()))?;
        let features = Features::of_set(&value);
        set.features = Some(features.ok_or_else(|| foreign("not the features of a dataset of this version of rapid"))?);
        set.read_tasks()?;
        while let Some(entry) = set.read_entry()? {
            merge(&mut set.statistics, &entry.statistics);
            set.entries.push(entry);
        }
        // Rows and videos whose facts are missing are removed: the program was killed between the two, and LeRobot would read
        // them.
        owned::check(folder, Some(set.entries.len() as u64))?;
        // The program was killed between an episode and the files about all of them.
        if value["total_episodes"].as_u64() != Some(set.entries.len() as u64) {
            set.publish()?;
        }
        Ok(set)
    }

    fn lock(&mut self, missing: Missing) -> Result<(), SetError> {
        if self.lock.is_some() {
            return Ok(());
        }
        let open = Folder::open(&self.folder, Links::Own, missing)?;
        rustix::fs::flock(open.descriptor(), FlockOperation::NonBlockingLockExclusive)
            .map_err(|_| SetError::Busy(self.folder.clone()))?;
        self.lock = Some(open);
        if missing == Missing::All {
            // It did not exist when the set was opened.
            owned::check(&self.folder, None)?;
        }
        Ok(())
    }

    /// Its folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// How it has its pictures, or has to get them.
    ///
    /// # Errors
    /// When it has them otherwise than `requested`.
    pub fn pictures(&self, requested: Option<Pictures>) -> Result<Pictures, SetError> {
        let of_set = self.features().map(Features::pictures);
        match (of_set, requested) {
            (Some(of_set), Some(requested)) if of_set != requested => {
                Err(SetError::Pictures { folder: self.folder.clone(), of_set, requested })
            }
            (of_set, requested) => Ok(of_set.or(requested).unwrap_or_default()),
        }
    }

    /// Begins to append: locks the set, which is created if there is none.
    ///
    /// # Errors
    /// When it cannot be created, or another program writes to it.
    pub fn begin(&mut self) -> Result<(), SetError> {
        self.lock(Missing::All)?;
        // LeRobot loads facts only if all of them have the same columns.
        let earlier = |(number, entry): (usize, &Entry)| entry.noted.is_none().then_some(number);
        let earlier: Vec<usize> = self.entries.iter().enumerate().filter_map(earlier).collect();
        earlier.into_iter().try_for_each(|number| self.note(number, &Notes::default()))
    }

    /// Notes what people noted about an episode that is there already.
    ///
    /// # Errors
    /// When its facts cannot be written.
    pub fn note(&mut self, number: usize, noted: &Notes) -> Result<(), SetError> {
        let path = self.entry_path(number as u64);
        let Some(entry) = self.entries.get_mut(number).filter(|entry| entry.noted.as_ref() != Some(noted)) else {
            return Ok(());
        };
        let wrong = |source| SetError::Parquet { path: path.clone(), source };
        let batch = one_row(&path).map_err(wrong)?;
        let batch =
            batch.ok_or_else(|| SetError::Foreign { path: path.clone(), problem: "not of one row".to_owned() })?;
        let texts = texts(noted);
        let mut row = OneRow::default();
        for (field, column) in batch.schema().fields().iter().zip(batch.columns()) {
            if texts.iter().all(|(key, _)| field.name() != key) {
                row.push(field.name(), Arc::clone(column));
            }
        }
        row.texts(texts);
        write_parquet(&path, row.batch())?;
        entry.noted = Some(noted.clone());
        Ok(())
    }

    /// Where these episodes will be if all of them are appended, in this order.
    pub fn positions<'e>(&self, episodes: impl IntoIterator<Item = &'e Survey>) -> Vec<Position> {
        let (mut tasks, mut next, mut first) = (self.tasks.clone(), self.entries.len() as u64, self.rows());
        let position = |episode: &Survey| {
            let task = task_number(&mut tasks, episode.task());
            let position = Position { episode: next, first, task };
            (next, first) = (next.saturating_add(1), first.saturating_add(episode.rows as u64));
            position
        };
        episodes.into_iter().map(position).collect()
    }

    /// How many episodes it has.
    pub fn episodes(&self) -> usize {
        self.entries.len()
    }

    /// How many rows it has.
    pub fn rows(&self) -> u64 {
        self.entries.iter().fold(0, |rows, entry| rows.saturating_add(entry.rows))
    }

    /// What its episodes have in common; `None` without any.
    pub fn features(&self) -> Option<&Features> {
        self.features.as_ref()
    }

    /// The number of the episode that was made of a file with this SHA-256.
    pub fn find(&self, sha256: &str) -> Option<usize> {
        self.entries.iter().position(|entry| entry.sha256 == sha256)
    }

    /// Appends an episode, and returns its number. Its features are those of the set, or become them. If the episodes before
    /// it were not all appended, its rows are written again.
    ///
    /// # Errors
    /// When a file cannot be written, the episode has changed since it was surveyed, or `stop` is set. The set is then as it
    /// was.
    pub fn append(
        &mut self,
        episode: &Survey,
        features: &Features,
        prepared: Prepared,
        stop: &AtomicBool,
    ) -> Result<usize, SetError> {
        self.lock(Missing::All)?;
        if stop.load(Ordering::Relaxed) {
            return Err(Refusal::Interrupted.into());
        }
        let (number, tasks) = (self.entries.len(), self.tasks.len());
        let task = task_number(&mut self.tasks, episode.task());
        let position = Position { episode: number as u64, first: self.rows(), task };
        let appended = self.append_at(position, episode, features, prepared, stop);
        if appended.is_err() {
            self.tasks.truncate(tasks);
        }
        appended.map(|()| number)
    }

    fn append_at(
        &mut self,
        position: Position,
        episode: &Survey,
        features: &Features,
        Prepared { position: expected, rows, encoded: Encoded { videos, damaged } }: Prepared,
        stop: &AtomicBool,
    ) -> Result<(), SetError> {
        let rows = if expected == position {
            rows
        } else {
            drop(rows);
            write_rows(&self.folder, episode, features, position, damaged, stop)?
        };
        for (video, (key, _)) in videos.into_iter().zip(features.videos()) {
            video.keep(&self.folder.join(files::video(&key, position.episode)))?;
        }
        rows.keep(&self.data_path(position.episode))?;
        let is_new = self.entries.iter().all(|entry| entry.task != position.task);
        if is_new {
            self.write_tasks()?;
        }
        let entry = Entry {
            source: episode.file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            sha256: episode.sha256.clone(),
            first: position.first,
            rows: episode.rows as u64,
            task: position.task,
            statistics: statistics(episode, features, position),
            noted: Some(episode.noted.clone()),
        };
        self.write_entry(&entry, episode, features, position)?;
        self.features.get_or_insert_with(|| features.clone());
        merge(&mut self.statistics, &entry.statistics);
        self.entries.push(entry);
        self.publish()
    }

    pub(super) fn data_path(&self, episode: u64) -> PathBuf {
        data_path(&self.folder, episode)
    }

    /// The videos of an episode, in the order of the cameras.
    pub(super) fn video_paths(&self, episode: u64) -> Vec<PathBuf> {
        let videos = self.features().into_iter().flat_map(Features::videos);
        videos.map(|(key, _)| self.folder.join(files::video(&key, episode))).collect()
    }

    fn entry_path(&self, episode: u64) -> PathBuf {
        self.folder.join(numbered("meta/episodes", episode, "parquet"))
    }

    /// Reads the facts of the next episode, if there is one.
    fn read_entry(&self) -> Result<Option<Entry>, SetError> {
        let path = self.entry_path(self.entries.len() as u64);
        if !path.exists() {
            return Ok(None);
        }
        let batch = one_row(&path).map_err(|source| SetError::Parquet { path: path.clone(), source })?;
        let entry = batch.and_then(|batch| self.entry_of(&batch));
        let problem = || "not the facts of an episode of rapid".to_owned();
        let entry = entry.ok_or_else(|| SetError::Foreign { path: path.clone(), problem: problem() })?;
        let number = self.entries.len() as u64;
        for path in self.video_paths(number).into_iter().chain([self.data_path(number)]) {
            std::fs::metadata(&path).map_err(|source| SetError::Io { path, source })?;
        }
        Ok(Some(entry))
    }

    fn entry_of(&self, batch: &RecordBatch) -> Option<Entry> {
        let text = |key: &str| {
            let column = batch.column_by_name(key)?.as_string_opt::<i32>()?;
            Some(column.value(0).to_owned())
        };
        let number = |key: &str| {
            let column = batch.column_by_name(key)?.as_primitive_opt::<Int64Type>()?;
            u64::try_from(column.value(0)).ok()
        };
        let task = batch.column_by_name("tasks")?.as_list_opt::<i32>()?.value(0);
        let task = task.as_string_opt::<i32>()?.iter().next()??.to_owned();
        let first = number("dataset_from_index")?;
        if number("episode_index")? != self.entries.len() as u64 || first != self.rows() {
            return None;
        }
        let mut statistics = Statistics::new();
        for feature in self.features.as_ref()?.all() {
            let key = feature.key;
            let counts = flat(batch.column_by_name(&format!("rapid/counts/{key}"))?)?;
            let mut columns: Vec<Column> = Vec::new();
            for count in counts.as_primitive_opt::<Int64Type>()?.values() {
                columns.push(Column { count: u64::try_from(*count).ok()?, ..Column::default() });
            }
            for (name, _) in Column::default().named() {
                let values = flat(batch.column_by_name(&format!("stats/{key}/{name}"))?)?;
                let values = values.as_primitive_opt::<Float64Type>()?;
                for (column, value) in columns.iter_mut().zip(values.values()) {
                    *column.place(name)? = *value;
                }
            }
            statistics.insert(key, columns);
        }
        Some(Entry {
            source: text(SOURCE)?,
            sha256: text(SHA256)?,
            first,
            rows: number("length")?,
            task: self.tasks.iter().position(|known| *known == task)? as u64,
            statistics,
            noted: noted(&text),
        })
    }

    fn write_entry(
        &self,
        entry: &Entry,
        episode: &Survey,
        features: &Features,
        position: Position,
    ) -> Result<(), SetError> {
        let mut row = OneRow::default();
        let (chunk, file) = (position.episode / CHUNK, position.episode % CHUNK);
        row.number("episode_index", position.episode);
        row.push("tasks", list(StringBuilder::new(), |builder| builder.append_value(episode.task())));
        row.number("length", entry.rows);
        for (key, value) in [
            ("data/chunk_index", chunk),
            ("data/file_index", file),
            ("dataset_from_index", entry.first),
            ("dataset_to_index", entry.first.saturating_add(entry.rows)),
            ("meta/episodes/chunk_index", chunk),
            ("meta/episodes/file_index", file),
            (BYTES, episode.bytes),
        ] {
            row.number(key, value);
        }
        for (key, _) in features.videos() {
            row.number(&format!("{VIDEOS}/{key}/chunk_index"), chunk);
            row.number(&format!("{VIDEOS}/{key}/file_index"), file);
            let end = entry.rows as f64 / f64::from(features.fps);
            for (name, time) in [("from_timestamp", 0.0), ("to_timestamp", end)] {
                row.push(&format!("{VIDEOS}/{key}/{name}"), Arc::new(Float64Array::from(vec![time])));
            }
        }
        row.texts([(SOURCE, &*entry.source), (SHA256, &*entry.sha256), (VERDICT, episode.grade.word())]);
        row.texts(texts(&episode.noted));
        for feature in features.all() {
            let key = feature.key;
            let columns = entry.statistics.get(&key).map_or(&[][..], Vec::as_slice);
            for (name, values) in by_name(columns) {
                let is_picture = key.starts_with(IMAGES);
                row.push(&format!("stats/{key}/{name}"), if is_picture { nested(&values) } else { floats(&values) });
            }
            row.push(&format!("stats/{key}/count"), integers([weight(columns)]));
            // By column: those of a sensor that was absent have none.
            row.push(&format!("rapid/counts/{key}"), integers(columns.iter().map(|column| column.count)));
        }
        write_parquet(&self.entry_path(position.episode), row.batch())
    }

    fn read_tasks(&mut self) -> Result<(), SetError> {
        let path = self.folder.join("meta/tasks.parquet");
        let wrong = |source| SetError::Parquet { path: path.clone(), source };
        let file = File::open(&path).map_err(|source| SetError::Io { path: path.clone(), source })?;
        let reader =
            ParquetRecordBatchReaderBuilder::try_new(file).and_then(ParquetRecordBatchReaderBuilder::<File>::build);
        for batch in reader.map_err(wrong)? {
            let batch = batch.map_err(|error| wrong(error.into()))?;
            let names = batch.column_by_name(TASK).and_then(|column| column.as_string_opt::<i32>());
            let problem = || format!("no column {TASK}");
            let names = names.ok_or_else(|| SetError::Foreign { path: path.clone(), problem: problem() })?;
            self.tasks.extend(names.iter().flatten().map(str::to_owned));
        }
        Ok(())
    }

    /// A table of pandas whose index are the texts, as `pandas.DataFrame.to_parquet` writes it.
    fn write_tasks(&self) -> Result<(), SetError> {
        let index = |name: Value, field: &str, of: &str, numpy: &str| {
            json!({
                "name": name, "field_name": field, "pandas_type": of, "numpy_type": numpy, "metadata": null,
            })
        };
        let pandas = json!({
            "index_columns": [TASK],
            "column_indexes": [{"name": null, "field_name": null, "pandas_type": "unicode", "numpy_type": "object",
                "metadata": {"encoding": "UTF-8"}}],
            "columns": [
                index(json!("task_index"), "task_index", "int64", "int64"),
                index(Value::Null, TASK, "unicode", "object"),
            ],
            "creator": {"library": "rapid", "version": env!("CARGO_PKG_VERSION")},
            "pandas_version": "2.0.0",
        });
        let numbers = (0_i64..).zip(&self.tasks).map(|(number, _)| number);
        let mut row = OneRow::default();
        row.push("task_index", Arc::new(Int64Array::from_iter_values(numbers)));
        row.push(TASK, Arc::new(StringArray::from_iter_values(&self.tasks)));
        row.metadata.insert("pandas".to_owned(), pandas.to_string());
        write_parquet(&self.folder.join("meta/tasks.parquet"), row.batch())
    }

    /// Writes what is true of all episodes.
    fn publish(&self) -> Result<(), SetError> {
        let Some(features) = &self.features else { return Ok(()) };
        let mut statistics = Map::new();
        for (key, columns) in &self.statistics {
            let is_picture = key.starts_with(IMAGES);
            let shaped = |value: f64| if is_picture { json!([[value]]) } else { json!(value) };
            let mut named = Map::new();
            for (name, values) in by_name(columns) {
                named.insert(name.to_owned(), values.into_iter().map(shaped).collect());
            }
            named.insert("count".to_owned(), json!([weight(columns)]));
            statistics.insert(key.clone(), Value::Object(named));
        }
        let (episodes, rows) = (self.entries.len(), self.rows());
        let videos = features.videos().next();
        let videos =
            videos.map(|_| format!("{VIDEOS}/{{video_key}}/chunk-{{chunk_index:03d}}/file-{{file_index:03d}}.mp4"));
        let info = json!({
            "codebase_version": "v3.0", "robot_type": "rapid", "total_episodes": episodes, "total_frames": rows,
            "total_tasks": self.tasks.len(), "chunks_size": CHUNK, "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200, "fps": features.fps, "splits": {"train": format!("0:{episodes}")},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": videos,
            "features": features.json(),
        });
        for (name, value) in [("meta/stats.json", Value::Object(statistics)), ("meta/info.json", info)] {
            write(&self.folder.join(name), format!("{value:#}\n").as_bytes())?;
        }
        Ok(())
    }
}

/// What people noted, as texts; the marks as JSON.
fn texts(notes: &Notes) -> [(&'static str, Cow<'_, str>); 4] {
    let label = notes.label.map(Label::word).unwrap_or_default();
    let marks = if notes.marks.is_empty() { String::new() } else { json!(notes.marks).to_string() };
    let own = [(LABEL, label), (LABEL_REASON, &*notes.label_reason), (NOTE, &*notes.note)];
    let [label, reason, note] = own.map(|(key, text)| (key, Cow::Borrowed(text)));
    [label, reason, note, (MARKS, Cow::Owned(marks))]
}

/// What is in an episode's facts; `None` if a text of it is missing.
fn noted(text: &dyn Fn(&str) -> Option<String>) -> Option<Notes> {
    let word = text(LABEL)?;
    let label = [Label::Success, Label::Failure].into_iter().find(|label| label.word() == word);
    let marks = text(MARKS)?;
    let marks = if marks.is_empty() { Vec::new() } else { serde_json::from_str(&marks).ok()? };
    Some(Notes { label, label_reason: text(LABEL_REASON)?, note: text(NOTE)?, marks })
}

fn data_path(folder: &Path, episode: u64) -> PathBuf {
    folder.join(numbered("data", episode, "parquet"))
}

/// The number of a task, which is added if it is new.
fn task_number(tasks: &mut Vec<String>, task: &str) -> u64 {
    let known = tasks.iter().position(|known| known == task);
    known.unwrap_or_else(|| {
        tasks.push(task.to_owned());
        tasks.len() - 1
    }) as u64
}

/// An episode that only lacks its names in the set: its videos, and its rows as they are at one position.
#[derive(Debug)]
pub struct Prepared {
    position: Position,
    rows: NewFile,
    encoded: Encoded,
}

/// Writes the rows of an episode for the dataset in `folder`, as they are at `position`. Several may be prepared at a time,
/// after [`DataSet::begin`], each for a position of its own: memory holds, of each of them, what is between a sample and its
/// frame, and one group of rows.
///
/// # Errors
/// When a file cannot be written, or the episode has changed since it was surveyed; also when `stop` is set.
pub fn prepare(
    folder: &Path,
    episode: &Survey,
    features: &Features,
    position: Position,
    encoded: Encoded,
    stop: &AtomicBool,
) -> Result<Prepared, SetError> {
    let rows = write_rows(folder, episode, features, position, encoded.damaged.clone(), stop)?;
    Ok(Prepared { position, rows, encoded })
}

fn write_rows(
    folder: &Path,
    episode: &Survey,
    features: &Features,
    position: Position,
    damaged: Damaged,
    stop: &AtomicBool,
) -> Result<NewFile, SetError> {
    let path = data_path(folder, position.episode);
    let new = NewFile::create(&path)?;
    let wrong = |source| SetError::Parquet { path: path.clone(), source };
    let mut table = Table::new(new.again()?, features, position).map_err(wrong)?;
    let mut maker = CellMaker::new(features, episode.kinds.clone())?;
    maker.damaged = damaged;
    let index = Index::read(&episode.file, stop)?;
    index.rows(&episode.file, stop, |row| table.push(&maker.cells(row)?).map_err(wrong))?;
    table.finish().map_err(wrong)?;
    // The statistics, and the name by which it is found again, are those of the survey.
    if sha256(&episode.file).map_err(Refusal::from)? != episode.sha256 {
        return Err(Refusal::Changed.into());
    }
    Ok(new)
}

/// The statistics of an episode, with those of the columns that every dataset has.
fn statistics(episode: &Survey, features: &Features, position: Position) -> Statistics {
    let mut statistics: Statistics = features.statistics(episode).into_iter().collect();
    let rows = 0..episode.rows as u64;
    let mut times: Vec<f64> = rows.clone().map(|row| f64::from(timestamp(row, features.fps))).collect();
    let [first, others @ ..] = OWN;
    statistics.insert(first.to_owned(), vec![Column::from_values(&mut times)]);
    for (at, key) in others.into_iter().enumerate() {
        let value = |row| position.own(row).get(at).map_or(0.0, |value| *value as f64);
        let mut values: Vec<f64> = rows.clone().map(value).collect();
        statistics.insert(key.to_owned(), vec![Column::from_values(&mut values)]);
    }
    statistics
}

fn merge(all: &mut Statistics, episode: &Statistics) {
    for (key, columns) in episode {
        let known = all.entry(key.clone()).or_default();
        known.resize(columns.len().max(known.len()), Column::default());
        for (known, column) in known.iter_mut().zip(columns) {
            *known = known.with(*column);
        }
    }
}

/// The `count` that LeRobot reads: the most valid rows that a column has, and never 0. Its `aggregate_stats` weights by it
/// and divides by the sum, so that a sensor that was absent everywhere would make not-a-number of what is merged. The
/// zeros of such a sensor count as one row: next to nothing beside a set that has the sensor.
fn weight(columns: &[Column]) -> u64 {
    columns.iter().map(|column| column.count).max().unwrap_or_default().max(1)
}

/// The columns' values of each statistic.
fn by_name(columns: &[Column]) -> Vec<(&'static str, Vec<f64>)> {
    let value = |at: usize| columns.iter().filter_map(move |column| column.named().nth(at)).map(|(_, value)| value);
    Column::default().named().enumerate().map(|(at, (name, _))| (name, value(at).collect())).collect()
}

/// A table of few rows, column by column.
#[derive(Default)]
struct OneRow {
    fields: Vec<Field>,
    columns: Vec<ArrayRef>,
    metadata: HashMap<String, String>,
}

impl OneRow {
    fn push(&mut self, key: &str, column: ArrayRef) {
        self.fields.push(Field::new(key, column.data_type().clone(), true));
        self.columns.push(column);
    }

    fn number(&mut self, key: &str, value: u64) {
        self.push(key, Arc::new(Int64Array::from(vec![i64::try_from(value).unwrap_or(i64::MAX)])));
    }

    fn texts(&mut self, texts: impl IntoIterator<Item = (&'static str, impl AsRef<str>)>) {
        for (key, text) in texts {
            self.push(key, Arc::new(StringArray::from(vec![text.as_ref()])));
        }
    }

    fn batch(self) -> Result<RecordBatch, ArrowError> {
        RecordBatch::try_new(Arc::new(Schema::new_with_metadata(self.fields, self.metadata)), self.columns)
    }
}

/// One list, filled by `fill`.
fn list<B: arrow_array::builder::ArrayBuilder>(values: B, fill: impl FnOnce(&mut B)) -> ArrayRef {
    let mut list = ListBuilder::new(values);
    fill(list.values());
    list.append(true);
    Arc::new(list.finish())
}

fn floats(values: &[f64]) -> ArrayRef {
    list(Float64Builder::new(), |builder| builder.append_slice(values))
}

fn integers(values: impl IntoIterator<Item = u64>) -> ArrayRef {
    let values = values.into_iter().map(|value| i64::try_from(value).unwrap_or(i64::MAX));
    list(Int64Builder::new(), |builder| values.for_each(|value| builder.append_value(value)))
}

/// `[[[a]], [[b]], [[c]]]`: a value for each channel, in the shape of a picture.
fn nested(values: &[f64]) -> ArrayRef {
    list(ListBuilder::new(ListBuilder::new(Float64Builder::new())), |channels| {
        for value in values {
            channels.values().values().append_value(*value);
            channels.values().append(true);
            channels.append(true);
        }
    })
}

/// The values of a list of lists, of all levels and rows.
fn flat(column: &ArrayRef) -> Option<ArrayRef> {
    let mut values = Arc::clone(column.as_list_opt::<i32>()?.values());
    while let DataType::List(_) = values.data_type() {
        values = Arc::clone(values.as_list_opt::<i32>()?.values());
    }
    Some(values)
}
