//! Copies the readable parts of a file into a whole one.
//!
//! Channels and schemas keep their numbers, messages their order; everything that the reader leaves out is counted.
//!
//! Invariant: memory does not grow with the file, except for the index of its chunks.

use std::cell::{Cell, RefCell};
use std::fs::File;
use std::io;
use std::ops::ControlFlow;
use std::path::PathBuf;

use mcap::McapError;
use rapid_core::time;

use super::super::chunk_writer::{Channel, ChunkWriter, Sink, io_error};
use super::super::reader::Entry;
use super::super::record_iter::{Record, RecordIter, op};
use super::report::{self, About, Copied};
use super::{ProgressFn, Repaired, summary::Summary};
use crate::{RECOVERED, ReadAt, SUMMARY, hash, own};

/// Bytes read between two calls of a [`ProgressFn`], including those searched in vain for a chunk.
const WATCH_EVERY: u64 = 1 << 20;

/// Why copying ended.
#[derive(Debug)]
pub(super) enum Error {
    Read(io::Error),
    Write(io::Error),
    Interrupted,
}

/// The content of a file. `None`: not an MCAP file.
pub(super) fn summary(file: impl ReadAt, size: u64, watch: &mut ProgressFn<'_>) -> Result<Option<Summary>, Error> {
    let file = Watched::new(file, size, watch);
    let Some(mut records) = RecordIter::new(&file, size).map_err(|error| file.error(error))? else { return Ok(None) };
    let mut summary = Summary::default();
    while let Some(record) = records.next().map_err(|error| file.error(error))? {
        if let Some(entry) = Entry::read(record) {
            summary.add(&entry);
        }
        file.done.set(records.integrity().bytes);
    }
    summary.integrity(&records.integrity());
    Ok(Some(summary))
}

/// Writes a whole file with the readable parts of `file`, `size` bytes long, to `sink`. Returns once it is on the disk.
/// `None`: not an MCAP file.
pub(super) fn copy(
    file: impl ReadAt,
    size: u64,
    about: &About<'_>,
    sink: impl Sink,
    watch: &mut ProgressFn<'_>,
) -> Result<Option<Copied>, Error> {
    let file = Watched::new(file, size, watch);
    let recorded = about.failed.map_or(size, |failed| failed.at);
    let Some(records) = RecordIter::new(&file, recorded).map_err(|error| file.error(error))? else { return Ok(None) };
    let mut records = records.of_boot(about.boot.clone());
    let mut copy = Copy::new(sink, about.failed.map(|failed| failed.why.clone()))?;
    while records.advance().map_err(|error| file.error(error))? {
        // As in the original, a damaged byte loses at most one of its chunks.
        if records.integrity().bytes != file.done.get() {
            copy.writer.part().map_err(|error| Error::Write(io_error(error)))?;
        }
        copy.writer.belong(records.episode());
        copy.write(records.record())?;
        file.done.set(records.integrity().bytes);
    }
    let integrity = records.integrity();
    let repaired = Repaired {
        to: PathBuf::new(),
        seconds: copy.summary.seconds(),
        messages: copy.summary.messages,
        end: integrity.end,
        unread_bytes: integrity.unread(recorded),
        damaged_chunks: integrity.damaged_chunks,
        left_out: integrity.left_out,
        nameless: records.nameless().clone(),
        ordered_messages: integrity.ordered_messages,
        refused_records: copy.refused,
        // Or of the file from which that one was made.
        failed: copy.failed.take().or_else(|| copy.summary.failed.take()),
        last: time::rfc3339(copy.summary.last_ns),
        original: None,
    };
    let is_lossless = integrity.is_all() && copy.refused == 0;
    let copied = Copied { summary: copy.summary, repaired, is_lossless };
    finish(copy.writer, &copied, about, size)?;
    Ok(Some(copied))
}

/// Writes the records at the end of a repaired file, and the end itself.
fn finish<S: Sink>(mut writer: ChunkWriter<S>, copied: &Copied, about: &About<'_>, size: u64) -> Result<(), Error> {
    let finished = (|| {
        if !copied.summary.has_end {
            writer.metadata(SUMMARY, report::end(&copied.summary))?;
        }
        writer.metadata(RECOVERED, report::recovered(copied, about, size))
    })();
    finished.map_err(|error| Error::Write(io_error(error)))?;
    writer.finish().map_err(Error::Write)
}

