//! The rows of an episode as a Parquet file, and the way back.
//!
//! Format: <https://parquet.apache.org/docs/file-format/>, columns as `datasets` stores the features of LeRobot: a
//! feature of shape `[1]` is a plain number, one of `[n]` a list of fixed size, a picture `{bytes, path}`.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow_array::builder::{BinaryBuilder, StringBuilder};
use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Float64Type, Int64Type};
use arrow_array::{
    Array, ArrayRef, FixedSizeListArray, Float32Array, Float64Array, Int64Array, RecordBatch, StructArray,
};
use arrow_schema::{ArrowError, DataType, Field, Fields, Schema};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::{ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder};
use parquet::basic::Compression;
use parquet::errors::ParquetError;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;

use super::cells::Cells;
use super::features::{ACTION, AGE, Feature, Features, MASK, OWN, PLUGGED, STATE, TIME, VALID};
use super::files::CREATED_BY;

/// Bytes of pictures, and rows, of a group of rows: a reader loads a group at once.
const GROUP: (usize, usize) = (32 << 20, 1000);
/// Rows read at once.
const READ: usize = 64;

/// Where an episode is in a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    pub(super) episode: u64,
    /// Its first row, counted over all episodes.
    pub(super) first: u64,
    pub(super) task: u64,
}

impl Position {
    /// The values of [`OWN`] but the first, in their order.
    pub(super) fn own(self, row: u64) -> [i64; 4] {
        [row, self.episode, self.first.saturating_add(row), self.task]
            .map(|value| i64::try_from(value).unwrap_or(i64::MAX))
    }
}

/// The time of a row from the beginning of its episode, seconds: what LeRobot expects, within 1e-4.
pub(super) fn timestamp(row: u64, fps: u32) -> f32 {
    super::survey::narrow(row as f64 / f64::from(fps))
}

/// How the rows are written, with these features of pictures: they are compressed already, and none is there twice.
fn properties(pictures: &[String]) -> WriterProperties {
    let mut properties =
        WriterProperties::builder().set_compression(Compression::UNCOMPRESSED).set_created_by(CREATED_BY.to_owned());
    for key in pictures {
        let path = ColumnPath::new(vec![key.clone(), "bytes".to_owned()]);
        properties = properties
            .set_column_dictionary_enabled(path.clone(), false)
            .set_column_statistics_enabled(path, EnabledStatistics::None);
    }
    properties.build()
}

/// Rows that are not written yet.
#[derive(Default)]
struct Columns {
    pictures: Vec<BinaryBuilder>,
    state: Vec<f32>,
    action: Vec<f32>,
    mask: Vec<f32>,
    plugged: Vec<f32>,
    valid: Vec<f32>,
    age: Vec<f64>,
    time_ns: Vec<i64>,
    timestamp: Vec<f32>,
    own: [Vec<i64>; 4],
    bytes: usize,
}

/// A file being written.
pub(super) struct Table {
    writer: ArrowWriter<File>,
    schema: Arc<Schema>,
    features: Vec<Feature>,
    fps: u32,
    position: Position,
    columns: Columns,
    rows: u64,
}

impl Table {
    pub(super) fn new(file: File, features: &Features, position: Position) -> Result<Self, ParquetError> {
        let fps = features.fps;
        // Those in videos have no column.
        let features: Vec<Feature> = features.all().into_iter().filter(|feature| feature.dtype != "video").collect();
        let schema = Arc::new(Schema::new(features.iter().map(field).collect::<Vec<_>>()));
        let pictures: Vec<String> =
            features.iter().filter(|feature| feature.dtype == "image").map(|feature| feature.key.clone()).collect();
        let writer = ArrowWriter::try_new(file, Arc::clone(&schema), Some(properties(&pictures)))?;
        let columns = empty(pictures.len());
        Ok(Self { writer, schema, features, fps, position, columns, rows: 0 })
    }

    /// Writes the next row.
    pub(super) fn push(&mut self, cells: &Cells<'_>) -> Result<(), ParquetError> {
        let columns = &mut self.columns;
        for (column, picture) in columns.pictures.iter_mut().zip(&cells.pictures) {
            column.append_value(picture);
            columns.bytes += picture.len();
        }
        columns.state.extend(&cells.state);
        columns.action.extend(&cells.action);
        columns.mask.extend(&cells.mask);
        columns.plugged.extend(&cells.plugged);
        columns.valid.extend(&cells.valid);
        columns.age.extend(&cells.age);
        columns.time_ns.push(cells.time_ns);
        columns.timestamp.push(timestamp(self.rows, self.fps));
        for (column, value) in columns.own.iter_mut().zip(self.position.own(self.rows)) {
            column.push(value);
        }
        self.rows += 1;
        if columns.bytes >= GROUP.0 || columns.time_ns.len() >= GROUP.1 { self.flush() } else { Ok(()) }
    }

    /// Ends the file; returns it.
    pub(super) fn finish(mut self) -> Result<File, ParquetError> {
        self.flush()?;
        self.writer.into_inner()
    }

    fn flush(&mut self) -> Result<(), ParquetError> {
        let next = empty(self.columns.pictures.len());
        let columns = std::mem::replace(&mut self.columns, next);
        if columns.time_ns.is_empty() {
            return Ok(());
        }
        let batch = self.batch(columns)?;
        self.writer.write(&batch)?;
        self.writer.flush()
    }

