//! A recorded episode as a file: what is in it, and its messages one by one.
//!
//! Invariant: lengths found in the file are checked against the file before memory is taken.

use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};

use mcap::records::Record;
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use mcap::{McapError, Summary};

use super::wire::{self, Schema};
use super::{DriverError, fatal};
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;

/// Largest record or chunk that is read; a 4K raw picture has 16 MiB.
const RECORD_LIMIT: usize = 256 << 20;
const MASK_TOPIC: &str = "/rapid/mask";
/// Name of the metadata record that holds layout and registry.
const METADATA: &str = "rapid";

/// What an episode holds.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeDescription {
    /// Wall time of the first message, ns since 1970.
    pub begin_ns: u64,
    /// Wall time of the last message, ns since 1970.
    pub end_ns: u64,
    /// Topics, by name.
    pub topics: Vec<TopicDescription>,
    /// Names and bits of the modalities, by bit.
    pub layout: Vec<(String, ModalityId)>,
    /// Text of the `devices.toml` it was recorded with.
    pub registry: String,
    /// The mask at its first record and after each change, with wall time in ns, ascending.
    pub mask: Vec<(u64, PhysicalMask)>,
}

/// A topic of an episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicDescription {
    /// Name.
    pub topic: String,
    /// Name of the schema, for example `foxglove.CompressedImage`.
    pub schema: String,
    /// Encoding of the messages, for example `protobuf`.
    pub message_encoding: String,
    /// Messages, if the file counts them.
    pub messages: Option<u64>,
}

/// What is in `file`. Reads the whole of it, a chunk at a time, for the mask's changes; blocks.
///
/// # Errors
/// When the file cannot be read, or is damaged or was never closed.
pub fn describe(file: &Path) -> Result<EpisodeDescription, DriverError> {
    Episode::open(file)?.describe()
}

/// An open file with its index.
pub(super) struct Episode {
    path: PathBuf,
    file: Source,
    summary: Summary,
}

impl Episode {
    pub(super) fn open(path: &Path) -> Result<Self, DriverError> {
        let file = File::open(path).map_err(|error| fatal(path, error))?;
        let length = file.metadata().map_err(|error| fatal(path, error))?.len();
        let file = Source { file, length };
        let summary = match file.summary() {
            Ok(Some(summary)) => summary,
            Ok(None) | Err(McapError::BadMagic) => {
                return Err(fatal(
                    path,
                    "has no index: it was not closed, and cannot be played; `rapid inspect` reads what is there",
                ));
            }
            Err(error) => return Err(fatal(path, format!("its index cannot be read: {error}"))),
        };
        Ok(Self { path: path.to_owned(), file, summary })
    }

    /// The messages of `topic` from `from_ns` on, and what they are.
    pub(super) fn play(self, topic: &str, from_ns: u64) -> Result<(Messages, Schema), DriverError> {
        let Some(channel) = self.summary.channels.values().find(|channel| channel.topic == topic) else {
            let mut topics: Vec<&str> = self.summary.channels.values().map(|channel| channel.topic.as_str()).collect();
            topics.sort_unstable();
            return Err(fatal(&self.path, format!("has no topic {topic}; it has {}", topics.join(", "))));
        };
        let name = channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
        let Some(schema) = Schema::named(name).filter(|_| channel.message_encoding == "protobuf") else {
            return Err(fatal(&self.path, format!("{topic} holds {name:?} messages, which no device sends")));
        };
        let messages = self.messages(topic, from_ns)?;
        Ok((messages, schema))
    }

    fn messages(self, topic: &str, from_ns: u64) -> Result<Messages, DriverError> {
        let channels =
            self.summary.channels.values().filter(|channel| channel.topic == topic).map(|channel| channel.id).collect();
        let reader = if self.summary.chunk_indexes.is_empty() {
            // Not chunked: messages stand in the file in the order they were written.
            Reader::Linear(Box::new(LinearReader::new_with_options(
                LinearReaderOptions::default().with_record_length_limit(RECORD_LIMIT),
            )))
        } else {
            let options = IndexedReaderOptions::new()
                .include_topics([topic])
                .starting_at(from_ns)
                .with_record_length_limit(RECORD_LIMIT);
            let reader = IndexedReader::new_with_options(&self.summary, options)
                .map_err(|error| fatal(&self.path, format!("its index cannot be used: {error}")))?;
            Reader::Indexed(Box::new(reader))
        };
        Ok(Messages { file: self.file, reader, channels, from_ns, chunk: Vec::new(), position: 0 })
    }

