//! Copying: from what can be read of a file to a whole one.
//!
//! Channels and schemas keep their numbers, messages their order; what lies in a damaged chunk is
//! left out, what lies before a cut is taken.

use std::collections::BTreeSet;
use std::io::{self, BufReader, BufWriter, Read};
use std::ops::ControlFlow;

use mcap::records::{MessageHeader, Metadata};
use mcap::write::{NoSeek, PrivateRecordOptions};
use mcap::{Attachment, McapError, Writer};

use super::super::file::{self, Sink};
use super::super::walk::{FileEnd, Record, Trust, Walk, op};
use super::super::wire::Fields;
use super::said;
use super::{Watch, summary::Summary};
use crate::episode_format::{RECOVERED, SUMMARY, is_sound};

/// Bytes read between two calls of a [`Watch`].
const WATCH_EVERY: u64 = 1 << 20;
/// Bytes read at once.
const BUFFER_BYTES: usize = 1 << 16;

/// Why copying ended.
#[derive(Debug)]
pub(super) enum Error {
    Read(io::Error),
    Write(io::Error),
    Interrupted,
}

/// What is said about the repair itself.
#[derive(Debug, Clone, Copy)]
pub(super) struct About<'a> {
    /// The original.
    pub(super) name: &'a str,
    /// Wall time now.
    pub(super) time_ns: u64,
}

/// What of the original is not in the copy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Damage {
    pub(super) end: FileEnd,
    pub(super) unread_bytes: u64,
    pub(super) damaged_chunks: u64,
    pub(super) refused_records: u64,
    /// The original is whole as a container.
    pub(super) sound: bool,
}

impl Damage {
    /// Is nothing of the original left out but a torn end?
    pub(super) fn is_lossless(self) -> bool {
        let torn_at_most = self.sound || matches!(self.end, FileEnd::Unfinished | FileEnd::Torn);
        torn_at_most && self.damaged_chunks == 0 && self.refused_records == 0
    }
}

/// A whole file was written.
#[derive(Debug)]
pub(super) struct Copied {
    pub(super) summary: Summary,
    pub(super) damage: Damage,
}

/// What a file holds. `None`: no MCAP file.
pub(super) fn summary(file: impl Read, size: u64, watch: &mut Watch<'_>) -> Result<Option<Summary>, Error> {
    let Some(mut walk) = open(file, size)? else { return Ok(None) };
    let mut summary = Summary::default();
    let mut watched = 0;
    while let Some(record) = walk.next().map_err(Error::Read)? {
        if record.trust != Trust::Damaged {
            summary.record(record.opcode, record.data);
        }
        look(&walk, size, &mut watched, watch)?;
    }
    summary.sound(walk.walked().sound);
    Ok(Some(summary))
}

/// Writes to `sink` a whole file of what can be read of `file`, `size` bytes long; channels that it
/// lacks are taken from `known`. Returns once it is on the disk. `None`: no MCAP file.
pub(super) fn copy(
    file: impl Read,
    size: u64,
    known: &Summary,
    about: &About<'_>,
    sink: impl Sink,
    watch: &mut Watch<'_>,
) -> Result<Option<Copied>, Error> {
    let Some(mut walk) = open(file, size)? else { return Ok(None) };
    let mut copy = Copy::new(sink, known)?;
    let mut watched = 0;
    while let Some(record) = walk.next().map_err(Error::Read)? {
        copy.take(&record)?;
        look(&walk, size, &mut watched, watch)?;
    }
    let walked = walk.walked();
    let damage = Damage {
        end: walked.end,
        unread_bytes: size.saturating_sub(walked.bytes),
        damaged_chunks: walked.damaged_chunks,
        refused_records: copy.refused.saturating_add(walked.oversized),
        sound: walked.sound,
    };
    let summary = copy.finish(damage, about, size)?;
    Ok(Some(Copied { summary, damage }))
}

/// The whole file that repair makes of `bytes`, which may be any; `None` if they are no MCAP file.
/// Nothing of it touches a disk.
#[must_use]
pub fn recover_bytes(bytes: &[u8]) -> Option<Vec<u8>> {
    let size = bytes.len() as u64;
    let go_on = &mut |_, _| ControlFlow::Continue(());
    let known = summary(bytes, size, go_on).ok()??;
    let about = About { name: "bytes.mcap", time_ns: 0 };
    let mut whole = Vec::new();
    // Memory takes what is written to it.
    copy(bytes, size, &known, &about, &mut whole, go_on).ok()??;
    Some(whole)
}

impl Sink for &mut Vec<u8> {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// One that grows meanwhile is read as it was.
fn open<R: Read>(file: R, size: u64) -> Result<Option<Walk<impl Read + use<R>>>, Error> {
    Walk::new(BufReader::with_capacity(BUFFER_BYTES, file.take(size)), size).map_err(Error::Read)
}

fn look<R: Read>(walk: &Walk<R>, size: u64, watched: &mut u64, watch: &mut Watch<'_>) -> Result<(), Error> {
    let done = walk.walked().bytes;
    if done.saturating_sub(*watched) < WATCH_EVERY {
        return Ok(());
    }
    *watched = done;
    match watch(done, size) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(Error::Interrupted),
    }
}

