//! Resynchronisation: where reading continues after damage.
//!
//! 1. An invalid record followed by a valid one is skipped. A valid chunk within a message index, or within a record
//!    that is longer than its fields, shows that this record is invalid.
//! 2. If the summary of a finished file has the right check value, its index gives the places of the chunks.
//! 3. Otherwise the next place is searched where a chunk with a right check value begins. Parts known to be whole are
//!    not searched: the records of a valid chunk, an attachment, the records of a damaged chunk as far as they follow
//!    one another. A chunk found in the damaged rest may be the payload of a message: in our episodes only a chunk that
//!    names the episode is taken (see `own`). In another file a chunk is taken unless it belongs elsewhere, by a
//!    channel or schema that contradicts this file, or by messages from before this episode began: a file is recorded
//!    before it is sent.
//! 4. Metadata have no check value. They are taken where the index names them, or before the first chunk.
//!
//! Invariant: bytes searched in vain are counted and bounded by the size of the file.

use std::io;

use super::chunk::{self, ChunkHead, Opened, Packing, first_record, may_begin};
use super::framing::{HEAD, MAGIC, MAX_RECORD};
use super::index::{Index, IndexedRecord, TAIL, footer};
use super::op;
use super::record_iter::{FileEnd, Known, LEAST, RecordIter, Step};
use super::source::{Fit, ReadAt, is_known};
use super::wire::Fields;

/// Bytes that show whether a chunk may begin: its head and the first of its records'.
const LOOK: usize = 64;
/// Messages of an episode may be captured this long before it begins, ns: a mask, and the latency of a sample.
const BEFORE: u64 = 60_000_000_000;
/// Magic numbers of the two packings' frames.
const ZSTD: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
const LZ4: [u8; 4] = [0x04, 0x22, 0x4d, 0x18];

/// How far the records of a damaged or torn chunk follow one another.
pub(super) struct Within {
    /// Where the first begins.
    pub(super) begin: u64,
    /// Where the last apparent record begins; everything before it is whole.
    pub(super) sure: u64,
    /// Whole messages.
    pub(super) messages: u64,
    /// They reach the end of the file.
    pub(super) is_whole: bool,
}

impl<R: ReadAt> RecordIter<R> {
    /// Handles an incomplete record at `at`, with any opcode.
    pub(super) fn lost(&mut self, at: u64, opcode: u8) -> io::Result<Step> {
        let mut head = Fields(self.source.peek(at, 9)?);
        let length = head.u8().and_then(|_| head.u64()).filter(|_| is_known(opcode) && opcode != op::FOOTER);
        let next = length.and_then(|length| (at + HEAD).checked_add(length));
        // The bytes after this record are evidence only if it begins where the last one ended.
        if let Some(next) = next.filter(|next| *next <= self.source.size && self.sure >= at)
            && self.source.stands(next, true)?
        {
            if opcode == op::CHUNK && self.hides(at, next)? {
                return Ok(Step::Again);
            }
            let is_chunk = opcode == op::CHUNK;
            self.integrity.damaged_chunks += u64::from(is_chunk);
            self.integrity.left_out.gaps += u64::from(!is_chunk);
            self.chunked |= is_chunk;
            self.at = next;
            self.checked = false;
            return Ok(Step::Again);
        }
        let is_sure = self.sure >= at;
        let within = if opcode == op::CHUNK && is_sure { self.within(at)? } else { None };
        let from = within.map_or(at, |within| within.sure);
        if self.resync(at, from)? {
            return Ok(Step::Again);
        }
        self.checked = false;
        self.integrity.left_out.gaps += 1;
        if footer(&mut self.source)?.is_none() {
            return Ok(Step::End(FileEnd::Damaged));
        }
        self.integrity.bytes += TAIL;
        Ok(Step::End(FileEnd::Finished))
    }

