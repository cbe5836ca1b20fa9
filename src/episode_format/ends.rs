//! Where a file, its data or its summary ends.

use std::io;

use super::chunk::Records;
use super::op;
use super::source::ReadAt;
use super::walk::{FileEnd, HEAD, MAGIC, MAX_RECORD, Step, Walk};
use super::wire::Fields;

/// Bytes of a chunk's head and of the shortest record's: with fewer of them nothing in it can be read.
const LEAST: u64 = 40 + 9;

impl<R: ReadAt> Walk<R> {
    /// A chunk, or another record, that the end of the file cuts.
    pub(super) fn torn(&mut self, at: u64, opcode: u8) -> io::Result<Step> {
        // Its length may be damaged, and what follows be all there.
        let torn = if opcode == op::CHUNK { self.within(at)? } else { None };
        let from = torn.as_ref().map_or(at, |torn| torn.sure);
        if self.resync(at, from)? {
            self.walked.damaged_chunks += u64::from(opcode == op::CHUNK && self.chunk.is_none());
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
            self.walked.bytes += torn.begin - at;
            self.cut = true;
            return Ok(Step::Again);
        }
        self.walked.left_out.unproven_messages = torn.map_or(0, |torn| torn.messages);
        self.walked.left_out.unproven_bytes = if left < LEAST { 0 } else { left };
        self.checked = false;
        Ok(Step::End(FileEnd::Torn))
    }

    /// The data's check value, and where the summary begins.
    pub(super) fn data_end(&mut self, at: u64, length: u64) -> io::Result<Step> {
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

    pub(super) fn footer(&mut self, at: u64, length: u64) -> io::Result<Step> {
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
        self.walked.indexed = footer.is_some_and(|(begin, ..)| begin != 0);
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
        self.walked.bytes += HEAD + length + MAGIC.len() as u64;
        self.at += MAGIC.len() as u64;
        // Parts of the file itself may stand behind: another file does not belong to it.
        self.sure = self.at;
        if is_last || !self.resync(self.at, self.at)? {
            self.walked.left_out.bytes_behind = self.source.size.saturating_sub(self.sure);
            return Ok(Step::End(FileEnd::Finished));
        }
        Ok(Step::Again)
    }
}
