//! Walking through an MCAP file from its beginning, whole or not.
//!
//! Format: <https://mcap.dev/spec>. The framing is read here and not by the `mcap` crate's readers
//! because those panic on some damaged files (mcap 0.26: an inner record longer than its chunk, an
//! attachment shorter than its check value, an index that names another record) and keep in memory
//! as many chunks as an index calls overlapping, and because what a torn chunk still holds is worth
//! having.
//!
//! Invariant: no file makes anything here panic.
//! Invariant: memory holds one record of the file at a time, a chunk of at most [`MAX_RECORD`], as it
//! is and decompressed.

use std::io::{self, Read};
use std::ops::Range;

use super::chunk::Opened;
use super::header::{self, Writer};
use super::wire::Fields;

/// Opcodes: <https://mcap.dev/spec#records>.
pub(crate) mod op {
    pub(crate) const HEADER: u8 = 0x01;
    pub(crate) const FOOTER: u8 = 0x02;
    pub(crate) const SCHEMA: u8 = 0x03;
    pub(crate) const CHANNEL: u8 = 0x04;
    pub(crate) const MESSAGE: u8 = 0x05;
    pub(crate) const CHUNK: u8 = 0x06;
    pub(crate) const ATTACHMENT: u8 = 0x09;
    pub(crate) const METADATA: u8 = 0x0c;
    pub(crate) const DATA_END: u8 = 0x0f;
    /// From here on opcodes are private.
    pub(crate) const PRIVATE: u8 = 0x80;
}

/// At the beginning of a file and at its end.
pub(crate) const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Largest record that is read: more is taken for a damaged length. A 4K raw picture has 16 MiB.
pub(crate) const MAX_RECORD: u64 = 256 << 20;
/// An opcode, and the length of what follows as u64.
const HEAD: u64 = 9;
/// Bytes read at once of what is passed over.
const PIECE: u64 = 64 << 10;

/// How a file ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FileEnd {
    /// With its footer: the recorder finished it.
    Finished,
    /// Between two records: the recorder was ended before it could finish, or is still writing.
    Unfinished,
    /// Within a record: the last write was cut in two.
    Torn,
    /// At something that is no record; what follows it is unknown.
    Damaged,
}

/// What a walk has found so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Walked {
    /// How the file ends.
    pub(crate) end: FileEnd,
    /// Bytes understood.
    pub(crate) bytes: u64,
    /// Chunks whose content is not what was written.
    pub(crate) damaged_chunks: u64,
    /// Records passed over because they are larger than [`MAX_RECORD`].
    pub(crate) oversized: u64,
    /// The file is whole: finished, nothing behind its end, every check value right, an index.
    pub(crate) sound: bool,
    /// It is sound, and every check value is there: none is zero, which the format has for "not computed".
    pub(crate) proven: bool,
    /// Which program wrote it.
    pub(crate) writer: Writer,
}

/// Is a record as it was written?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Trust {
    /// As far as check values tell.
    Sound,
    /// It lies in a chunk that the end of the file cuts, before the cut: nothing checks it.
    Torn,
    /// It lies in a chunk whose check value is not right, or where such a record has no place.
    Damaged,
}

/// A record that is not one of the container's own.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Record<'a> {
    pub(crate) opcode: u8,
    pub(crate) data: &'a [u8],
    pub(crate) trust: Trust,
}

/// A file being read.
#[allow(clippy::struct_excessive_bools, reason = "each is a fact of its own about the file")]
pub(crate) struct Walk<R> {
    file: R,
    size: u64,
    walked: Walked,
    ended: bool,
    data_ended: bool,
    /// Of the section being read, data or summary.
    crc: crc32fast::Hasher,
    /// Every check value so far was right.
    checked: bool,
    /// Every check value so far was there and right.
    proven: bool,
    /// Where the summary begins.
    summary: u64,
    buffer: Vec<u8>,
    unpacked: Vec<u8>,
    chunk: Option<Opened>,
    found: Option<Found>,
    /// There was a chunk.
    chunked: bool,
    /// The chunk is the last, and not whole.
    cut: bool,
}

/// What the next record of the file is.
enum Next {
    Show(u8),
    Again,
    End(FileEnd),
}

/// Where a record that is shown lies.
enum Found {
    Buffer(u8, Trust),
    Chunk { opcode: u8, unpacked: bool, range: Range<usize>, trust: Trust },
}

