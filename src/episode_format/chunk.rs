//! A chunk opened up: its records decompressed and held against their check value.

use std::io::Read;
use std::ops::Range;

use super::walk::{MAX_RECORD, Trust};
use super::wire::Fields;

/// Where the records of a chunk are.
pub(super) struct Opened {
    /// In the decompressed bytes; otherwise in the chunk itself.
    pub(super) unpacked: bool,
    /// Which of those bytes.
    pub(super) records: Range<usize>,
    pub(super) trust: Trust,
    /// Its check value is there and right; one of zero is that of no bytes alone.
    pub(super) proven: bool,
}

impl Opened {
    const NOTHING: Range<usize> = 0..0;

    /// Opens `chunk`, the content of a chunk's record, cut short unless it is `whole`; what had to be
    /// decompressed is in `unpacked`.
    pub(super) fn new(chunk: &[u8], whole: bool, unpacked: &mut Vec<u8>) -> Self {
        let doubt = if whole { Trust::Damaged } else { Trust::Torn };
        let nothing = Self { unpacked: false, records: Self::NOTHING, trust: doubt, proven: false };
        let mut fields = Fields(chunk);
        let head = (|| {
            // Times of the first and the last message.
            let _ = (fields.u64()?, fields.u64()?);
            Some((fields.u64()?, fields.u32()?, fields.string()?, fields.u64()?))
        })();
        let Some((size, crc, compression, count)) = head else { return nothing };
        let begin = chunk.len() - fields.0.len();
        let Some(packed) = fields.bytes(count) else {
            // What a cut chunk still holds can only be read where it is not compressed.
            let end = if compression.is_empty() { chunk.len() } else { begin };
            return Self { records: begin..end, ..nothing };
        };
        if compression.is_empty() {
            let sound = size == count && is_sound(packed, crc);
            let trust = if sound && fits(packed) { Trust::Sound } else { Trust::Damaged };
            let proven = trust == Trust::Sound && is_proven(packed, crc);
            return Self { unpacked: false, records: begin..begin + packed.len(), trust, proven };
        }
        unpacked.clear();
        if size > MAX_RECORD || unpack(compression, packed, size, unpacked).is_none() {
            return nothing;
        }
        let trust = if is_sound(unpacked, crc) && fits(unpacked) { Trust::Sound } else { Trust::Damaged };
        let proven = trust == Trust::Sound && is_proven(unpacked, crc);
        Self { unpacked: true, records: 0..unpacked.len(), trust, proven }
    }
}

/// Are `bytes` as they were written? A check value of zero says that there is none.
pub(crate) fn is_sound(bytes: &[u8], crc: u32) -> bool {
    crc == 0 || is_proven(bytes, crc)
}

/// Are `bytes` as they were written, by a check value that is there? That of no bytes is zero.
fn is_proven(bytes: &[u8], crc: u32) -> bool {
    crc32fast::hash(bytes) == crc
}

/// Do whole records fill these bytes?
fn fits(records: &[u8]) -> bool {
    let mut fields = Fields(records);
    while !fields.0.is_empty() {
        let record = (|| {
            fields.u8()?;
            let length = fields.u64()?;
            fields.bytes(length)
        })();
        if record.is_none() {
            return false;
        }
    }
    true
}

/// Decompresses `packed` to exactly `size` bytes: memory is taken for what comes out, not for what
/// is promised.
fn unpack(compression: &str, packed: &[u8], size: u64, into: &mut Vec<u8>) -> Option<()> {
    let read = match compression {
        "zstd" => zstd::stream::read::Decoder::new(packed).ok()?.take(size).read_to_end(into),
        "lz4" => lz4::Decoder::new(packed).ok()?.take(size).read_to_end(into),
        _ => return None,
    };
    (read.ok()? as u64 == size).then_some(())
}
