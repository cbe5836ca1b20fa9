//! The fields of the container's records, by which a record without a check value shows that it is whole: they
//! fill it exactly.
//!
//! Format: <https://mcap.dev/spec#records>.

use std::io;

use super::op;
use super::source::{ReadAt, Source};

/// A field of a record.
#[derive(Debug, Clone, Copy)]
enum Part {
    /// So many bytes.
    Bytes(u64),
    /// A u32 count of bytes and as many: text, a map, an array; a multiple of so many.
    Short(u64),
    /// A u64 count of bytes and as many.
    Long,
}

/// How a record's fields fill it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fit {
    /// Exactly.
    Exact,
    /// They leave some of it over, or nothing is known of its fields.
    Loose,
    /// Not at all: its length or one of theirs is damaged.
    Not,
    /// The end of the file comes before that shows.
    Cut,
}

use Part::{Bytes, Long, Short};

fn parts(opcode: u8) -> &'static [Part] {
    const TEXT: Part = Short(1);
    match opcode {
        op::HEADER => &[TEXT, TEXT],
        op::FOOTER => &[Bytes(20)],
        op::SCHEMA => &[Bytes(2), TEXT, TEXT, Short(1)],
        op::CHANNEL => &[Bytes(4), TEXT, TEXT, Short(1)],
        op::MESSAGE => &[Bytes(22)],
        op::CHUNK => &[Bytes(28), TEXT, Long],
        op::MESSAGE_INDEX => &[Bytes(2), Short(16)],
        op::CHUNK_INDEX => &[Bytes(32), Short(10), Bytes(8), TEXT, Bytes(16)],
        op::ATTACHMENT => &[Bytes(16), TEXT, TEXT, Long, Bytes(4)],
        op::ATTACHMENT_INDEX => &[Bytes(40), TEXT, TEXT],
        op::STATISTICS => &[Bytes(42), Short(10)],
        op::METADATA => &[TEXT, Short(1)],
        op::METADATA_INDEX => &[Bytes(16), TEXT],
        op::SUMMARY_OFFSET => &[Bytes(17)],
        op::DATA_END => &[Bytes(4)],
        _ => &[],
    }
}

/// Is this the opcode of a record that has been defined?
pub(super) fn is_known(opcode: u8) -> bool {
    (1..=op::DATA_END).contains(&opcode) || opcode >= op::PRIVATE
}

impl<R: ReadAt> Source<R> {
    /// How the fields of the record whose content begins at `at` fill its `length`; only their counts are read.
    pub(super) fn fit(&mut self, opcode: u8, at: u64, length: u64) -> io::Result<Fit> {
        let mut used = 0_u64;
        for part in parts(opcode) {
            let wide = match part {
                Bytes(count) => {
                    used = used.saturating_add(*count);
                    continue;
                }
                Short(_) => 4,
                Long => 8,
            };
            if used.saturating_add(wide) > length {
                return Ok(Fit::Not);
            }
            let Some(place) = at.checked_add(used) else { return Ok(Fit::Not) };
            let width = if wide == 4 { 4 } else { 8 };
            let Some(bytes) = self.peek(place, width)?.get(..width) else { return Ok(Fit::Cut) };
            let count = bytes.iter().rev().fold(0_u64, |count, byte| count << 8 | u64::from(*byte));
            if matches!(part, Short(step) if count % step != 0) {
                return Ok(Fit::Not);
            }
            used = used.saturating_add(wide).saturating_add(count);
        }
        Ok(match used.cmp(&length) {
            std::cmp::Ordering::Equal => Fit::Exact,
            std::cmp::Ordering::Less => Fit::Loose,
            std::cmp::Ordering::Greater => Fit::Not,
        })
    }

    /// Does a record stand at `at`? Its head may be one and its fields fill it; what the end of the file cuts may be
    /// one as far as it goes. So may the end of the file.
    pub(super) fn stands(&mut self, at: u64, chunked: bool) -> io::Result<bool> {
        let Some(left) = self.size.checked_sub(at) else { return Ok(false) };
        let head = self.peek(at, 9)?;
        let Some(opcode) = head.first().copied() else { return Ok(left == 0) };
        if !is_known(opcode) || opcode == op::MESSAGE && chunked {
            return Ok(false);
        }
        let Some(length) =
            head.get(1..9).map(|bytes| bytes.iter().rev().fold(0, |sum, byte| sum << 8 | u64::from(*byte)))
        else {
            return Ok(true);
        };
        let is_there = length <= left.saturating_sub(9);
        Ok(match self.fit(opcode, at + 9, length)? {
            Fit::Exact => true,
            // Of a private record or a message its length is all there is: one that fits by chance is rare.
            Fit::Loose => is_there && (opcode >= op::PRIVATE || opcode == op::MESSAGE),
            Fit::Cut => !is_there,
            Fit::Not => false,
        })
    }
}
