//! Reading the content of records, which goes into the check value of the section they are in.

use std::io;

use super::source::ReadAt;
use super::walk::{HEAD, Step, Walk};

/// Bytes read at once of what is passed over.
const PIECE: u64 = 64 << 10;

impl<R: ReadAt> Walk<R> {
    pub(super) fn skip(&mut self, at: u64, length: u64) -> io::Result<Step> {
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

    /// Reads the content of the record at `at` into the buffer.
    pub(super) fn read(&mut self, at: u64, length: u64) -> io::Result<()> {
        self.source.read(at + HEAD, length, &mut self.buffer)?;
        if self.counts() {
            self.crc.update(&self.buffer);
        }
        Ok(())
    }

    /// Is the check value of what is being read of use? Behind damage only that of the summary.
    pub(super) fn counts(&self) -> bool {
        self.checked || self.data_ended
    }

    /// Continues with the summary, at `at`.
    pub(super) fn summary_at(&mut self, at: u64) {
        (self.at, self.summary, self.data_ended) = (at, at, true);
        self.crc = crc32fast::Hasher::new();
    }
}