impl<R: Read> Walk<R> {
    /// Begins to read a file of `size` bytes. `None`: no MCAP file.
    pub(crate) fn new(file: R, size: u64) -> io::Result<Option<Self>> {
        let mut walk = Self {
            file,
            size,
            walked: Walked {
                end: FileEnd::Unfinished,
                bytes: 0,
                damaged_chunks: 0,
                oversized: 0,
                sound: false,
                proven: false,
                writer: Writer::Unknown,
            },
            ended: false,
            data_ended: false,
            crc: crc32fast::Hasher::new(),
            checked: true,
            proven: true,
            summary: 0,
            buffer: Vec::new(),
            unpacked: Vec::new(),
            chunk: None,
            found: None,
            chunked: false,
            cut: false,
        };
        let whole = walk.read(MAGIC.len() as u64)?;
        if !whole || walk.buffer != MAGIC {
            return Ok(None);
        }
        walk.crc.update(&MAGIC);
        walk.walked.bytes = MAGIC.len() as u64;
        Ok(Some(walk))
    }

    /// The next record that is not one of the container's own, chunks opened up; `None` at the end.
    /// Records of the summary that repeat those of the data are shown too.
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
            None => Record { opcode: 0, data: &[], trust: Trust::Sound },
            Some(Found::Buffer(opcode, trust)) => Record { opcode: *opcode, data: &self.buffer, trust: *trust },
            Some(Found::Chunk { opcode, unpacked, range, trust }) => {
                let bytes = if *unpacked { &self.unpacked } else { &self.buffer };
                Record { opcode: *opcode, data: bytes.get(range.clone()).unwrap_or_default(), trust: *trust }
            }
        }
    }

    /// What was found so far; all there is once the last record was read.
    pub(crate) fn walked(&self) -> Walked {
        self.walked
    }

    fn find(&mut self) -> io::Result<Option<Found>> {
        loop {
            if let Some(found) = self.next_in_chunk() {
                return Ok(Some(found));
            }
            if self.ended {
                return Ok(None);
            }
            match self.next_in_file()? {
                Next::Show(opcode) => {
                    // No writer mixes them: it is the index of a chunk's messages, one bit of it changed.
                    let stray = self.chunked && opcode == op::MESSAGE;
                    return Ok(Some(Found::Buffer(opcode, if stray { Trust::Damaged } else { Trust::Sound })));
                }
                Next::Again => {}
                Next::End(end) => {
                    self.ended = true;
                    self.walked.end = end;
                    self.walked.sound = self.checked && end == FileEnd::Finished && self.walked.bytes == self.size;
                    self.walked.proven = self.walked.sound && self.proven;
                }
            }
        }
    }

    fn next_in_chunk(&mut self) -> Option<Found> {
        let chunk = self.chunk.as_mut()?;
        let bytes = if chunk.unpacked { &self.unpacked } else { &self.buffer };
        let mut fields = Fields(bytes.get(chunk.records.clone()).unwrap_or_default());
        let record = (|| {
            let (opcode, length) = (fields.u8()?, fields.u64()?);
            fields.bytes(length).map(|data| (opcode, data.len()))
        })();
        // The end, or the first record that is not whole.
        let Some((opcode, length)) = record else {
            self.chunk = None;
            return None;
        };
        let end = chunk.records.end - fields.0.len();
        chunk.records.start = end;
        Some(Found::Chunk { opcode, unpacked: chunk.unpacked, range: end - length..end, trust: chunk.trust })
    }

    fn next_in_file(&mut self) -> io::Result<Next> {
        if self.cut {
            return Ok(Next::End(FileEnd::Torn));
        }
        if !self.read(HEAD)? {
            return Ok(Next::End(if self.buffer.is_empty() { FileEnd::Unfinished } else { FileEnd::Torn }));
        }
        let mut head = Fields(&self.buffer);
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { return Ok(Next::End(FileEnd::Torn)) };
        if !((1..=op::DATA_END).contains(&opcode) || opcode >= op::PRIVATE) {
            return Ok(Next::End(FileEnd::Damaged));
        }
        // The footer's check value covers the summary and the footer's own first bytes, that of the data ends before
        // the record that holds it.
        if opcode != op::DATA_END {
            self.crc.update(&self.buffer);
        }
        let left = self.size.saturating_sub(self.walked.bytes).saturating_sub(HEAD);
        let next = match opcode {
            op::CHUNK if length.min(left) > MAX_RECORD => Next::End(FileEnd::Damaged),
            op::CHUNK => self.chunk(length)?,
            _ if length > left => Next::End(FileEnd::Torn),
            op::FOOTER => self.footer(length)?,
            op::DATA_END => self.data_end(length)?,
            op::HEADER if length <= header::LARGEST => self.header(length)?,
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::ATTACHMENT | op::METADATA | op::PRIVATE.. => {
                // Messages and the like do not belong into the summary.
                let shown = !self.data_ended || matches!(opcode, op::SCHEMA | op::CHANNEL);
                if length > MAX_RECORD {
                    self.walked.oversized += u64::from(shown);
                    self.skip(length)?
                } else if !self.read(length)? {
                    Next::End(FileEnd::Torn)
                } else {
                    self.crc.update(&self.buffer);
                    if shown { Next::Show(opcode) } else { Next::Again }
                }
            }
            _ => self.skip(length)?,
        };
        self.walked.bytes += match next {
            Next::End(FileEnd::Finished) => HEAD + length + MAGIC.len() as u64,
            Next::Show(_) | Next::Again if !self.cut => HEAD + length,
            _ => 0,
        };
        Ok(next)
    }

    fn header(&mut self, length: u64) -> io::Result<Next> {
        if !self.read(length)? {
            return Ok(Next::End(FileEnd::Torn));
        }
        self.crc.update(&self.buffer);
        self.walked.writer = header::writer(&self.buffer);
        Ok(Next::Again)
    }

    fn chunk(&mut self, length: u64) -> io::Result<Next> {
        let whole = self.read(length)?;
        self.crc.update(&self.buffer);
        let opened = Opened::new(&self.buffer, whole, &mut self.unpacked);
        let damaged = opened.trust == Trust::Damaged;
        self.walked.damaged_chunks += u64::from(damaged);
        self.checked &= !damaged;
        self.proven &= opened.proven;
        self.chunk = Some(opened);
        (self.chunked, self.cut) = (true, !whole);
        Ok(Next::Again)
    }

    /// The data's check value, and where the summary begins.
    fn data_end(&mut self, length: u64) -> io::Result<Next> {
        let data = std::mem::take(&mut self.crc).finalize();
        if !self.read(length.min(MAX_RECORD))? {
            return Ok(Next::End(FileEnd::Torn));
        }
        let crc = Fields(&self.buffer).u32();
        self.checked &= !self.data_ended && crc.is_some_and(|crc| crc == 0 || crc == data);
        self.proven &= crc == Some(data);
        self.data_ended = true;
        self.summary = self.walked.bytes + HEAD + length;
        Ok(Next::Again)
    }

    fn footer(&mut self, length: u64) -> io::Result<Next> {
        if !self.read(length.min(MAX_RECORD))? {
            return Ok(Next::End(FileEnd::Torn));
        }
        let mut fields = Fields(&self.buffer);
        let footer = (|| Some((fields.u64()?, fields.u64()?, fields.u32()?)))();
        self.crc.update(self.buffer.get(..16).unwrap_or_default());
        let summary = std::mem::take(&mut self.crc).finalize();
        self.checked &= self.data_ended
            && footer.is_some_and(|(begin, _, crc)| begin == self.summary && (crc == 0 || crc == summary));
        self.proven &= footer.is_some_and(|(_, _, crc)| crc == summary);
        if !self.read(MAGIC.len() as u64)? {
            return Ok(Next::End(FileEnd::Torn));
        }
        Ok(Next::End(if self.buffer == MAGIC { FileEnd::Finished } else { FileEnd::Damaged }))
    }

    fn skip(&mut self, length: u64) -> io::Result<Next> {
        let mut left = length;
        while left > 0 {
            let piece = left.min(PIECE);
            if !self.read(piece)? {
                return Ok(Next::End(FileEnd::Torn));
            }
            self.crc.update(&self.buffer);
            left -= piece;
        }
        Ok(Next::Again)
    }

    /// Reads up to `count` bytes into the buffer; were there as many? Memory grows with what is there,
    /// not with what is asked for.
    fn read(&mut self, count: u64) -> io::Result<bool> {
        self.buffer.clear();
        Ok(self.file.by_ref().take(count).read_to_end(&mut self.buffer)? as u64 == count)
    }
}

/// Is `file`, of `size` bytes, an MCAP file, and what does a walk through it find? Every record that is not one of the
/// container's own is shown to `visit`, with its opcode, chunks opened up, damaged ones as far as they
/// go. `None`: no MCAP file.
pub(crate) fn walk(file: &mut impl Read, size: u64, visit: &mut dyn FnMut(u8, &[u8])) -> io::Result<Option<Walked>> {
    let Some(mut walk) = Walk::new(file, size)? else { return Ok(None) };
    while let Some(record) = walk.next()? {
        visit(record.opcode, record.data);
    }
    Ok(Some(walk.walked()))
}