    fn describe(self) -> Result<EpisodeDescription, DriverError> {
        let statistics = self.summary.stats.as_ref();
        let mut topics: Vec<TopicDescription> = self
            .summary
            .channels
            .values()
            .map(|channel| TopicDescription {
                topic: channel.topic.clone(),
                schema: channel.schema.as_ref().map_or_else(String::new, |schema| schema.name.clone()),
                message_encoding: channel.message_encoding.clone(),
                messages: statistics.and_then(|counts| counts.channel_message_counts.get(&channel.id).copied()),
            })
            .collect();
        topics.sort_by(|a, b| a.topic.cmp(&b.topic));
        let times = statistics.map(|times| (times.message_start_time, times.message_end_time)).unwrap_or_default();
        let (layout, registry) = self.metadata()?;
        let path = self.path.clone();
        let mask = if topics.iter().any(|topic| topic.topic == MASK_TOPIC) {
            mask_changes(self.messages(MASK_TOPIC, 0)?).map_err(|error| fatal(&path, error))?
        } else {
            Vec::new()
        };
        let (begin_ns, end_ns) = times;
        Ok(EpisodeDescription { begin_ns, end_ns, topics, layout, registry, mask })
    }

    /// Layout by bit and registry text; empty where the file holds none.
    fn metadata(&self) -> Result<(Vec<(String, ModalityId)>, String), DriverError> {
        let Some(index) = self.summary.metadata_indexes.iter().find(|index| index.name == METADATA) else {
            return Ok((Vec::new(), String::new()));
        };
        let damaged = |why: &dyn std::fmt::Display| fatal(&self.path, format!("its metadata cannot be read: {why}"));
        let mut bytes = Vec::new();
        self.file.read(index.offset, index.length, &mut bytes).map_err(|error| damaged(&error))?;
        // A record is its opcode, its length as u64, its content (mcap.dev/spec, "Records").
        let (Some(&opcode), Some(body)) = (bytes.first(), bytes.get(9..)) else {
            return Err(damaged(&"it is too short"));
        };
        let mut metadata = match mcap::parse_record(opcode, body) {
            Ok(Record::Metadata(metadata)) => metadata.metadata,
            Ok(_) => return Err(damaged(&"the index points elsewhere")),
            Err(error) => return Err(damaged(&error)),
        };
        let layout = metadata.remove("layout").unwrap_or_default();
        let layout: std::collections::BTreeMap<String, u8> = if layout.is_empty() {
            std::collections::BTreeMap::new()
        } else {
            serde_json::from_str(&layout).map_err(|error| damaged(&error))?
        };
        let mut layout: Vec<_> =
            layout.into_iter().filter_map(|(name, bit)| Some((name, ModalityId::new(bit)?))).collect();
        layout.sort_by_key(|(_, id)| *id);
        Ok((layout, metadata.remove("registry").unwrap_or_default()))
    }
}

/// The first mask and each that differs from the one before. Damage ends the list early.
fn mask_changes(mut messages: Messages) -> Result<Vec<(u64, PhysicalMask)>, McapError> {
    let mut changes: Vec<(u64, PhysicalMask)> = Vec::new();
    while let Some(message) = messages.next()? {
        let Some(mask) = wire::mask(message.data) else { continue };
        if changes.last().is_none_or(|(_, last)| *last != mask) {
            changes.push((message.log_time, mask));
        }
    }
    Ok(changes)
}

/// The file and its length.
struct Source {
    file: File,
    length: u64,
}

impl Source {
    /// Reads `length` bytes at `offset`, which must lie in the file.
    fn read(&self, offset: u64, length: u64, into: &mut Vec<u8>) -> Result<(), McapError> {
        let ends = offset.checked_add(length).ok_or(McapError::BadIndex)?;
        let length = usize::try_from(length).map_err(|_| McapError::BadIndex)?;
        if ends > self.length || length > RECORD_LIMIT {
            return Err(McapError::BadIndex);
        }
        into.resize(length, 0);
        self.file.read_exact_at(into, offset).map_err(McapError::from)
    }