    /// Finds where to continue after `at`, which is not a record, searching from `from`; `false`: nowhere.
    pub(super) fn resync(&mut self, at: u64, from: u64) -> io::Result<bool> {
        let before = self.sure;
        self.read_index()?;
        let index = std::mem::take(&mut self.index);
        let found = match &index {
            // The record at `sure` was read.
            Known::Right(index) => self.by_index(index, if self.sure < at { self.sure + 1 } else { at }),
            _ if self.sure < at => self.scan(self.sure + 1, u64::MAX),
            // The chunk itself may be valid, and only the bytes before it damaged.
            _ => match self.try_at(at + HEAD) {
                Ok(false) => self.scan(from, u64::MAX),
                found => found,
            },
        };
        self.index = index;
        // Only forward, to guarantee an end.
        if found? && (self.at > before || at == 0) {
            self.sure = self.at;
            self.integrity.left_out.gaps += 1;
            self.checked = false;
            return Ok(true);
        }
        Ok(false)
    }

    fn read_index(&mut self) -> io::Result<()> {
        if matches!(self.index, Known::NotYet) {
            self.index = Index::read(&mut self.source)?.map_or(Known::None, Known::Right);
        }
        Ok(())
    }

    /// The definitions of a damaged chunk must be found elsewhere.
    pub(super) fn look_for_names(&mut self) -> io::Result<()> {
        self.looked = true;
        self.read_index()?;
        let Known::Right(index) = &self.index else { return self.define() };
        let mut record = Vec::new();
        for (opcode, at, length) in &index.definitions {
            if self.source.read(*at, (*length).min(MAX_RECORD), &mut record)? {
                self.names.wait(*opcode, &record);
            }
        }
        Ok(())
    }

    /// Reads the file once more, only for definitions.
    fn define(&mut self) -> io::Result<()> {
        if self.defining {
            return Ok(());
        }
        let owner = Some(self.names.owner);
        let Some(mut records) = RecordIter::begin(self.source.again(), owner)? else { return Ok(()) };
        while let Some(record) = records.next()? {
            self.names.wait(record.opcode, record.data);
        }
        for (opcode, record) in &records.summarised {
            self.names.wait(*opcode, record);
        }
        Ok(())
    }

