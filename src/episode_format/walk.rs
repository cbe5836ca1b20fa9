//! Walking through an MCAP file from its beginning to its end, whole or not.
//!
//! Format: <https://mcap.dev/spec>. The framing is read here and not by the `mcap` crate's readers
//! because those panic on some damaged files (mcap 0.26: an inner record longer than its chunk, an
//! attachment shorter than its check value, an index that names another record) and keep in memory
//! as many chunks as an index calls overlapping, and because what lies behind damage is worth having.
//!
//! Where something is no record, reading continues behind it: see `resync`.
//!
//! Invariant: no file makes anything here panic.
//! Invariant: every message of every chunk whose check value is right is shown, once, if its channel is known; of
//! a damaged chunk nothing is shown. What is left out is counted in [`Walked`].
//! Invariant: memory holds one record of the file at a time, a chunk of at most [`MAX_RECORD`], as it
//! is and decompressed, and the head of every chunk.
//! Invariant: work is bounded by the size of the file, also that of decompressing.

use std::collections::{BTreeMap, BTreeSet};
use std::io;

use super::chunk::{Records, take};
use super::header;
use super::index::Index;
use super::names::Names;
use super::own::Owner;
use super::source::{ReadAt, Source};
use super::structure::{Fit, is_known};
use super::wire::Fields;

pub(crate) use super::op;
pub use super::walked::{FileEnd, LeftOut};
pub(crate) use super::walked::{Record, Walked, walk};

/// At the beginning of a file and at its end.
pub(crate) const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Largest record that is read: more is taken for a damaged length. A 4K raw picture has 16 MiB.
pub(crate) const MAX_RECORD: u64 = 256 << 20;
/// An opcode, and the length of what follows as u64.
pub(super) const HEAD: u64 = 9;
/// Bytes that may be decompressed, what each record counts among them: of any file, and for each of its bytes.
const UNPACKED: (u64, u64) = (256 << 20, 200);
/// Bytes that may be tried in vain for a chunk in any file, and for each of its bytes.
const TRIED: (u64, u64) = (64 << 20, 2);

/// Records without a check value that may be tried before the first chunk: of any file, and one for so many of its bytes.
const EARLY: (u64, u64) = (4096, 64 << 10);

/// A file being read.
#[allow(clippy::struct_excessive_bools, reason = "each is a fact of its own about the file")]
pub(crate) struct Walk<R> {
    pub(super) source: Source<R>,
    /// Where the next record of the file begins.
    pub(super) at: u64,
    /// Up to here it is known which bytes belong to which record: a record without a check value may lack some, unless
    /// another stands behind it.
    pub(super) sure: u64,
    pub(super) walked: Walked,
    ended: bool,
    pub(super) data_ended: bool,
    /// Of the section being read, data or summary.
    pub(super) crc: crc32fast::Hasher,
    /// Every check value so far was right, and nothing was passed over.
    pub(super) checked: bool,
    /// Every check value so far was there and right.
    pub(super) proven: bool,
    /// Where the summary begins.
    pub(super) summary: u64,
    pub(super) buffer: Vec<u8>,
    pub(super) unpacked: Vec<u8>,
    /// The chunk being shown.
    pub(super) chunk: Option<Records>,
    found: Option<Found>,
    /// A definition shown.
    defined: Vec<u8>,
    /// There was a chunk.
    pub(super) chunked: bool,
    /// A chunk had a check value: one without is not one of this writer's.
    pub(super) with_checks: bool,
    /// The chunk being shown is the last, and not whole.
    pub(super) cut: bool,
    /// Chunks shown: sizes and check value.
    pub(super) seen: BTreeSet<(u64, u64, u32)>,
    pub(super) names: Names,
    /// Definitions of the summary, until its check value is read.
    pub(super) summarised: Vec<(u8, Vec<u8>)>,
    /// Only definitions are wanted.
    pub(super) defining: bool,
    /// Bytes that may still be decompressed, and be tried in vain.
    pub(super) budget: (u64, u64),
    /// Records without a check value that may still be tried before the first chunk.
    pub(super) early: u64,
    /// The boot of this machine, if that is to prove anything; then, whether the episode was recorded in it.
    pub(super) boot: Option<String>,
    pub(super) same_boot: bool,
    /// When the episode began, ns since 1970.
    pub(super) begin_ns: Option<u64>,
    /// Damage was met: the index was looked for.
    pub(super) index: Known,
    /// Definitions were looked for elsewhere, once.
    pub(super) looked: bool,
}

/// The index, once it was looked for.
#[derive(Debug, Default)]
pub(super) enum Known {
    #[default]
    NotYet,
    /// There is none that is right.
    None,
    Right(Index),
}

/// What a step through the file found.
pub(super) enum Step {
    Show(u8),
    Again,
    End(FileEnd),
}