    fn summary(&self) -> Result<Option<Summary>, McapError> {
        let options =
            SummaryReaderOptions::default().with_file_size(self.length).with_record_length_limit(RECORD_LIMIT);
        let mut reader = SummaryReader::new_with_options(options);
        let mut position = 0_u64;
        while let Some(event) = reader.next_event() {
            match event? {
                SummaryReadEvent::ReadRequest(wished) => {
                    let count = self.file.read_at(reader.insert(wished), position)?;
                    position += count as u64;
                    reader.notify_read(count);
                }
                SummaryReadEvent::SeekRequest(to) => {
                    position = match to {
                        std::io::SeekFrom::Start(offset) => offset,
                        std::io::SeekFrom::End(offset) => self.length.saturating_add_signed(offset),
                        std::io::SeekFrom::Current(offset) => position.saturating_add_signed(offset),
                    };
                    if position > self.length {
                        return Err(McapError::BadIndex);
                    }
                    reader.notify_seeked(position);
                }
            }
        }
        Ok(reader.finish())
    }
}

impl std::fmt::Debug for Messages {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Messages").field("channels", &self.channels).finish_non_exhaustive()
    }
}

/// The messages of a topic, ascending by log time where the file has an index of its chunks.
pub(super) struct Messages {
    file: Source,
    reader: Reader,
    channels: Vec<u16>,
    from_ns: u64,
    chunk: Vec<u8>,
    position: u64,
}

enum Reader {
    Indexed(Box<IndexedReader>),
    Linear(Box<LinearReader>),
}

/// One message of the topic.
pub(super) struct Recorded<'a> {
    pub(super) log_time: u64,
    pub(super) data: &'a [u8],
}

impl Messages {
    /// The next message; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<Recorded<'_>>, McapError> {
        match &mut self.reader {
            Reader::Indexed(reader) => next_indexed(reader, &self.file, &mut self.chunk),
            Reader::Linear(reader) => {
                next_linear(reader, &self.file, &mut self.position, &self.channels, self.from_ns, &mut self.chunk)
            }
        }
    }
}

fn next_indexed<'a>(
    reader: &mut IndexedReader,
    file: &Source,
    chunk: &'a mut Vec<u8>,
) -> Result<Option<Recorded<'a>>, McapError> {
    loop {
        let (offset, length) = match reader.next_event() {
            None => return Ok(None),
            Some(event) => match event? {
                IndexedReadEvent::ReadChunkRequest { offset, length } => (offset, length),
                IndexedReadEvent::Message { header, data } => {
                    // Copied: the borrow of a message cannot leave the loop that also reads chunks.
                    chunk.clear();
                    chunk.extend_from_slice(data);
                    return Ok(Some(Recorded { log_time: header.log_time, data: chunk }));
                }
            },
        };
        file.read(offset, length as u64, chunk)?;
        reader.insert_chunk_record_data(offset, chunk)?;
    }
}

fn next_linear<'a>(
    reader: &mut LinearReader,
    file: &Source,
    position: &mut u64,
    channels: &[u16],
    from_ns: u64,
    message: &'a mut Vec<u8>,
) -> Result<Option<Recorded<'a>>, McapError> {
    loop {
        let wished = match reader.next_event() {
            None => return Ok(None),
            Some(event) => match event? {
                LinearReadEvent::ReadRequest(wished) => wished,
                LinearReadEvent::Record { opcode, data } => {
                    // The footer is the last record of interest.
                    if opcode == mcap::records::op::DATA_END {
                        return Ok(None);
                    }
                    if opcode != mcap::records::op::MESSAGE {
                        continue;
                    }
                    let Record::Message { header, data } = mcap::parse_record(opcode, data)? else { continue };
                    if !channels.contains(&header.channel_id) || header.log_time < from_ns {
                        continue;
                    }
                    message.clear();
                    message.extend_from_slice(&data);
                    return Ok(Some(Recorded { log_time: header.log_time, data: message }));
                }
            },
        };
        // A length from a damaged record must not take more memory than the file has bytes.
        let left = file.length.saturating_sub(*position);
        let wished = wished.min(usize::try_from(left).unwrap_or(usize::MAX));
        let count = file.file.read_at(reader.insert(wished), *position)?;
        *position += count as u64;
        reader.notify_read(count);
    }
}
