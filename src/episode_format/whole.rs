//! Records that are there to their end: which of them are shown.

use std::io;

use super::chunk::{self, ChunkHead, Opened, Records};
use super::header::Writer;
use super::op;
use super::source::ReadAt;
use super::walk::{HEAD, Step, Walk};
use super::wire::Fields;

impl<R: ReadAt> Walk<R> {
    /// Takes the chunk at `at`, as long as its record says.
    pub(super) fn whole_chunk(&mut self, at: u64, length: u64) -> io::Result<Step> {
        self.read(at, length)?;
        let opened = ChunkHead::read(&self.buffer).map(|head| {
            let opened = chunk::open(&head, &self.buffer, &mut self.unpacked, &mut self.budget.0);
            (head, opened)
        });
        self.chunked = true;
        let (head, records) = match opened {
            Some((head, Opened::Right(records))) if self.is_verified(&head, &records) => (head, records),
            Some((_, Opened::TooMuch)) => {
                self.walked.left_out.swollen_chunks += 1;
                self.walked.bytes += HEAD + length;
                self.checked = false;
                return Ok(Step::Again);
            }
            _ if self.source.stands(at + HEAD + length, true)? => {
                if self.hides(at, at + HEAD + length)? {
                    return Ok(Step::Again);
                }
                self.walked.damaged_chunks += 1;
                self.walked.bytes += HEAD + length;
                self.checked = false;
                return Ok(Step::Again);
            }
            _ => return self.lost(at, op::CHUNK),
        };
        self.proven &= head.crc != 0 || head.size == 0;
        self.walked.bytes += HEAD + length;
        self.show(head, records)?;
        Ok(Step::Again)
    }

    /// Are these records under a check value? The format has zero for "not computed", which this writer always does: in
    /// a file of ours a chunk without one is damaged.
    fn is_verified(&self, head: &ChunkHead, records: &Records) -> bool {
        let is_ours = self.with_checks || self.walked.writer == Writer::Rapid || self.is_owned(records);
        head.crc != 0 || !is_ours || crc32fast::hash(self.bytes(records)) == 0
    }

    /// Is the record in the buffer, behind which reading continues, not one that lacks some of its bytes and has some of
    /// the next one's instead?
    pub(super) fn is_whole(&mut self, opcode: u8) -> io::Result<bool> {
        let is_alone = match opcode {
            op::ATTACHMENT => {
                let is_right = self.buffer.split_last_chunk().is_some_and(|(content, crc)| {
                    let crc = u32::from_le_bytes(*crc);
                    crc != 0 && chunk::is_sound(content, crc)
                });
                self.sure = if is_right { self.at } else { self.sure };
                // What its check value is worth is judged by whoever takes it.
                true
            }
            // Text has no zeros, the head of every record has.
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

    /// Shows the chunk in the buffers next, unless it was there before.
    pub(super) fn show(&mut self, head: ChunkHead, records: Records) -> io::Result<()> {
        self.sure = self.at;
        (self.chunked, self.with_checks) = (true, self.with_checks || head.crc != 0);
        // Nothing is recorded twice; without a clock it is not known.
        let is_new = self.seen.insert((head.size, head.packed, head.crc)) || head.crc == 0 || head.times == (0, 0);
        if is_new {
            self.chunk = self.learn(&records)?.then_some(records);
        } else {
            self.walked.left_out.repeated_chunks += 1;
            self.checked = false;
        }
        Ok(())
    }
}
