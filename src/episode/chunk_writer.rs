//! Writes the container of an episode: chunks of bounded size, each of which begins with the record that names its
//! episode and defines the channels.
//!
//! Invariant: if the episode of a file is known, every chunk can be read without the others.
//! Invariant: only whole chunks reach the sink.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};

use mcap::records::{MessageHeader, Metadata};
use mcap::write::{NoSeek, PrivateRecordOptions};
use mcap::{Attachment, McapError, WriteOptions, Writer};

use super::episode_id::EpisodeId;
use super::op;
use super::own::Own;

/// Bytes of records after which a chunk is closed. The writer keeps one chunk in memory.
const CHUNK_BYTES: u64 = 1 << 20;
/// Bytes of records up to which a chunk is small.
const SMALL_BYTES: u64 = 64 << 10;
/// Gathers the small records between chunks (message indexes) into one write.
const BUFFER_BYTES: usize = 64 << 10;
/// Bytes that may be spent on definitions repeated in chunks: of any file, and for each byte of its other records. A hostile file
/// of many short chunks would otherwise become thousands of times as long when it is repaired.
const REPEATED: (u64, u64) = (16 << 20, 8);
/// Opcode and length of a record.
const HEAD: u64 = 9;
/// Bytes of a message before its data.
const MESSAGE: usize = 22;
/// Bytes, at most, in an index: of a message, of a channel of a chunk, of any other record beside its name.
const INDEXED: (u64, u64, u64) = (16, 32, 256);
/// Bytes, at most, of a summary without indexes and definitions.
const SUMMARY: u64 = 4 << 10;

pub(crate) struct ChunkWriter<S: Write> {
    writer: Writer<NoSeek<BufWriter<S>>>,
    own: Option<Own>,
    /// Bytes of records in the open chunk, if there is one.
    open: u64,
    /// Bytes, at most, of the index of the open chunk, and of the summary.
    index: u64,
    summary: u64,
    channels: u64,
    /// Remaining bytes for definitions in chunks; beyond them a chunk only names the episode.
    spare: u64,
}

impl<S: Sink> ChunkWriter<S> {
    /// Begins a file on `sink`. Without an `episode` its chunks carry no such record.
    pub(crate) fn new(sink: S, episode: Option<EpisodeId>) -> io::Result<Self> {
        // JPEG does not compress and raw frames are rare: no codec, so that the thread's time goes
        // into the disk and every reader can read. Without seeking the writer keeps a chunk in
        // memory until it is whole. Chunks are closed here, before the writer would: it does not report when it does.
        let options = WriteOptions::new()
            .compression(None)
            .chunk_size(Some(CHUNK_BYTES + BUFFER_BYTES as u64))
            .disable_seeking(true)
            .library(concat!("rapid/", env!("CARGO_PKG_VERSION")));
        let sink = NoSeek::new(BufWriter::with_capacity(BUFFER_BYTES, sink));
        let writer = Writer::with_options(sink, options).map_err(io_error)?;
        Ok(Self {
            writer,
            own: episode.map(Own::new),
            open: 0,
            index: 0,
            summary: SUMMARY,
            channels: 0,
            spare: REPEATED.0,
        })
    }

    /// Makes every later chunk name `episode`, unless they already do or a channel is defined.
    pub(crate) fn belong(&mut self, episode: Option<EpisodeId>) {
        if self.own.is_none() && self.open == 0 {
            self.own = episode.map(Own::new);
        }
    }

    /// Makes room for a record with this many bytes of content.
    fn room(&mut self, bytes: usize) -> Result<(), McapError> {
        if self.open > CHUNK_BYTES {
            self.flush()?;
        }
        if let Some(own) = self.own.as_ref().filter(|_| self.open == 0) {
            let content = if own.content().len() as u64 <= self.spare { own.content() } else { own.episode() };
            self.spare = self.spare.saturating_sub(content.len() as u64);
            self.writer.write_private_record(op::OWN, content, PrivateRecordOptions::IncludeInChunks.into())?;
            self.open = HEAD + content.len() as u64;
        }
        self.open += HEAD + bytes as u64;
        self.spare = self.spare.saturating_add(REPEATED.1.saturating_mul(bytes as u64));
        Ok(())
    }

    /// The open chunk, if there is one, ends.
    fn close(&mut self) {
        self.summary += if self.open > 0 { INDEXED.2 + INDEXED.1 * self.channels } else { 0 };
        (self.open, self.index) = (0, 0);
    }

    /// Bytes, at most, that the sink does not have yet, and that the end of the file adds.
    pub(crate) fn outstanding(&self) -> u64 {
        let chunk = self.open + self.index + INDEXED.2 + INDEXED.1 * self.channels;
        BUFFER_BYTES as u64 + chunk + self.summary
    }

