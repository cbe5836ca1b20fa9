//! Random access to the bytes of a file, and whether a record begins at a place: one without a check value is whole if
//! its fields fill it exactly.
//!
//! Format: <https://mcap.dev/spec#records>.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use super::op;
use super::wire::Fields;

/// Bytes kept in memory around the last place read.
const WINDOW: usize = 64 << 10;
/// Bytes read at once into a growing buffer.
const PIECE: u64 = 1 << 20;

/// Random access reading, like `pread`.
pub trait ReadAt {
    /// Reads up to `buffer.len()` bytes from `at`; 0 at the end.
    ///
    /// # Errors
    /// As `pread(2)`.
    fn read_at(&self, buffer: &mut [u8], at: u64) -> io::Result<usize>;
}

impl ReadAt for File {
    fn read_at(&self, buffer: &mut [u8], at: u64) -> io::Result<usize> {
        FileExt::read_at(self, buffer, at)
    }
}

impl ReadAt for [u8] {
    fn read_at(&self, buffer: &mut [u8], at: u64) -> io::Result<usize> {
        let rest = usize::try_from(at).ok().and_then(|at| self.get(at..)).unwrap_or_default();
        let count = rest.len().min(buffer.len());
        if let (Some(to), Some(from)) = (buffer.get_mut(..count), rest.get(..count)) {
            to.copy_from_slice(from);
        }
        Ok(count)
    }
}

impl<T: ReadAt + ?Sized> ReadAt for &T {
    fn read_at(&self, buffer: &mut [u8], at: u64) -> io::Result<usize> {
        (**self).read_at(buffer, at)
    }
}

/// A file with a window around the last place read.
pub(super) struct WindowedFile<R> {
    pub(super) file: R,
    /// Bytes before the file: places are relative to its beginning.
    base: u64,
    /// Bytes of the file: no more are read even if it grows; fewer once its end is reached.
    pub(super) size: u64,
    window: Vec<u8>,
    at: u64,
}

impl<R: ReadAt> WindowedFile<R> {
    pub(super) fn new(file: R, size: u64) -> Self {
        Self { file, base: 0, size, window: Vec::new(), at: 0 }
    }

    /// The same, once more.
    pub(super) fn again(&self) -> WindowedFile<&dyn ReadAt> {
        WindowedFile { file: &self.file, base: self.base, size: self.size, window: Vec::new(), at: 0 }
    }

    /// What begins at `base`.
    pub(super) fn from(self, base: u64) -> Self {
        let size = self.size.saturating_sub(base);
        Self { base: self.base.saturating_add(base), size, window: Vec::new(), ..self }
    }

    /// The bytes from `at` on: `count` of them or more, fewer only at the end of the file. `count` is at most
    /// half of [`WINDOW`].
    pub(super) fn peek(&mut self, at: u64, count: usize) -> io::Result<&[u8]> {
        let held = |this: &Self| at.checked_sub(this.at).and_then(|from| usize::try_from(from).ok());
        let is_held = held(self).is_some_and(|from| {
            let there = self.window.len().saturating_sub(from);
            from <= self.window.len() && (there >= count || self.at + self.window.len() as u64 >= self.size)
        });
        if !is_held {
            self.window.clear();
            self.at = at;
            let mut window = std::mem::take(&mut self.window);
            let filled = self.fill(at, WINDOW as u64, &mut window);
            self.window = window;
            filled?;
        }
        Ok(held(self).and_then(|from| self.window.get(from..)).unwrap_or_default())
    }

    /// Reads `count` bytes from `at` into `into`, in place of what it holds; returns whether there were as many.
    /// Memory grows with the bytes present, not with the request.
    pub(super) fn read(&mut self, at: u64, count: u64, into: &mut Vec<u8>) -> io::Result<bool> {
        into.clear();
        self.fill(at, count, into)?;
        Ok(into.len() as u64 == count)
    }

    fn fill(&mut self, at: u64, count: u64, into: &mut Vec<u8>) -> io::Result<()> {
        let count = count.min(self.size.saturating_sub(at));
        while (into.len() as u64) < count {
            let have = into.len();
            let piece = (count - have as u64).min(PIECE.max(have as u64));
            into.resize(have + usize::try_from(piece).unwrap_or(usize::MAX), 0);
            let Some(room) = into.get_mut(have..) else { break };
            let read = loop {
                match self.file.read_at(room, self.base.saturating_add(at + have as u64)) {
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    read => break read?,
                }
            };
            into.truncate(have + read);
            if read == 0 {
                self.size = at + have as u64;
                break;
            }
        }
        Ok(())
    }

    /// How the fields of the record whose content begins at `at` fill its `length`; only their counts are read.
    pub(super) fn fit(&mut self, opcode: u8, at: u64, length: u64) -> io::Result<Fit> {
        let mut used = 0_u64;
        for part in parts(opcode) {
            let wide: u64 = match part {
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
            let mut fields = Fields(self.peek(place, 8)?);
            let count = if wide == 4 { fields.u32().map(u64::from) } else { fields.u64() };
            let Some(count) = count else { return Ok(Fit::Cut) };
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

    /// Does a record begin at `at`: a plausible head, and fields that fill it? One cut by the end of the file counts as
    /// far as it goes, and so does the end of the file.
    pub(super) fn stands(&mut self, at: u64, chunked: bool) -> io::Result<bool> {
        let Some(left) = self.size.checked_sub(at) else { return Ok(false) };
        let mut head = Fields(self.peek(at, 9)?);
        let Some(opcode) = head.u8() else { return Ok(left == 0) };
        let length = head.u64();
        if !is_known(opcode) || opcode == op::MESSAGE && chunked {
            return Ok(false);
        }
        let Some(length) = length else { return Ok(true) };
        let is_there = length <= left.saturating_sub(9);
        Ok(match self.fit(opcode, at + 9, length)? {
            Fit::Exact => true,
            // A private record or a message has only its length, which rarely fits by chance.
            Fit::Loose => is_there && is_opaque(opcode),
            Fit::Cut => !is_there,
            Fit::Not => false,
        })
    }
}

/// A field of a record.
#[derive(Debug, Clone, Copy)]
enum Part {
    Bytes(u64),
    /// A u32 length and as many bytes: text, a map, an array; the length is a multiple of this.
    Short(u64),
    /// A u64 length and as many bytes.
    Long,
}

/// How the fields of a record fill it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fit {
    Exact,
    /// Bytes are left over, or its fields are unknown.
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

pub(super) fn is_known(opcode: u8) -> bool {
    (1..=op::DATA_END).contains(&opcode) || opcode >= op::PRIVATE
}

/// May a record of this opcode hold any bytes, like a message or a private record?
pub(super) fn is_opaque(opcode: u8) -> bool {
    opcode == op::MESSAGE || opcode >= op::PRIVATE
}