/// The file being written.
struct Copy<'a, S: Sink> {
    writer: Writer<NoSeek<BufWriter<S>>>,
    known: &'a Summary,
    /// Channels and schemas of `known` that were asked for.
    asked: BTreeSet<(u8, u16)>,
    summary: Summary,
    refused: u64,
}

impl<'a, S: Sink> Copy<'a, S> {
    fn new(sink: S, known: &'a Summary) -> Result<Self, Error> {
        let writer = file::writer(sink).map_err(Error::Write)?;
        Ok(Self { writer, known, asked: BTreeSet::new(), summary: Summary::default(), refused: 0 })
    }

    /// Writes a record; one that cannot be meant as it stands is counted.
    fn take(&mut self, record: &Record<'_>) -> Result<(), Error> {
        let Record { opcode, data, trust } = *record;
        if trust == Trust::Damaged {
            return Ok(());
        }
        let written = match opcode {
            op::SCHEMA => self.schema(data),
            op::CHANNEL => self.channel(data),
            op::MESSAGE => self.message(data),
            op::ATTACHMENT => self.attachment(data),
            op::METADATA => self.metadata(data),
            op::PRIVATE.. => {
                Some(self.writer.write_private_record(opcode, data, PrivateRecordOptions::IncludeInChunks.into()))
            }
            // The container's own, which has no place in a chunk.
            _ => return Ok(()),
        };
        match written {
            Some(Ok(())) => {
                self.summary.record(opcode, data);
                Ok(())
            }
            None
            | Some(Err(
                McapError::ConflictingSchemas(_)
                | McapError::ConflictingChannels(_)
                | McapError::InvalidSchemaId
                | McapError::UnknownChannel(..),
            )) => {
                self.refused += 1;
                Ok(())
            }
            Some(Err(error)) => Err(Error::Write(file::io_error(error))),
        }
    }

    fn schema(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let mut fields = Fields(data);
        let id = fields.u16()?;
        let (name, encoding) = (fields.string()?, fields.string()?);
        let count = fields.u32()?;
        let data = fields.bytes(count.into())?;
        Some(self.writer.add_schema_with_id(id, name, encoding, data).map(drop))
    }

    fn channel(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let mut fields = Fields(data);
        let (id, schema) = (fields.u16()?, fields.u16()?);
        let (topic, encoding) = (fields.string()?, fields.string()?);
        let metadata = fields.map()?;
        if let Err(error) = self.ask(op::SCHEMA, schema) {
            return Some(Err(error));
        }
        let added = match self.writer.add_channel_with_id(id, schema, topic, encoding, &metadata) {
            // Better a channel that cannot be decoded than none.
            Err(McapError::UnknownSchema(..)) => {
                self.refused += 1;
                self.writer.add_channel_with_id(id, 0, topic, encoding, &metadata)
            }
            added => added,
        };
        Some(added.map(drop))
    }

    fn message(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let mut fields = Fields(data);
        let (channel_id, sequence) = (fields.u16()?, fields.u32()?);
        let (log_time, publish_time) = (fields.u64()?, fields.u64()?);
        if !self.summary.has_channel(channel_id)
            && let Err(error) = self.ask(op::CHANNEL, channel_id)
        {
            return Some(Err(error));
        }
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        Some(self.writer.write_to_known_channel(&header, fields.0))
    }

    fn attachment(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let (content, crc) = data.split_last_chunk()?;
        let crc = u32::from_le_bytes(*crc);
        if !is_sound(content, crc) {
            return None;
        }
        let mut fields = Fields(content);
        let (log_time, create_time) = (fields.u64()?, fields.u64()?);
        let (name, media_type) = (fields.string()?.to_owned(), fields.string()?.to_owned());
        let count = fields.u64()?;
        let data = fields.bytes(count)?.into();
        Some(self.writer.attach(&Attachment { log_time, create_time, name, media_type, data }))
    }

    fn metadata(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let mut fields = Fields(data);
        let name = fields.string()?.to_owned();
        let metadata = fields.map()?;
        Some(self.writer.write_metadata(&Metadata { name, metadata }))
    }

    /// Takes over what `known` says a channel or schema is, once.
    fn ask(&mut self, opcode: u8, id: u16) -> Result<(), McapError> {
        if !self.asked.insert((opcode, id)) {
            return Ok(());
        }
        let Some(record) = self.known.definition(opcode, id) else { return Ok(()) };
        let taken = if opcode == op::SCHEMA { self.schema(record) } else { self.channel(record) };
        match taken {
            Some(Err(error @ McapError::Io(_))) => return Err(error),
            Some(Ok(())) => self.summary.record(opcode, record),
            _ => {}
        }
        Ok(())
    }

    fn finish(mut self, damage: Damage, about: &About<'_>, size: u64) -> Result<Summary, Error> {
        let finished = (|| {
            if !self.summary.has_end {
                let metadata = said::end(&self.summary);
                self.writer.write_metadata(&Metadata { name: SUMMARY.to_owned(), metadata })?;
            }
            let metadata = said::recovered(&self.summary, damage, about, size);
            self.writer.write_metadata(&Metadata { name: RECOVERED.to_owned(), metadata })?;
            self.writer.finish()
        })();
        finished.map_err(|error| Error::Write(file::io_error(error)))?;
        let buffered = self.writer.into_inner().into_inner();
        let mut sink = buffered.into_inner().map_err(|error| Error::Write(error.into_error()))?;
        sink.sync().map_err(Error::Write)?;
        Ok(self.summary)
    }
}