/// The SHA-256 of the first `size` bytes of `file`, hexadecimal.
pub(super) fn sha256(file: &File, size: u64, watch: &mut ProgressFn<'_>) -> Result<String, Error> {
    let file = Watched::new(file, size, watch);
    hash::sha256_of(&file, size, |done| file.done.set(done)).map_err(|error| file.error(error))
}

/// The whole file that repair makes of `bytes`, which may be any; `None` if they are not an MCAP file.
/// Nothing is written to a disk, and messages of a torn chunk are unproven.
pub fn recover_bytes(bytes: &[u8]) -> Option<Vec<u8>> {
    let size = bytes.len() as u64;
    let about = About { name: "bytes.mcap", sha256: String::new(), time_ns: 0, boot: None, failed: None };
    let mut whole = Vec::new();
    // Memory takes what is written to it.
    copy(bytes, size, &about, &mut whole, &mut |_, _| ControlFlow::Continue(())).ok()??;
    Some(whole)
}

/// A file that has its [`ProgressFn`] called while it is read, for whatever purpose.
struct Watched<'a, 'w, R> {
    file: R,
    size: u64,
    /// Bytes understood so far.
    done: Cell<u64>,
    /// Bytes read since the last call.
    read: Cell<u64>,
    interrupted: Cell<bool>,
    watch: RefCell<&'a mut ProgressFn<'w>>,
}

impl<'a, 'w, R> Watched<'a, 'w, R> {
    fn new(file: R, size: u64, watch: &'a mut ProgressFn<'w>) -> Self {
        let (done, read, interrupted) = (Cell::default(), Cell::default(), Cell::default());
        Self { file, size, done, read, interrupted, watch: RefCell::new(watch) }
    }

    /// Classifies a read error.
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
        // Not a kind that is retried.
        if self.interrupted.get() { Err(io::Error::other("interrupted")) } else { Ok(read) }
    }
}

/// The file being written.
struct Copy<S: Sink> {
    writer: ChunkWriter<S>,
    /// Why the original's recorder called it BAD.
    failed: Option<String>,
    summary: Summary,
    refused: u64,
}

impl<S: Sink> Copy<S> {
    fn new(sink: S, failed: Option<String>) -> Result<Self, Error> {
        let writer = ChunkWriter::new(sink, None).map_err(Error::Write)?;
        Ok(Self { writer, failed, summary: Summary::default(), refused: 0 })
    }

    /// Writes a record; an invalid one is counted.
    fn write(&mut self, record: Record<'_>) -> Result<(), Error> {
        let Some(entry) = Entry::read(record) else {
            self.refused += 1;
            return Ok(());
        };
        let written = match &entry {
            Entry::Schema { id, name, encoding, data } => self.writer.schema(Some(*id), name, encoding, data).map(drop),
            Entry::Channel { id, schema, topic, encoding, metadata } => {
                self.channel(*id, &Channel { schema: *schema, topic, encoding, metadata })
            }
            Entry::Message { header, data } => self.writer.message(header, data),
            Entry::Attachment(attachment) => self.writer.attach(attachment),
            Entry::Metadata { name, map: Some(map) } => {
                let failed = self.failed.as_ref().filter(|_| *name == SUMMARY).map(|why| report::failed(why));
                let map = map.clone().into_iter().chain(failed.into_iter().flatten()).collect();
                self.writer.metadata(name, map)
            }
            Entry::Metadata { map: None, .. } => {
                self.refused += 1;
                return Ok(());
            }
            // The copy has chunks of its own.
            Entry::Other if record.opcode >= op::PRIVATE && !(record.opcode == op::OWN && own::is(record.data)) => {
                self.writer.private(record.opcode, record.data)
            }
            // The container's own, which has no place in a chunk.
            Entry::Other => return Ok(()),
        };
        match written {
            Ok(()) => {
                self.summary.add(&entry);
                Ok(())
            }
            Err(
                McapError::ConflictingSchemas(_)
                | McapError::ConflictingChannels(_)
                | McapError::InvalidSchemaId
                | McapError::UnknownChannel(..),
            ) => {
                self.refused += 1;
                Ok(())
            }
            Err(error) => Err(Error::Write(io_error(error))),
        }
    }

    fn channel(&mut self, id: u16, channel: &Channel<'_>) -> Result<(), McapError> {
        let added = match self.writer.channel(Some(id), channel) {
            // A channel that cannot be decoded is better than none.
            Err(McapError::UnknownSchema(..)) => {
                self.refused += 1;
                self.writer.channel(Some(id), &Channel { schema: 0, ..*channel })
            }
            added => added,
        };
        added.map(drop)
    }
}
