//! Copying: from what can be read of a file to a whole one.
//!
//! Channels and schemas keep their numbers, messages their order; what the walk through the file leaves out is
//! counted.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::ops::ControlFlow;

use mcap::records::MessageHeader;
use mcap::{Attachment, McapError};
use sha2::{Digest, Sha256};

use super::super::chunks::{Channel, Chunks, io_error};
use super::super::file::Sink;
use super::super::walk::{Record, Walk, Walked, op};
use super::super::wire::Fields;
use super::said;
use super::{Watch, summary::Summary};
use crate::episode_format::{Failed, RECOVERED, ReadAt, SUMMARY, is_sound, own};

/// Bytes read between two calls of a [`Watch`]; what is read in vain, in search of a chunk, counts too.
const WATCH_EVERY: u64 = 1 << 20;
/// Bytes read at once where only their hash is wanted.
const PIECE: usize = 256 << 10;

/// Why copying ended.
#[derive(Debug)]
pub(super) enum Error {
    Read(io::Error),
    Write(io::Error),
    Interrupted,
}

/// What is said about the repair itself.
#[derive(Debug, Clone)]
pub(super) struct About<'a> {
    /// The original.
    pub(super) name: &'a str,
    /// Its SHA-256, hexadecimal.
    pub(super) sha256: String,
    /// Wall time now.
    pub(super) time_ns: u64,
    /// The present boot, if that is to prove what was written last: see [`Walk::of_boot`].
    pub(super) boot: Option<String>,
    /// What the original's recorder wrote behind it.
    pub(super) failed: Option<&'a Failed>,
}

/// What of the original is not in the copy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Damage {
    pub(super) walked: Walked,
    pub(super) unread_bytes: u64,
    /// Records that contradict others.
    pub(super) refused_records: u64,
    /// Messages left out because nothing says what their channel is, by its number.
    pub(super) nameless: BTreeMap<u16, u64>,
    /// Why the original's recorder called it BAD.
    pub(super) failed: Option<String>,
}

impl Damage {
    /// Is nothing of the original left out but a torn end?
    pub(super) fn is_lossless(&self) -> bool {
        self.walked.is_all() && self.refused_records == 0
    }
}

/// A whole file was written.
#[derive(Debug)]
pub(super) struct Copied {
    pub(super) summary: Summary,
    pub(super) damage: Damage,
}

/// What a file holds. `None`: no MCAP file.
pub(super) fn summary(file: impl ReadAt, size: u64, watch: &mut Watch<'_>) -> Result<Option<Summary>, Error> {
    let file = Watched::new(file, size, watch);
    let Some(mut walk) = Walk::new(&file, size).map_err(|error| file.error(error))? else { return Ok(None) };
    let mut summary = Summary::default();
    while let Some(record) = walk.next().map_err(|error| file.error(error))? {
        summary.record(record.opcode, record.data);
        file.done.set(walk.walked().bytes);
    }
    summary.walked(&walk.walked());
    Ok(Some(summary))
}

/// Writes to `sink` a whole file of what can be read of `file`, `size` bytes long. Returns once it is on the disk.
/// `None`: no MCAP file.
pub(super) fn copy(
    file: impl ReadAt,
    size: u64,
    about: &About<'_>,
    sink: impl Sink,
    watch: &mut Watch<'_>,
) -> Result<Option<Copied>, Error> {
    let file = Watched::new(file, size, watch);
    let recorded = about.failed.map_or(size, |failed| failed.at);
    let Some(walk) = Walk::new(&file, recorded).map_err(|error| file.error(error))? else { return Ok(None) };
    let mut walk = walk.of_boot(about.boot.clone());
    let mut copy = Copy::new(sink, about.failed.map(|failed| failed.why.clone()))?;
    while walk.advance().map_err(|error| file.error(error))? {
        // As in the original, one damaged byte costs no more than one of its chunks.
        if walk.walked().bytes != file.done.get() {
            copy.writer.part().map_err(|error| Error::Write(io_error(error)))?;
        }
        copy.writer.belong(walk.episode());
        copy.take(&walk.record())?;
        file.done.set(walk.walked().bytes);
    }
    let walked = walk.walked();
    let damage = Damage {
        walked,
        unread_bytes: walked.unread(recorded),
        refused_records: copy.refused,
        nameless: walk.nameless().clone(),
        // Or of the file from which that one was made.
        failed: copy.failed.take().or_else(|| copy.summary.failed.take()),
    };
    let summary = copy.finish(&damage, about, size)?;
    Ok(Some(Copied { summary, damage }))
}

/// The SHA-256 of the first `size` bytes of `file`, hexadecimal.
pub(super) fn sha256(file: &File, size: u64, watch: &mut Watch<'_>) -> Result<String, Error> {
    let file = Watched::new(file, size, watch);
    let (mut hasher, mut piece) = (Sha256::new(), vec![0; PIECE]);
    let mut done = 0;
    while done < size {
        let count = usize::try_from(size - done).unwrap_or(usize::MAX).min(PIECE);
        let Some(room) = piece.get_mut(..count) else { break };
        let read = match file.read_at(room, done) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            read => read.map_err(|error| file.error(error))?,
        };
        if read == 0 {
            break;
        }
        hasher.update(room.get(..read).unwrap_or_default());
        done += read as u64;
        file.done.set(done);
    }
    let digit = |nibble: u8| char::from_digit(nibble.into(), 16).unwrap_or_default();
    Ok(hasher.finalize().iter().flat_map(|byte| [digit(byte >> 4), digit(byte & 0xf)]).collect())
}