    fn batch(&self, mut columns: Columns) -> Result<RecordBatch, ArrowError> {
        let mut pictures = std::mem::take(&mut columns.pictures).into_iter();
        let mut own = std::mem::take(&mut columns.own).into_iter();
        let mut arrays = Vec::with_capacity(self.features.len());
        for feature in &self.features {
            let floats = |values: &mut Vec<f32>| Arc::new(Float32Array::from(std::mem::take(values))) as ArrayRef;
            arrays.push(match feature.key.as_str() {
                STATE => listed(feature, floats(&mut columns.state))?,
                ACTION => listed(feature, floats(&mut columns.action))?,
                MASK => listed(feature, floats(&mut columns.mask))?,
                PLUGGED => listed(feature, floats(&mut columns.plugged))?,
                VALID => listed(feature, floats(&mut columns.valid))?,
                AGE => listed(feature, Arc::new(Float64Array::from(std::mem::take(&mut columns.age))))?,
                TIME => Arc::new(Int64Array::from(std::mem::take(&mut columns.time_ns))),
                "timestamp" => floats(&mut columns.timestamp),
                key if OWN.contains(&key) => Arc::new(Int64Array::from(own.next().unwrap_or_default())),
                _ => pictured(&mut pictures.next().unwrap_or_default())?,
            });
        }
        RecordBatch::try_new(Arc::clone(&self.schema), arrays)
    }
}

fn empty(cameras: usize) -> Columns {
    Columns { pictures: (0..cameras).map(|_| BinaryBuilder::new()).collect(), ..Columns::default() }
}

fn element(feature: &Feature) -> DataType {
    match feature.dtype {
        "float32" => DataType::Float32,
        "float64" => DataType::Float64,
        _ => DataType::Int64,
    }
}

/// The length of a list; `None` of a plain number.
fn length(feature: &Feature) -> Option<i32> {
    feature.shape.first().filter(|length| **length != 1).and_then(|length| i32::try_from(*length).ok())
}

fn file_fields() -> Fields {
    Fields::from(vec![Field::new("bytes", DataType::Binary, true), Field::new("path", DataType::Utf8, true)])
}

fn item(feature: &Feature) -> Arc<Field> {
    Arc::new(Field::new("item", element(feature), true))
}

fn field(feature: &Feature) -> Field {
    let data_type = match (feature.dtype, length(feature)) {
        ("image", _) => DataType::Struct(file_fields()),
        (_, Some(length)) => DataType::FixedSizeList(item(feature), length),
        (_, None) => element(feature),
    };
    Field::new(&feature.key, data_type, true)
}

fn listed(feature: &Feature, values: ArrayRef) -> Result<ArrayRef, ArrowError> {
    match length(feature) {
        Some(length) => Ok(Arc::new(FixedSizeListArray::try_new(item(feature), length, values, None)?)),
        None => Ok(values),
    }
}

fn pictured(files: &mut BinaryBuilder) -> Result<ArrayRef, ArrowError> {
    let files = files.finish();
    let mut paths = StringBuilder::new();
    paths.append_nulls(files.len());
    let columns: Vec<ArrayRef> = vec![Arc::new(files), Arc::new(paths.finish())];
    Ok(Arc::new(StructArray::try_new(file_fields(), columns, None)?))
}

/// A table being read, row by row.
pub(super) struct Rows {
    batches: ParquetRecordBatchReader,
    batch: Option<RecordBatch>,
    /// Of the next row in the batch.
    at: usize,
}

impl Rows {
    pub(super) fn open(file: File) -> Result<Self, ParquetError> {
        let batches = ParquetRecordBatchReaderBuilder::try_new(file)?.with_batch_size(READ).build()?;
        Ok(Self { batches, batch: None, at: 0 })
    }

    /// The next row; `None` at the end.
    pub(super) fn advance(&mut self) -> Result<Option<RowView<'_>>, ArrowError> {
        self.at += 1;
        while self.batch.as_ref().is_none_or(|batch| self.at >= batch.num_rows()) {
            self.at = 0;
            match self.batches.next() {
                None => return Ok(None),
                Some(batch) => self.batch = Some(batch?),
            }
        }
        Ok(self.batch.as_ref().map(|batch| RowView { batch, at: self.at }))
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct RowView<'a> {
    batch: &'a RecordBatch,
    at: usize,
}

impl<'a> RowView<'a> {
    /// The numbers of a feature: `None` if it is absent or of another type.
    pub(super) fn numbers(&self, key: &str) -> Option<Vec<f64>> {
        let column = self.batch.column_by_name(key)?;
        match column.as_fixed_size_list_opt() {
            Some(lists) => floats(&lists.value(self.at)),
            None => floats(&column.slice(self.at, 1)),
        }
    }

    pub(super) fn integer(&self, key: &str) -> Option<i64> {
        let column = self.batch.column_by_name(key)?.as_primitive_opt::<Int64Type>()?;
        column.is_valid(self.at).then(|| column.value(self.at))
    }

    /// The file of a picture.
    pub(super) fn picture(&self, key: &str) -> Option<&'a [u8]> {
        let files = self.batch.column_by_name(key)?.as_struct_opt()?.column_by_name("bytes")?.as_binary_opt::<i32>()?;
        files.is_valid(self.at).then(|| files.value(self.at))
    }
}

/// The numbers of an array.
fn floats(array: &dyn Array) -> Option<Vec<f64>> {
    if let Some(values) = array.as_primitive_opt::<Float32Type>() {
        return Some(values.values().iter().map(|value| f64::from(*value)).collect());
    }
    array.as_primitive_opt::<Float64Type>().map(|values| values.values().to_vec())
}

/// A file of Parquet that holds one row, as a batch.
pub(super) fn one_row(path: &Path) -> Result<Option<RecordBatch>, ParquetError> {
    let file = File::open(path)?;
    let batches: Result<Vec<_>, _> = ParquetRecordBatchReaderBuilder::try_new(file)?.build()?.collect();
    let batches = batches?;
    Ok(match batches.as_slice() {
        [batch] if batch.num_rows() == 1 => Some(batch.clone()),
        _ => None,
    })
}
