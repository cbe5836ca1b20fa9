//! Walking through an MCAP file from its beginning, whole or not.
//!
//! Format: <https://mcap.dev/spec>. The framing is read here and not by the `mcap` crate's readers
//! because those panic on some damaged lengths (mcap 0.26: an inner record longer than its chunk),
//! and because what a torn chunk still holds is worth having. Chunk CRCs and decompression are the
//! crate's.
//!
//! Invariant: no file makes anything here panic.
//! Invariant: memory holds one record of the file at a time, a chunk of at most [`MAX_RECORD`].

use std::io::{self, Read};

use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::wire::Fields;

/// Opcodes: <https://mcap.dev/spec#records>.
pub(super) mod op {
    pub(in crate::record) const FOOTER: u8 = 0x02;
    pub(in crate::record) const CHANNEL: u8 = 0x04;
    pub(in crate::record) const MESSAGE: u8 = 0x05;
    pub(in crate::record) const CHUNK: u8 = 0x06;
    pub(in crate::record) const METADATA: u8 = 0x0c;
    pub(in crate::record) const DATA_END: u8 = 0x0f;
    /// From here on opcodes are private.
    pub(in crate::record) const PRIVATE: u8 = 0x80;
}

/// Largest record that is read: more is taken for a damaged length.
const MAX_RECORD: u64 = 256 << 20;

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

/// What a walk found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Walked {
    /// How the file ends.
    pub(super) end: FileEnd,
    /// Bytes understood.
    pub(super) bytes: u64,
    /// Chunks whose content is not what was written.
    pub(super) damaged_chunks: u64,
}

/// Is `file`, of `size` bytes, an MCAP file, and what does a walk through it find? Every record that is not one of the
/// container's own is shown to `visit`, with its opcode, chunks opened up. `None`: no MCAP file.
pub(super) fn walk(file: &mut impl Read, size: u64, visit: &mut dyn FnMut(u8, &[u8])) -> io::Result<Option<Walked>> {
    let mut buffer = Vec::new();
    if !read(file, mcap::MAGIC.len() as u64, &mut buffer)? || buffer != mcap::MAGIC {
        return Ok(None);
    }
    let mut walked = Walked { end: FileEnd::Unfinished, bytes: buffer.len() as u64, damaged_chunks: 0 };
    let mut data_ended = false;
    walked.end = loop {
        if !read(file, 9, &mut buffer)? {
            break if buffer.is_empty() { FileEnd::Unfinished } else { FileEnd::Torn };
        }
        let mut head = Fields(&buffer);
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { break FileEnd::Torn };
        let known = (1..=op::DATA_END).contains(&opcode) || opcode >= op::PRIVATE;
        let left = size.saturating_sub(walked.bytes).saturating_sub(9);
        let in_memory = matches!(opcode, op::CHUNK | op::CHANNEL | op::MESSAGE | op::METADATA | op::FOOTER);
        if !known || (in_memory && length.min(left) > MAX_RECORD) {
            break FileEnd::Damaged;
        }
        if length > left && opcode != op::CHUNK {
            break FileEnd::Torn;
        }
        match opcode {
            op::CHUNK => {
                let whole = read(file, length, &mut buffer)?;
                if !open_chunk(&buffer, whole, visit) {
                    walked.damaged_chunks += u64::from(whole);
                }
                if !whole {
                    break FileEnd::Torn;
                }
            }
            op::CHANNEL | op::MESSAGE | op::METADATA => {
                if !read(file, length, &mut buffer)? {
                    break FileEnd::Torn;
                }
                // After the data the summary repeats the channels.
                if opcode != op::MESSAGE || !data_ended {
                    visit(opcode, &buffer);
                }
            }
            op::FOOTER => {
                let whole = read(file, length, &mut buffer)? && read(file, mcap::MAGIC.len() as u64, &mut buffer)?;
                if whole && buffer == mcap::MAGIC {
                    walked.bytes += 9 + length + mcap::MAGIC.len() as u64;
                    break FileEnd::Finished;
                }
                break if whole { FileEnd::Damaged } else { FileEnd::Torn };
            }
            _ => {
                data_ended |= opcode == op::DATA_END;
                if io::copy(&mut file.by_ref().take(length), &mut io::sink())? < length {
                    break FileEnd::Torn;
                }
            }
        }
        walked.bytes += 9 + length;
    };
    Ok(Some(walked))
}

/// Reads up to `count` bytes into `buffer`; were there as many? Memory grows with what is there, not
/// with what is asked for.
fn read(file: &mut impl Read, count: u64, buffer: &mut Vec<u8>) -> io::Result<bool> {
    buffer.clear();
    Ok(file.by_ref().take(count).read_to_end(buffer)? as u64 == count)
}

/// Shows the records of a chunk. Is it as it was written?
fn open_chunk(chunk: &[u8], whole: bool, visit: &mut dyn FnMut(u8, &[u8])) -> bool {
    let mut fields = Fields(chunk);
    let header = (|| {
        // Times of the first and last message, size and CRC of the records once decompressed.
        let _ = (fields.u64()?, fields.u64()?, fields.u64()?, fields.u32()?);
        Some((fields.string()?.is_empty(), fields.u64()?))
    })();
    let Some((plain, count)) = header else { return false };
    if !plain {
        // Not written by us; what is left of a torn one cannot be decompressed.
        return whole && unpack(chunk, visit);
    }
    let records = fields.bytes(count).unwrap_or(fields.0);
    let sound = records.len() as u64 == count && show_records(records, visit);
    // Only of a chunk whose records fit it exactly: see the module's comment.
    sound && unpack(chunk, &mut |_, _| ())
}

/// Shows records until one does not fit; did all of them?
fn show_records(records: &[u8], visit: &mut dyn FnMut(u8, &[u8])) -> bool {
    let mut fields = Fields(records);
    while !fields.0.is_empty() {
        let record = (|| Some((fields.u8()?, fields.u64()?)))();
        let Some((opcode, record)) = record.and_then(|(opcode, length)| Some((opcode, fields.bytes(length)?))) else {
            return false;
        };
        visit(opcode, record);
    }
    true
}

/// Decompresses a chunk, checks its CRC, then shows its records.
fn unpack(chunk: &[u8], visit: &mut dyn FnMut(u8, &[u8])) -> bool {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(usize::try_from(MAX_RECORD).unwrap_or(usize::MAX));
    let mut reader = LinearReader::new_with_options(options);
    let mut head = [op::CHUNK; 9];
    if let Some(length) = head.last_chunk_mut() {
        *length = (chunk.len() as u64).to_le_bytes();
    }
    let mut input = head.chain(chunk);
    loop {
        match reader.next_event() {
            Some(Ok(LinearReadEvent::ReadRequest(count))) => {
                let Ok(count) = input.read(reader.insert(count.min(1 << 20))) else { return false };
                reader.notify_read(count);
            }
            Some(Ok(LinearReadEvent::Record { opcode, data })) => visit(opcode, data),
            Some(Err(_)) => return false,
            None => return true,
        }
    }
}
