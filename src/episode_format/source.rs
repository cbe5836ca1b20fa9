//! Bytes of a file, from any place.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

/// Bytes kept in memory around the last place read.
const WINDOW: usize = 64 << 10;
/// Bytes read at once into a growing buffer.
const PIECE: u64 = 1 << 20;

/// What can be read from any place, as `pread` does.
pub(crate) trait ReadAt {
    /// Reads up to `buffer.len()` bytes from `at`; 0 at the end.
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

/// A file and what of it was read last.
pub(super) struct Source<R> {
    pub(super) file: R,
    /// Bytes before the file: places are counted from there.
    base: u64,
    /// Bytes of the file: no more are read, whatever it grows to; fewer once its end is met.
    pub(super) size: u64,
    window: Vec<u8>,
    at: u64,
}

impl<R: ReadAt> Source<R> {
    pub(super) fn new(file: R, size: u64) -> Self {
        Self { file, base: 0, size, window: Vec::new(), at: 0 }
    }

    /// The same, once more.
    pub(super) fn again(&self) -> Source<&dyn ReadAt> {
        Source { file: &self.file, base: self.base, size: self.size, window: Vec::new(), at: 0 }
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

    /// Reads `count` bytes from `at` into `into`, in place of what it holds; were there as many? Memory grows
    /// with what is there, not with what is asked for.
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
}