/// Where a record that is shown lies.
enum Found {
    Buffer(u8),
    Defined(u8),
    Chunk { opcode: u8, unpacked: bool, range: std::ops::Range<usize> },
}

impl<R: ReadAt> Walk<R> {
    /// Begins to read a file of `size` bytes. `None`: no MCAP file.
    pub(crate) fn new(file: R, size: u64) -> io::Result<Option<Self>> {
        Self::begin(Source::new(file, size), None)
    }

    /// With an owner only the definitions of its chunks are of use.
    pub(super) fn begin(source: Source<R>, owner: Option<Owner>) -> io::Result<Option<Self>> {
        let mut walk = Self::of(source, owner);
        if walk.source.peek(0, MAGIC.len())?.starts_with(&MAGIC) {
            walk.begin_read();
            return Ok(Some(walk));
        }
        // Its beginning may be damaged, or stand behind something else: then there is a chunk of it somewhere.
        if !walk.resync(0, 0)? {
            return Ok(None);
        }
        let Some(base) = walk.beginning()? else { return Ok(Some(walk)) };
        let mut walk = Self::of(walk.source.from(base), owner);
        walk.begin_read();
        walk.walked.left_out.bytes_before = base;
        Ok(Some(walk))
    }

    /// The magic number was read.
    fn begin_read(&mut self) {
        self.crc.update(&MAGIC);
        self.at = MAGIC.len() as u64;
        (self.sure, self.walked.bytes) = (self.at, self.at);
    }

    fn of(source: Source<R>, owner: Option<Owner>) -> Self {
        let allowed = |(least, each): (u64, u64)| source.size.saturating_mul(each).saturating_add(least);
        let budget = (allowed(UNPACKED), allowed(TRIED));
        let early = EARLY.0 + source.size / EARLY.1;
        Self {
            source,
            at: 0,
            sure: 0,
            walked: Walked::nothing(),
            proven: true,
            ended: false,
            data_ended: false,
            crc: crc32fast::Hasher::new(),
            checked: true,
            summary: 0,
            buffer: Vec::new(),
            unpacked: Vec::new(),
            chunk: None,
            found: None,
            defined: Vec::new(),
            chunked: false,
            with_checks: false,
            cut: false,
            seen: BTreeSet::new(),
            names: Names::of(owner.unwrap_or_default()),
            summarised: Vec::new(),
            defining: owner.is_some(),
            budget,
            early,
            boot: None,
            same_boot: false,
            begin_ns: None,
            index: Known::NotYet,
            looked: false,
        }
    }

    /// Lets `boot`, the present boot of this machine, prove what was written last: the kernel keeps the order of writes.
    pub(crate) fn of_boot(mut self, boot: Option<String>) -> Self {
        self.boot = boot;
        self
    }