/// The whole file that repair makes of `bytes`, which may be any; `None` if they are no MCAP file.
/// Nothing of it touches a disk, and nothing proves what a torn chunk holds.
#[must_use]
pub fn recover_bytes(bytes: &[u8]) -> Option<Vec<u8>> {
    let size = bytes.len() as u64;
    let about = About { name: "bytes.mcap", sha256: String::new(), time_ns: 0, boot: None, failed: None };
    let mut whole = Vec::new();
    // Memory takes what is written to it.
    copy(bytes, size, &about, &mut whole, &mut |_, _| ControlFlow::Continue(())).ok()??;
    Some(whole)
}

impl Sink for &mut Vec<u8> {
    fn sync(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A file that has its [`Watch`] called while it is read, for whatever purpose.
struct Watched<'a, 'w, R> {
    file: R,
    size: u64,
    /// Bytes understood so far.
    done: Cell<u64>,
    /// Bytes read since the last call.
    read: Cell<u64>,
    interrupted: Cell<bool>,
    watch: RefCell<&'a mut Watch<'w>>,
}

impl<'a, 'w, R> Watched<'a, 'w, R> {
    fn new(file: R, size: u64, watch: &'a mut Watch<'w>) -> Self {
        let (done, read, interrupted) = (Cell::default(), Cell::default(), Cell::default());
        Self { file, size, done, read, interrupted, watch: RefCell::new(watch) }
    }

    /// What an error of reading means.
    fn error(&self, error: io::Error) -> Error {
        if self.interrupted.get() { Error::Interrupted } else { Error::Read(error) }
    }
}

impl<R: ReadAt> ReadAt for Watched<'_, '_, R> {
    fn read_at(&self, buffer: &mut [u8], at: u64) -> io::Result<usize> {
        let read = self.file.read_at(buffer, at)?;
        self.read.set(self.read.get() + read as u64);
        if self.read.get() >= WATCH_EVERY {
            self.read.set(0);
            let called = self.watch.try_borrow_mut().map(|mut watch| watch(self.done.get(), self.size));
            self.interrupted.set(matches!(called, Ok(ControlFlow::Break(()))));
        }
        // Not the kind that is tried again.
        if self.interrupted.get() { Err(io::Error::other("interrupted")) } else { Ok(read) }
    }
}

/// The file being written.
struct Copy<S: Sink> {
    writer: Chunks<S>,
    /// Why the original's recorder called it BAD.
    failed: Option<String>,
    summary: Summary,
    refused: u64,
}

impl<S: Sink> Copy<S> {
    fn new(sink: S, failed: Option<String>) -> Result<Self, Error> {
        let writer = Chunks::new(sink, None).map_err(Error::Write)?;
        Ok(Self { writer, failed, summary: Summary::default(), refused: 0 })
    }

    /// Writes a record; one that cannot be meant as it stands is counted.
    fn take(&mut self, record: &Record<'_>) -> Result<(), Error> {
        let Record { opcode, data } = *record;
        let written = match opcode {
            op::SCHEMA => self.schema(data),
            op::CHANNEL => self.channel(data),
            op::MESSAGE => self.message(data),
            op::ATTACHMENT => self.attachment(data),
            op::METADATA => self.metadata(data),
            // The copy has chunks of its own.
            op::OWN if own::is(data) => return Ok(()),
            op::PRIVATE.. => Some(self.writer.private(opcode, data)),
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
            Some(Err(error)) => Err(Error::Write(io_error(error))),
        }
    }

    fn schema(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let mut fields = Fields(data);
        let id = fields.u16()?;
        let (name, encoding) = (fields.string()?, fields.string()?);
        let count = fields.u32()?;
        let data = fields.bytes(count.into())?;
        Some(self.writer.schema(Some(id), name, encoding, data).map(drop))
    }

    fn channel(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let mut fields = Fields(data);
        let (id, schema) = (fields.u16()?, fields.u16()?);
        let (topic, encoding) = (fields.string()?, fields.string()?);
        let metadata = fields.map()?;
        let channel = Channel { schema, topic, encoding, metadata: &metadata };
        let added = match self.writer.channel(Some(id), &channel) {
            // Better a channel that cannot be decoded than none.
            Err(McapError::UnknownSchema(..)) => {
                self.refused += 1;
                self.writer.channel(Some(id), &Channel { schema: 0, ..channel })
            }
            added => added,
        };
        Some(added.map(drop))
    }

    fn message(&mut self, data: &[u8]) -> Option<Result<(), McapError>> {
        let mut fields = Fields(data);
        let (channel_id, sequence) = (fields.u16()?, fields.u32()?);
        let (log_time, publish_time) = (fields.u64()?, fields.u64()?);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        Some(self.writer.message(&header, fields.0))
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
        let name = fields.string()?;
        let mut metadata = fields.map()?;
        if let Some(why) = self.failed.as_ref().filter(|_| name == SUMMARY) {
            metadata.extend(said::failed(why));
        }
        Some(self.writer.metadata(name, metadata))
    }

    fn finish(mut self, damage: &Damage, about: &About<'_>, size: u64) -> Result<Summary, Error> {
        let finished = (|| {
            if !self.summary.has_end {
                let metadata = said::end(&self.summary);
                self.writer.metadata(SUMMARY, metadata)?;
            }
            let metadata = said::recovered(&self.summary, damage, about, size);
            self.writer.metadata(RECOVERED, metadata)
        })();
        finished.map_err(|error| Error::Write(io_error(error)))?;
        self.writer.finish().map_err(Error::Write)?;
        Ok(self.summary)
    }
}
