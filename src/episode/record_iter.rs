//! The records of an MCAP file from beginning to end, complete or not.
//!
//! Format: <https://mcap.dev/spec>. The framing is read here and not by the `mcap` crate's readers
//! because those panic on some damaged files (mcap 0.26: an inner record longer than its chunk, an
//! attachment shorter than its check value, an index that names another record) and keep in memory
//! as many chunks as an index calls overlapping, and because the data after damage is worth reading.
//!
//! After bytes that are not a record, reading continues as described in `resync`.
//!
//! Invariant: no file causes a panic here.
//! Invariant: every message of every chunk with a right check value is shown once, if its channel is known; nothing of
//! a damaged chunk is shown. Everything left out is counted in `Integrity`.
//! Invariant: memory holds one record of the file at a time, a chunk of at most `MAX_RECORD` both packed and
//! decompressed, and the head of every chunk. Work, including decompression, is bounded by the size of the file.

use std::collections::{BTreeMap, BTreeSet};
use std::io;

use super::chunk::{self, ChunkHead, Opened, Records, first_record};
use super::framing::{HEAD, MAGIC, MAX_RECORD};
use super::index::Index;
use super::integrity::{LARGEST_HEADER, Writer, writer};
use super::names::Names;
use super::own::Owner;
use super::source::{Fit, ReadAt, WindowedFile, is_known, is_opaque};
use super::wire::Fields;

pub use super::integrity::{FileEnd, LeftOut};
pub(crate) use super::integrity::{Integrity, Record};
pub(crate) use super::op;

/// Bytes that may be decompressed, including an overhead per record: for any file, and per byte of it.
const UNPACKED: (u64, u64) = (256 << 20, 200);
/// Bytes that may be searched in vain for a chunk: in any file, and per byte of it.
const TRIED: (u64, u64) = (64 << 20, 2);

/// Bytes read at once while skipping.
const PIECE: u64 = 64 << 10;
/// Bytes of a chunk's head and of the shortest record's: with fewer of them nothing in it can be read.
pub(super) const LEAST: usize = 40 + 9;
/// Records without a checksum that may be tried before the first chunk: for any file, and one per this many bytes.
const EARLY: (u64, u64) = (4096, 64 << 10);

/// A file being read.
#[allow(clippy::struct_excessive_bools, reason = "each is a fact of its own about the file")]
pub(crate) struct RecordIter<R> {
    pub(super) source: WindowedFile<R>,
    /// Where the next record of the file begins.
    pub(super) at: u64,
    /// Up to here it is known which bytes belong to which record: a record without a check value may lack some, unless
    /// another one follows it.
    pub(super) sure: u64,
    pub(super) integrity: Integrity,
    ended: bool,
    pub(super) data_ended: bool,
    /// Check value of the section being read, data or summary.
    pub(super) crc: crc32fast::Hasher,
    /// Every check value so far was right, and nothing was skipped.
    pub(super) checked: bool,
    /// Every check value so far was present and right.
    pub(super) proven: bool,
    /// Where the summary begins.
    pub(super) summary: u64,
    pub(super) buffer: Vec<u8>,
    pub(super) unpacked: Vec<u8>,
    /// The chunk being shown.
    pub(super) chunk: Option<Records>,
    found: Option<RecordPlace>,
    /// A definition shown.
    defined: Vec<u8>,
    /// A chunk was read.
    pub(super) chunked: bool,
    /// A chunk had a check value: one without is not one of this writer's.
    pub(super) with_checks: bool,
    /// The chunk being shown is the last one, and incomplete.
    pub(super) cut: bool,
    /// Chunks shown: sizes and check value.
    pub(super) seen: BTreeSet<(u64, u64, u32)>,
    pub(super) names: Names,
    /// Definitions of the summary, until its check value is read.
    pub(super) summarised: Vec<(u8, Vec<u8>)>,
    /// Only definitions are read.
    pub(super) defining: bool,
    /// Remaining bytes to decompress, and to search in vain.
    pub(super) budget: (u64, u64),
    /// Records without a check value that may still be tried before the first chunk.
    pub(super) early: u64,
    /// The boot of this machine, if it may prove anything; then, whether the episode was recorded in it.
    pub(super) boot: Option<String>,
    pub(super) same_boot: bool,
    /// When the episode began, ns since 1970.
    pub(super) begin_ns: Option<u64>,
    /// Damage was found: the index was searched for.
    pub(super) index: Known,
    /// Definitions were searched for elsewhere, once.
    pub(super) looked: bool,
}

