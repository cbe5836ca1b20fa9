//! The index: the summary at the end of a finished file, if its check value is right. It has the places of the chunks
//! and of other records, and the channels.

use std::io;

use super::chunk::ChunkHead;
use super::framing::MAGIC;
use super::op;
use super::source::{Fit, ReadAt, WindowedFile};
use super::wire::Fields;

/// The footer's record and the magic number behind it, bytes.
pub(super) const TAIL: u64 = 9 + 20 + 8;
/// Most bytes of a summary: enough for two million chunks, 2 TB of an episode. In longer ones the chunks are searched.
const LARGEST: u64 = 256 << 20;
/// Bytes read at once.
const PIECE: u64 = 1 << 20;

/// A place of a record that the index names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum IndexedRecord {
    /// A chunk, and the contents of its head.
    Chunk { times: (u64, u64), size: u64, packed: u64 },
    /// Metadata or an attachment.
    Record { opcode: u8, length: u64 },
    /// The summary itself.
    Summary,
}

impl IndexedRecord {
    /// Is this the head of the chunk meant?
    pub(super) fn is(&self, head: &ChunkHead) -> bool {
        matches!(self, Self::Chunk { times, size, packed }
            if (*times, *size, *packed) == (head.times, head.size, head.packed))
    }
}

#[derive(Debug)]
pub(super) struct Index {
    /// Ascending.
    pub(super) places: Vec<(u64, IndexedRecord)>,
    /// Schemas and channels: opcode, content's place and length.
    pub(super) definitions: Vec<(u8, u64, u64)>,
}

/// If the file ends like a finished one: where its summary begins, and the summary's check value.
pub(super) fn footer<R: ReadAt>(source: &mut WindowedFile<R>) -> io::Result<Option<(u64, u32)>> {
    let Some(at) = source.size.checked_sub(TAIL).filter(|at| *at >= MAGIC.len() as u64) else { return Ok(None) };
    let mut fields = Fields(source.peek(at, 37)?);
    Ok((|| {
        let (opcode, length) = (fields.u8()?, fields.u64()?);
        let (summary, _offsets, crc) = (fields.u64()?, fields.u64()?, fields.u32()?);
        ((opcode, length) == (op::FOOTER, 20) && fields.bytes(8)? == MAGIC).then_some((summary, crc))
    })())
}

impl Index {
    /// Reads the index, if there is a valid one.
    pub(super) fn read<R: ReadAt>(source: &mut WindowedFile<R>) -> io::Result<Option<Self>> {
        let Some((summary, crc)) = footer(source)? else { return Ok(None) };
        let end = source.size.saturating_sub(TAIL);
        if crc == 0 || summary < MAGIC.len() as u64 || summary >= end || end - summary > LARGEST {
            return Ok(None);
        }
        // The footer's check value covers the summary and the footer's own first bytes.
        let (mut at, covered) = (summary, end + 9 + 16);
        let (mut hasher, mut piece) = (crc32fast::Hasher::new(), Vec::new());
        while at < covered {
            if !source.read(at, PIECE.min(covered - at), &mut piece)? {
                return Ok(None);
            }
            hasher.update(&piece);
            at += piece.len() as u64;
        }
        if hasher.finalize() != crc {
            return Ok(None);
        }
        Self::records(source, summary, end)
    }

    fn records<R: ReadAt>(source: &mut WindowedFile<R>, summary: u64, end: u64) -> io::Result<Option<Self>> {
        let mut index = Self { places: vec![(summary, IndexedRecord::Summary)], definitions: Vec::new() };
        let mut at = summary;
        while at < end {
            let mut head = Fields(source.peek(at, 64)?);
            let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { return Ok(None) };
            let place = place(opcode, head);
            let content = at + 9;
            if length > end.saturating_sub(content) || source.fit(opcode, content, length)? == Fit::Not {
                return Ok(None);
            }
            at = content + length;
            let place = match place {
                // The part before its sizes grows with the number of channels.
                Some((place, IndexedRecord::Chunk { times, .. })) => {
                    let mut sizes = Fields(source.peek(at.saturating_sub(16), 16)?);
                    let (packed, size) = (sizes.u64().unwrap_or(0), sizes.u64().unwrap_or(0));
                    Some((place, IndexedRecord::Chunk { times, size, packed }))
                }
                place => place,
            };
            index.places.extend(place.filter(|(at, _)| *at < summary));
            if matches!(opcode, op::SCHEMA | op::CHANNEL) {
                index.definitions.push((opcode, content, length));
            }
        }
        // Schemas before the channels that need them.
        index.definitions.sort_unstable();
        index.places.sort_unstable_by_key(|(at, _)| *at);
        Ok(Some(index))
    }
}

/// The place that a record of the index names.
fn place(opcode: u8, mut fields: Fields<'_>) -> Option<(u64, IndexedRecord)> {
    match opcode {
        op::CHUNK_INDEX => {
            let (times, at, _length) = ((fields.u64()?, fields.u64()?), fields.u64()?, fields.u64()?);
            Some((at, IndexedRecord::Chunk { times, size: 0, packed: 0 }))
        }
        op::METADATA_INDEX | op::ATTACHMENT_INDEX => {
            let (at, length) = (fields.u64()?, fields.u64()?);
            let opcode = if opcode == op::METADATA_INDEX { op::METADATA } else { op::ATTACHMENT };
            Some((at, IndexedRecord::Record { opcode, length: length.checked_sub(9)? }))
        }
        _ => None,
    }
}