    fn by_index(&mut self, index: &Index, at: u64) -> io::Result<bool> {
        let first = index.places.partition_point(|(place, _)| *place < at);
        for (place, what) in index.places.get(first..).unwrap_or_default() {
            let is_there = match what {
                IndexedRecord::Chunk { .. } => {
                    let head = ChunkHead::read(self.source.peek(place + HEAD, LOOK)?);
                    match head.filter(|head| what.is(head)) {
                        Some(head) => self.try_chunk(place + HEAD, &head, true)?,
                        None => false,
                    }
                }
                IndexedRecord::Record { opcode, length } => {
                    let mut head = Fields(self.source.peek(*place, 9)?);
                    let is_named = (head.u8(), head.u64()) == (Some(*opcode), Some(*length));
                    let is_there = is_named && self.source.fit(*opcode, place + HEAD, *length)? == Fit::Exact;
                    self.at = if is_there { *place } else { self.at };
                    is_there
                }
                IndexedRecord::Summary => {
                    self.summary_at(*place);
                    true
                }
            };
            if is_there {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Does a valid chunk begin in the damaged one at `at`, which ends at `end`? Bytes may be missing between. Then
    /// reading continues with it.
    pub(super) fn hides(&mut self, at: u64, end: u64) -> io::Result<bool> {
        self.read_index()?;
        let from = match self.within(at)? {
            // A chunk that names the episode may be searched anywhere.
            Some(within) if within.is_whole && !self.is_episode()? => return Ok(false),
            Some(within) => within.sure,
            None => at,
        };
        // With a valid index nothing has moved.
        if matches!(self.index, Known::Right(_)) || !self.scan(from, end)? {
            return Ok(false);
        }
        self.integrity.damaged_chunks += 1;
        self.integrity.left_out.gaps += 1;
        (self.sure, self.checked) = (self.at, false);
        Ok(true)
    }

    /// Does a valid chunk begin in the record at `at`, which ends at `end`, a message index or a record longer than its
    /// fields? Such a record has no check value and no payload: bytes of it are missing or its length is damaged, and
    /// it includes bytes of the following records. Then reading continues with the chunk.
    pub(super) fn takes_along(&mut self, at: u64, end: u64) -> io::Result<bool> {
        if !self.scan(at + HEAD, end)? {
            return Ok(false);
        }
        self.integrity.left_out.gaps += 1;
        (self.sure, self.checked) = (self.at, false);
        Ok(true)
    }

    /// Searches from `at` on, up to `end`.
    fn scan(&mut self, mut at: u64, end: u64) -> io::Result<bool> {
        // A file that contains another, such as an archive: the damage is not at its own beginning.
        let is_foreign = self.at == 0;
        let mut is_behind = false;
        loop {
            let is_early = !self.chunked && !is_behind && self.early > 0;
            let window = self.source.peek(at, LOOK)?;
            if window.len() < LEAST || at >= end {
                return Ok(false);
            }
            let places = window.len() - if window.len() > LOOK { LOOK } else { LEAST } + 1;
            let may_be = |place: &usize| {
                let bytes = window.get(*place..).unwrap_or_default();
                may_be_chunk(bytes) || is_early && may_be_early(bytes)
            };
            let Some(place) = (0..places).find(may_be) else {
                at += places as u64;
                continue;
            };
            let is_chunk = window.get(place..).is_some_and(may_be_chunk);
            let is_begun = window.get(place..).is_some_and(|bytes| bytes.starts_with(&MAGIC));
            at += place as u64;
            if at >= end || is_begun && is_foreign && at > 0 && !self.is_episode()? {
                return Ok(false);
            }
            // The rest may belong to another file.
            is_behind |= is_begun && is_foreign;
            if is_chunk && self.try_at(at)? || !is_chunk && self.is_early(at)? {
                return Ok(true);
            }
            if self.budget.1 == 0 {
                return Ok(false);
            }
            at += 1;
        }
    }

    /// Does a whole record without a check value of its own stand at `at`, before any chunk?
    fn is_early(&mut self, at: u64) -> io::Result<bool> {
        // Its prerequisites are searched anywhere in the file.
        self.early = self.early.saturating_sub(1);
        let mut head = Fields(self.source.peek(at, 9)?);
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { return Ok(false) };
        let is_there = length <= MAX_RECORD.min(self.source.size.saturating_sub(at + HEAD));
        let is_whole = is_there
            && matches!(opcode, op::METADATA | op::ATTACHMENT)
            && self.source.fit(opcode, at + HEAD, length)? == Fit::Exact
            && self.source.stands(at + HEAD + length, false)?;
        self.at = if is_whole { at } else { self.at };
        Ok(is_whole)
    }

    /// Continues with the chunk whose content begins at `at`, if it is valid and belongs to this file.
    fn try_at(&mut self, at: u64) -> io::Result<bool> {
        let bytes = self.source.peek(at, LOOK)?;
        let head = if may_be_chunk(bytes) { ChunkHead::read(bytes) } else { None };
        match head {
            Some(head) => self.try_chunk(at, &head, false),
            None => Ok(false),
        }
    }

    fn try_chunk(&mut self, at: u64, head: &ChunkHead, named: bool) -> io::Result<bool> {
        let length = head.content();
        if length > MAX_RECORD || head.crc == 0 || length > self.source.size.saturating_sub(at) {
            return Ok(false);
        }
        if length > self.budget.1 {
            self.budget.1 = 0;
            return Ok(false);
        }
        self.source.read(at, length, &mut self.buffer)?;
        let opened = chunk::open(head, &self.buffer, &mut self.unpacked, &mut self.budget.0);
        self.integrity.left_out.swollen_chunks += u64::from(matches!(opened, Opened::TooMuch));
        let records = match opened {
            Opened::Right(records) if named || self.is_own(&records)? => records,
            _ => {
                self.budget.1 = self.budget.1.saturating_sub(length.max(self.unpacked.len() as u64));
                return Ok(false);
            }
        };
        let before = at.checked_sub(HEAD).map_or(Ok(&[][..]), |at| self.source.peek(at, 9))?;
        let mut before = Fields(before);
        let is_headed = (before.u8(), before.u64()) == (Some(op::CHUNK), Some(length));
        self.integrity.bytes += length + if is_headed { HEAD } else { 0 };
        self.at = at + length;
        self.show(*head, records)?;
        Ok(true)
    }

    /// Could these records belong to this file? `false` if they show otherwise.
    pub(super) fn is_consistent(&self, records: &[u8]) -> bool {
        let mut fields = Fields(records);
        let earliest = self.begin_ns.unwrap_or(0).saturating_sub(BEFORE);
        while let Some((opcode, data)) = first_record(&mut fields) {
            let foreign = match opcode {
                op::SCHEMA | op::CHANNEL => self.names.contradicts(opcode, data),
                op::MESSAGE => {
                    let mut fields = Fields(data);
                    let time = fields.bytes(6).and_then(|_| fields.u64());
                    time.is_none_or(|time| time < earliest)
                }
                _ => false,
            };
            if foreign {
                return false;
            }
        }
        true
    }

    /// How far the records of the chunk at `at` follow one another; `None` if they are compressed or its head is
    /// invalid.
    pub(super) fn within(&mut self, at: u64) -> io::Result<Option<Within>> {
        let head = ChunkHead::read(self.source.peek(at + HEAD, LOOK)?);
        let Some(head) = head.filter(|head| head.packing == Packing::Plain) else { return Ok(None) };
        let begin = at + HEAD + head.bytes;
        let claimed = begin.saturating_add(head.packed);
        let mut within = Within { begin, sure: at, messages: 0, is_whole: true };
        let mut next = begin;
        while next < claimed.min(self.source.size) {
            let mut fields = Fields(self.source.peek(next, 9 + 14)?);
            let (Some(opcode), Some(length)) = (fields.u8(), fields.u64()) else { break };
            let end = next.saturating_add(HEAD).saturating_add(length);
            if end > claimed || !may_begin(&head, opcode, fields.0) {
                within.is_whole = false;
                break;
            }
            within.sure = next;
            if end > self.source.size {
                break;
            }
            within.messages += u64::from(opcode == op::MESSAGE);
            next = end;
        }
        Ok(Some(within))
    }
}

/// May the content of a chunk that has a check value begin with these bytes? A few comparisons, for every byte of a file.
fn may_be_chunk(bytes: &[u8]) -> bool {
    let Some(&[name @ (0 | 3 | 4), 0, 0, 0]) = bytes.get(28..32) else { return false };
    let number =
        |at: usize| bytes.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |bytes| u64::from_le_bytes(*bytes));
    let size = number(16);
    let is_sized = (9..=MAX_RECORD).contains(&size) && bytes.get(24..28).is_some_and(|crc| crc != [0; 4]);
    is_sized
        && match name {
            0 => {
                let opcode = bytes.get(40).copied().unwrap_or(0);
                number(32) == size
                    && (matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) || opcode >= op::PRIVATE)
                    && number(41) <= size - 9
            }
            3 => bytes.get(32..35) == Some(b"lz4") && bytes.get(43..47) == Some(&LZ4),
            4 => bytes.get(32..36) == Some(b"zstd") && bytes.get(44..48) == Some(&ZSTD),
            _ => false,
        }
}

/// May a record that stands before the chunks begin here, or another file?
fn may_be_early(bytes: &[u8]) -> bool {
    match bytes {
        [op::METADATA | op::ATTACHMENT, _, _, _, _, 0, 0, 0, 0, ..] => true,
        [0x89, ..] => bytes.starts_with(&MAGIC),
        _ => false,
    }
}