/// The index, once it was searched for.
#[derive(Debug, Default)]
pub(super) enum Known {
    #[default]
    NotYet,
    /// There is no valid one.
    None,
    Right(Index),
}

/// The result of a step through the file.
pub(super) enum Step {
    Show(u8),
    Again,
    End(FileEnd),
}

/// The place of a record that is shown.
enum RecordPlace {
    Buffer(u8),
    Defined(u8),
    Chunk { opcode: u8, unpacked: bool, range: std::ops::Range<usize> },
}

impl<R: ReadAt> RecordIter<R> {
    /// Starts reading a file of `size` bytes. `None`: not an MCAP file.
    pub(crate) fn new(file: R, size: u64) -> io::Result<Option<Self>> {
        Self::begin(WindowedFile::new(file, size), None)
    }

    /// With an owner only the definitions of its chunks are used.
    pub(super) fn begin(source: WindowedFile<R>, owner: Option<Owner>) -> io::Result<Option<Self>> {
        let mut records = Self::with_owner(source, owner);
        if records.source.peek(0, MAGIC.len())?.starts_with(&MAGIC) {
            records.begin_read();
            return Ok(Some(records));
        }
        // Its beginning may be damaged, or preceded by other bytes: then a chunk of it is somewhere in the file.
        if !records.resync(0, 0)? {
            return Ok(None);
        }
        let Some(base) = records.beginning()? else { return Ok(Some(records)) };
        let mut records = Self::with_owner(records.source.from(base), owner);
        records.begin_read();
        records.integrity.left_out.bytes_before = base;
        Ok(Some(records))
    }

    /// The magic number was read.
    fn begin_read(&mut self) {
        self.crc.update(&MAGIC);
        self.at = MAGIC.len() as u64;
        (self.sure, self.integrity.bytes) = (self.at, self.at);
    }

    fn with_owner(source: WindowedFile<R>, owner: Option<Owner>) -> Self {
        let allowed = |(least, each): (u64, u64)| source.size.saturating_mul(each).saturating_add(least);
        let budget = (allowed(UNPACKED), allowed(TRIED));
        let early = EARLY.0 + source.size / EARLY.1;
        Self {
            source,
            at: 0,
            sure: 0,
            integrity: Integrity::default(),
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
            names: Names::new(owner.unwrap_or_default()),
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

    /// Uses `boot`, the present boot of this machine, to prove the last writes: the kernel keeps their order.
    pub(crate) fn of_boot(mut self, boot: Option<String>) -> Self {
        self.boot = boot;
        self
    }

    /// The next record that is not one of the container's own, with chunks opened; `None` at the end.
    pub(crate) fn next(&mut self) -> io::Result<Option<Record<'_>>> {
        Ok(if self.advance()? { Some(self.record()) } else { None })
    }

    /// Moves to the next record; `false` at the end.
    pub(crate) fn advance(&mut self) -> io::Result<bool> {
        self.found = self.find()?;
        Ok(self.found.is_some())
    }

    /// The current record; an empty one before the first and after the last.
    pub(crate) fn record(&self) -> Record<'_> {
        match &self.found {
            None => Record { opcode: 0, data: &[] },
            Some(RecordPlace::Buffer(opcode)) => Record { opcode: *opcode, data: &self.buffer },
            Some(RecordPlace::Defined(opcode)) => Record { opcode: *opcode, data: &self.defined },
            Some(RecordPlace::Chunk { opcode, unpacked, range }) => {
                let bytes = if *unpacked { &self.unpacked } else { &self.buffer };
                Record { opcode: *opcode, data: bytes.get(range.clone()).unwrap_or_default() }
            }
        }
    }

    /// The integrity so far; complete once the last record was read.
    pub(crate) fn integrity(&self) -> Integrity {
        self.integrity
    }

    /// Messages left out because the file does not define their channel, by the number of the channel.
    pub(crate) fn nameless(&self) -> &BTreeMap<u16, u64> {
        &self.names.unknown
    }