    fn define(&mut self, opcode: u8, record: &[u8]) {
        // The summary has it again.
        self.summary += HEAD + record.len() as u64;
        if let Some(own) = &mut self.own {
            own.define(opcode, record);
        }
    }

    /// Adds a schema, of the number `id` or of any; returns its number.
    pub(crate) fn schema(
        &mut self,
        id: Option<u16>,
        name: &str,
        encoding: &str,
        data: &[u8],
    ) -> Result<u16, McapError> {
        let mut record = [&[0; 2][..], &text(name), &text(encoding), &counted(data)].concat();
        self.room(record.len())?;
        let id = match id {
            Some(id) => self.writer.add_schema_with_id(id, name, encoding, data)?,
            None => self.writer.add_schema(name, encoding, data)?,
        };
        number(&mut record, id);
        self.define(op::SCHEMA, &record);
        Ok(id)
    }

    /// Adds a channel, of the number `id` or of any; returns its number.
    pub(crate) fn channel(&mut self, id: Option<u16>, channel: &Channel<'_>) -> Result<u16, McapError> {
        let Channel { schema, topic, encoding, metadata } = *channel;
        let pairs: Vec<u8> = metadata.iter().flat_map(|(key, value)| [text(key), text(value)].concat()).collect();
        let mut record = [&[0; 2][..], &schema.to_le_bytes(), &text(topic), &text(encoding), &counted(&pairs)].concat();
        self.room(record.len())?;
        let id = match id {
            Some(id) => self.writer.add_channel_with_id(id, schema, topic, encoding, metadata)?,
            None => self.writer.add_channel(schema, topic, encoding, metadata)?,
        };
        number(&mut record, id);
        self.channels += 1;
        self.define(op::CHANNEL, &record);
        Ok(id)
    }

    /// Writes a message on a channel that was added.
    pub(crate) fn message(&mut self, header: &MessageHeader, data: &[u8]) -> Result<(), McapError> {
        self.room(MESSAGE + data.len())?;
        self.index += INDEXED.0;
        self.writer.write_to_known_channel(header, data)
    }

    /// Writes another program's private record.
    pub(crate) fn private(&mut self, opcode: u8, data: &[u8]) -> Result<(), McapError> {
        self.room(data.len())?;
        self.writer.write_private_record(opcode, data, PrivateRecordOptions::IncludeInChunks.into())
    }

    /// Writes an attachment, which ends the chunk.
    pub(crate) fn attach(&mut self, attachment: &Attachment<'_>) -> Result<(), McapError> {
        self.close();
        self.summary += INDEXED.2 + (attachment.name.len() + attachment.media_type.len()) as u64;
        self.writer.attach(attachment)
    }

    /// Writes metadata, which end the chunk.
    pub(crate) fn metadata(&mut self, name: &str, metadata: BTreeMap<String, String>) -> Result<(), McapError> {
        self.close();
        self.summary += INDEXED.2 + name.len() as u64;
        self.writer.write_metadata(&Metadata { name: name.to_owned(), metadata })
    }

    /// Ends the chunk if it is not small: copied records keep the chunk sizes of the original.
    pub(crate) fn part(&mut self) -> Result<(), McapError> {
        if self.open > SMALL_BYTES { self.flush() } else { Ok(()) }
    }

    /// Ends the chunk and hands everything to the sink.
    pub(crate) fn flush(&mut self) -> Result<(), McapError> {
        self.close();
        self.writer.flush()
    }

    /// Ends the file; returns once all of it is on the disk.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        self.writer.finish().map_err(io_error)?;
        let buffered = self.writer.into_inner().into_inner();
        let mut sink = buffered.into_inner().map_err(io::IntoInnerError::into_error)?;
        sink.sync()
    }
}

/// A channel to be added.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Channel<'a> {
    pub(crate) schema: u16,
    pub(crate) topic: &'a str,
    pub(crate) encoding: &'a str,
    pub(crate) metadata: &'a BTreeMap<String, String>,
}

/// Bytes with their count before them, as MCAP has them.
fn counted(bytes: &[u8]) -> Vec<u8> {
    let count = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
    [&count.to_le_bytes(), bytes].concat()
}

fn text(text: &str) -> Vec<u8> {
    counted(text.as_bytes())
}

/// Writes the number of a definition into its record.
fn number(record: &mut [u8], id: u16) {
    if let Some(place) = record.first_chunk_mut() {
        *place = id.to_le_bytes();
    }
}

/// The system's own error where there is one: it is more exact than the writer's.
pub(crate) fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}

/// A destination of an episode's bytes.
pub trait Sink: Write + Send {
    /// Returns once everything written is on the disk.
    ///
    /// # Errors
    /// When the disk does not take it.
    fn sync(&mut self) -> io::Result<()>;
}

impl Sink for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

impl Sink for &mut Vec<u8> {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}