    /// The next record that is not one of the container's own, chunks opened up; `None` at the end.
    pub(crate) fn next(&mut self) -> io::Result<Option<Record<'_>>> {
        Ok(if self.advance()? { Some(self.record()) } else { None })
    }

    /// Goes on to the next record; `false` at the end.
    pub(crate) fn advance(&mut self) -> io::Result<bool> {
        self.found = self.find()?;
        Ok(self.found.is_some())
    }

    /// The record gone to last; one of no content before the first and after the last.
    pub(crate) fn record(&self) -> Record<'_> {
        match &self.found {
            None => Record { opcode: 0, data: &[] },
            Some(Found::Buffer(opcode)) => Record { opcode: *opcode, data: &self.buffer },
            Some(Found::Defined(opcode)) => Record { opcode: *opcode, data: &self.defined },
            Some(Found::Chunk { opcode, unpacked, range }) => {
                let bytes = if *unpacked { &self.unpacked } else { &self.buffer };
                Record { opcode: *opcode, data: bytes.get(range.clone()).unwrap_or_default() }
            }
        }
    }

    /// What was found so far; all there is once the last record was read.
    pub(crate) fn walked(&self) -> Walked {
        self.walked
    }

    /// Messages left out because nothing says what their channel is, by the number of the channel.
    pub(crate) fn nameless(&self) -> &BTreeMap<u16, u64> {
        &self.names.unknown
    }

    fn find(&mut self) -> io::Result<Option<Found>> {
        loop {
            if let Some((opcode, data)) = self.names.next() {
                self.defined = data;
                return Ok(Some(Found::Defined(opcode)));
            }
            if let Some(found) = self.next_in_chunk() {
                return Ok(Some(found));
            }
            if self.chunk.is_some() {
                // A message of a channel that a damaged chunk defined.
                self.look_for_names()?;
                continue;
            }
            if self.ended {
                return Ok(None);
            }
            match self.step()? {
                Step::Show(opcode) => {
                    self.remember(opcode);
                    if self.names.admit(opcode, &self.buffer) {
                        return Ok(Some(Found::Buffer(opcode)));
                    }
                }
                Step::Again => {}
                Step::End(end) => self.end(end),
            }
        }
    }

    fn end(&mut self, end: FileEnd) {
        self.ended = true;
        self.walked.end = end;
        self.walked.left_out.nameless_messages = self.names.unknown.values().sum();
        self.walked.left_out.excess_records = self.names.excess;
        self.walked.episode = self.episode();
        self.walked.sound = self.checked
            && end == FileEnd::Finished
            && self.walked.bytes == self.source.size
            && self.walked.left_out == LeftOut::default();
        self.walked.proven = self.walked.sound && self.proven;
    }

    fn next_in_chunk(&mut self) -> Option<Found> {
        loop {
            let chunk = self.chunk.as_mut()?;
            let bytes = if chunk.unpacked { &self.unpacked } else { &self.buffer };
            let mut fields = Fields(bytes.get(chunk.range.clone()).unwrap_or_default());
            // The end, or the first record that is not whole.
            let Some((opcode, data)) = take(&mut fields) else {
                self.chunk = None;
                return None;
            };
            if opcode == op::MESSAGE && !self.checked && !self.looked && !self.names.knows(data) {
                return None;
            }
            let end = chunk.range.end - fields.0.len();
            chunk.range.start = end;
            self.walked.bytes += if self.cut { HEAD + data.len() as u64 } else { 0 };
            if matches!(opcode, op::METADATA | op::ATTACHMENT) {
                self.names.excess += 1;
                continue;
            }
            if self.names.admit(opcode, data) {
                self.walked.ordered_messages += u64::from(self.cut && opcode == op::MESSAGE);
                return Some(Found::Chunk { opcode, unpacked: chunk.unpacked, range: end - data.len()..end });
            }
        }
    }

    /// Takes a step through the file.
    fn step(&mut self) -> io::Result<Step> {
        if self.cut {
            return Ok(Step::End(FileEnd::Torn));
        }
        let at = self.at;
        let mut head = Fields(self.source.peek(at, 9)?);
        if head.0.is_empty() {
            return Ok(Step::End(FileEnd::Unfinished));
        }
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { return Ok(Step::End(FileEnd::Torn)) };
        let left = self.source.size.saturating_sub(at).saturating_sub(HEAD);
        // No writer mixes messages with chunks: it is the index of a chunk's messages, one bit of it changed.
        if !is_known(opcode)
            || opcode == op::CHUNK && length.min(left) > MAX_RECORD
            || opcode == op::MESSAGE && self.chunked
        {
            return self.lost(at, opcode);
        }
        let fit = self.source.fit(opcode, at + HEAD, length)?;
        if length > left {
            self.sure = if fit == Fit::Exact { at } else { self.sure };
            return if fit == Fit::Not { self.lost(at, opcode) } else { self.torn(at, opcode) };
        }
        let is_right = match fit {
            Fit::Exact | Fit::Cut => true,
            Fit::Loose => self.source.stands(at + HEAD + length, self.chunked)?,
            Fit::Not => false,
        };
        if !is_right {
            return self.lost(at, opcode);
        }
        if opcode == op::MESSAGE_INDEX && self.takes_along(at, at + HEAD + length)? {
            return Ok(Step::Again);
        }
        self.sure = at;
        self.take(at, opcode, length)
    }

    /// Takes the record at `at`, which is whole.
    fn take(&mut self, at: u64, opcode: u8, length: u64) -> io::Result<Step> {
        // The footer's check value covers the summary and the footer's own first bytes, that of the data ends before
        // the record that holds it.
        if opcode != op::DATA_END && self.counts() {
            let head = self.source.peek(at, 9)?.get(..9).unwrap_or_default();
            self.crc.update(head);
        }
        self.at = at + HEAD + length;
        let step = match opcode {
            op::CHUNK => return self.whole_chunk(at, length),
            op::FOOTER => return self.footer(at, length),
            op::DATA_END => self.data_end(at, length)?,
            op::HEADER if length <= header::LARGEST => {
                self.read(at, length)?;
                self.walked.writer = header::writer(&self.buffer);
                Step::Again
            }
            op::SCHEMA | op::CHANNEL if self.data_ended => {
                self.read(at, length.min(MAX_RECORD))?;
                if self.defining && self.names.has_room(&self.buffer) {
                    self.summarised.push((opcode, self.buffer.clone()));
                }
                Step::Again
            }
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::ATTACHMENT | op::METADATA | op::PRIVATE.. => {
                // Messages and the like do not belong into the summary.
                if length > MAX_RECORD {
                    self.walked.left_out.oversized_records += u64::from(!self.data_ended);
                    self.skip(at, length)?
                } else {
                    self.read(at, length)?;
                    let is_shown = !self.data_ended && self.is_whole(opcode)?;
                    if is_shown { Step::Show(opcode) } else { Step::Again }
                }
            }
            _ => self.skip(at, length)?,
        };
        self.walked.bytes += HEAD + length;
        Ok(step)
    }
}