    fn find(&mut self) -> io::Result<Option<RecordPlace>> {
        loop {
            if let Some((opcode, data)) = self.names.next() {
                self.defined = data;
                return Ok(Some(RecordPlace::Defined(opcode)));
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
                        return Ok(Some(RecordPlace::Buffer(opcode)));
                    }
                }
                Step::Again => {}
                Step::End(end) => self.end(end),
            }
        }
    }

    fn end(&mut self, end: FileEnd) {
        self.ended = true;
        self.integrity.end = end;
        self.integrity.left_out.nameless_messages = self.names.unknown.values().sum();
        self.integrity.left_out.excess_records = self.names.excess;
        self.integrity.episode = self.episode();
        self.integrity.sound = self.checked
            && end == FileEnd::Finished
            && self.integrity.bytes == self.source.size
            && self.integrity.left_out == LeftOut::default();
        self.integrity.proven = self.integrity.sound && self.proven;
    }

    fn next_in_chunk(&mut self) -> Option<RecordPlace> {
        loop {
            let chunk = self.chunk.as_mut()?;
            let bytes = if chunk.unpacked { &self.unpacked } else { &self.buffer };
            let mut fields = Fields(bytes.get(chunk.range.clone()).unwrap_or_default());
            // The end, or the first record that is not whole.
            let Some((opcode, data)) = first_record(&mut fields) else {
                self.chunk = None;
                return None;
            };
            if opcode == op::MESSAGE && !self.checked && !self.looked && !self.names.knows(data) {
                return None;
            }
            let end = chunk.range.end - fields.0.len();
            chunk.range.start = end;
            self.integrity.bytes += if self.cut { HEAD + data.len() as u64 } else { 0 };
            if matches!(opcode, op::METADATA | op::ATTACHMENT) {
                self.names.excess += 1;
                continue;
            }
            if self.names.admit(opcode, data) {
                self.integrity.ordered_messages += u64::from(self.cut && opcode == op::MESSAGE);
                return Some(RecordPlace::Chunk { opcode, unpacked: chunk.unpacked, range: end - data.len()..end });
            }
        }
    }

    /// Makes a step through the file.
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
        // No writer mixes messages with chunks: this is the message index of a chunk with a flipped bit.
        if !is_known(opcode)
            || opcode == op::CHUNK && length.min(left) > MAX_RECORD
            || opcode == op::MESSAGE && self.chunked
        {
            return self.lost(at, opcode);
        }
        let fit = self.source.fit(opcode, at + HEAD, length)?;
        if length > left {
            self.sure = if fit == Fit::Exact { at } else { self.sure };
            // Bytes after the last record, such as another file, may look like a record of any length, above all a
            // private one.
            let is_cut = length <= MAX_RECORD
                && match fit {
                    Fit::Exact | Fit::Cut => true,
                    Fit::Loose => opcode == op::MESSAGE,
                    Fit::Not => false,
                };
            return if is_cut { self.torn(at, opcode) } else { self.lost(at, opcode) };
        }
        let is_right = match fit {
            Fit::Exact | Fit::Cut => true,
            Fit::Loose => self.source.stands(at + HEAD + length, self.chunked)?,
            Fit::Not => false,
        };
        if !is_right {
            return self.lost(at, opcode);
        }
        let is_longer = fit == Fit::Loose && !is_opaque(opcode);
        if (opcode == op::MESSAGE_INDEX || is_longer) && self.takes_along(at, at + HEAD + length)? {
            return Ok(Step::Again);
        }
        self.sure = at;
        self.take_record(at, opcode, length)
    }

    /// Takes the complete record at `at`.
    fn take_record(&mut self, at: u64, opcode: u8, length: u64) -> io::Result<Step> {
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
            op::HEADER if length <= LARGEST_HEADER => {
                self.read(at, length)?;
                self.integrity.writer = writer(&self.buffer);
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
                // Messages and the like do not belong in the summary.
                if length > MAX_RECORD {
                    self.integrity.left_out.oversized_records += u64::from(!self.data_ended);
                    self.skip(at, length)?
                } else {
                    self.read(at, length)?;
                    let is_shown = !self.data_ended && self.is_whole(opcode)?;
                    if is_shown { Step::Show(opcode) } else { Step::Again }
                }
            }
            _ => self.skip(at, length)?,
        };
        self.integrity.bytes += HEAD + length;
        Ok(step)
    }

    /// Takes the chunk at `at`, of the length in its record.
    fn whole_chunk(&mut self, at: u64, length: u64) -> io::Result<Step> {
        self.read(at, length)?;
        let opened = ChunkHead::read(&self.buffer).map(|head| {
            let opened = chunk::open(&head, &self.buffer, &mut self.unpacked, &mut self.budget.0);
            (head, opened)
        });
        self.chunked = true;
        let (head, records) = match opened {
            Some((head, Opened::Right(records))) if self.is_verified(&head, &records) => (head, records),
            Some((_, Opened::TooMuch)) => {
                self.integrity.left_out.swollen_chunks += 1;
                self.integrity.bytes += HEAD + length;
                self.checked = false;
                return Ok(Step::Again);
            }
            _ if self.source.stands(at + HEAD + length, true)? => {
                if self.hides(at, at + HEAD + length)? {
                    return Ok(Step::Again);
                }
                self.integrity.damaged_chunks += 1;
                self.integrity.bytes += HEAD + length;
                self.checked = false;
                return Ok(Step::Again);
            }
            _ => return self.lost(at, op::CHUNK),
        };
        self.proven &= head.crc != 0 || head.size == 0;
        self.integrity.bytes += HEAD + length;
        self.show(head, records)?;
        Ok(Step::Again)
    }

    /// Whether these records have a check value. Zero means "not computed"; this program always computes it, so in a
    /// file of ours a chunk without one is damaged.
    fn is_verified(&self, head: &ChunkHead, records: &Records) -> bool {
        let is_ours = self.with_checks || self.integrity.writer == Writer::Rapid || self.is_owned(records);
        head.crc != 0 || !is_ours || crc32fast::hash(self.bytes(records)) == 0
    }

    /// Whether the record in the buffer, after which reading continues, contains only its own bytes and none of the
    /// next record.
    fn is_whole(&mut self, opcode: u8) -> io::Result<bool> {
        let is_alone = match opcode {
            op::ATTACHMENT => {
                let is_right = self.buffer.split_last_chunk().is_some_and(|(content, crc)| {
                    let crc = u32::from_le_bytes(*crc);
                    crc != 0 && chunk::is_sound(content, crc)
                });
                self.sure = if is_right { self.at } else { self.sure };
                // The caller verifies its check value.
                true
            }
            // Text contains no zeros, but the header of every record does.
            op::METADATA => {
                let mut fields = Fields(&self.buffer);
                let map = fields.string().and_then(|_| fields.map());
                map.is_some_and(|map| map.values().all(|value| !value.contains('\0')))
            }
            op::SCHEMA | op::CHANNEL => false,
            _ => true,
        };
        Ok(is_alone || self.source.stands(self.at, self.chunked)?)
    }

    /// Shows the chunk in the buffers next, unless it was shown before.
    pub(super) fn show(&mut self, head: ChunkHead, records: Records) -> io::Result<()> {
        self.sure = self.at;
        (self.chunked, self.with_checks) = (true, self.with_checks || head.crc != 0);
        // Nothing is recorded twice; without a clock this is unknown.
        let is_new = self.seen.insert((head.size, head.packed, head.crc)) || head.crc == 0 || head.times == (0, 0);
        if is_new {
            self.chunk = self.learn(&records)?.then_some(records);
        } else {
            self.integrity.left_out.repeated_chunks += 1;
            self.checked = false;
        }
        Ok(())
    }

    /// A chunk or another record cut by the end of the file.
    fn torn(&mut self, at: u64, opcode: u8) -> io::Result<Step> {
        // Its length may be damaged, and everything after it intact.
        let torn = if opcode == op::CHUNK { self.within(at)? } else { None };
        let from = torn.as_ref().map_or(at, |torn| torn.sure);
        if self.resync(at, from)? {
            self.integrity.damaged_chunks += u64::from(opcode == op::CHUNK && self.chunk.is_none());
            return Ok(Step::Again);
        }
        if opcode != op::CHUNK {
            return Ok(Step::End(FileEnd::Torn));
        }
        let left = self.source.size.saturating_sub(at + HEAD);
        if let Some(torn) = &torn
            && torn.is_whole
            && self.same_boot
            && self.checked
        {
            self.read(at, left)?;
            let begin = usize::try_from(torn.begin - at - HEAD).unwrap_or(usize::MAX).min(self.buffer.len());
            self.chunk = Some(Records { unpacked: false, range: begin..self.buffer.len() });
            self.integrity.bytes += torn.begin - at;
            self.cut = true;
            return Ok(Step::Again);
        }
        self.integrity.left_out.unproven_messages = torn.map_or(0, |torn| torn.messages);
        self.integrity.left_out.unproven_bytes = if left < LEAST as u64 { 0 } else { left };
        self.checked = false;
        Ok(Step::End(FileEnd::Torn))
    }

    /// The data's check value, and where the summary begins.
    fn data_end(&mut self, at: u64, length: u64) -> io::Result<Step> {
        let data = std::mem::take(&mut self.crc).finalize();
        self.source.read(at + HEAD, length.min(MAX_RECORD), &mut self.buffer)?;
        let crc = Fields(&self.buffer).u32();
        self.checked &= !self.data_ended && crc.is_some_and(|crc| crc == 0 || crc == data);
        self.proven &= crc == Some(data);
        self.data_ended = true;
        self.summary = self.at;
        self.summarised.clear();
        Ok(Step::Again)
    }

    fn footer(&mut self, at: u64, length: u64) -> io::Result<Step> {
        self.source.read(at + HEAD, length.min(MAX_RECORD), &mut self.buffer)?;
        let mut fields = Fields(&self.buffer);
        let footer = (|| Some((fields.u64()?, fields.u64()?, fields.u32()?)))();
        self.crc.update(self.buffer.get(..16).unwrap_or_default());
        let summary = std::mem::take(&mut self.crc).finalize();
        // A file need not have a summary.
        let begins = |begin| begin == self.summary || begin == 0 && at == self.summary;
        let is_crc_right = self.data_ended && footer.is_some_and(|(_, _, crc)| crc == summary);
        let is_right = footer.is_some_and(|(begin, _, crc)| begins(begin) && (crc == 0 || crc == summary));
        self.checked &= self.data_ended && is_right;
        self.integrity.indexed = footer.is_some_and(|(begin, ..)| begin != 0);
        self.proven &= is_crc_right;
        if !is_crc_right {
            self.summarised.clear();
        }
        let behind = self.source.peek(self.at, 2 * MAGIC.len())?;
        let Some(rest) = behind.strip_prefix(&MAGIC) else {
            let is_cut = behind.len() < MAGIC.len() && MAGIC.starts_with(behind);
            return if is_cut { Ok(Step::End(FileEnd::Torn)) } else { self.lost(at, op::FOOTER) };
        };
        let is_last = rest.is_empty() || rest.starts_with(&MAGIC);
        self.integrity.bytes += HEAD + length + MAGIC.len() as u64;
        self.at += MAGIC.len() as u64;
        // Parts of the file itself may follow; another file does not belong to it.
        self.sure = self.at;
        if is_last || !self.resync(self.at, self.at)? {
            self.integrity.left_out.bytes_behind = self.source.size.saturating_sub(self.sure);
            return Ok(Step::End(FileEnd::Finished));
        }
        Ok(Step::Again)
    }

    /// Skips the content of the record at `at`, but includes it in the check value of its section.
    fn skip(&mut self, at: u64, length: u64) -> io::Result<Step> {
        let (mut at, end) = (at + HEAD, at + HEAD + length);
        while self.counts() && at < end {
            let piece = (end - at).min(PIECE);
            if !self.source.read(at, piece, &mut self.buffer)? {
                break;
            }
            self.crc.update(&self.buffer);
            at += piece;
        }
        Ok(Step::Again)
    }

    /// Reads the content of the record at `at` into the buffer, and into the check value of its section.
    fn read(&mut self, at: u64, length: u64) -> io::Result<()> {
        self.source.read(at + HEAD, length, &mut self.buffer)?;
        if self.counts() {
            self.crc.update(&self.buffer);
        }
        Ok(())
    }

    /// Is the check value of the current section useful? After damage only that of the summary.
    fn counts(&self) -> bool {
        self.checked || self.data_ended
    }

    /// Continues with the summary, at `at`.
    pub(super) fn summary_at(&mut self, at: u64) {
        (self.at, self.summary, self.data_ended) = (at, at, true);
        self.crc = crc32fast::Hasher::new();
    }
}
