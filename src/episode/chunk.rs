//! Opening a chunk: its records are decompressed and compared with their check value.

use std::io::Read;
use std::ops::Range;

use super::framing::MAX_RECORD;
use super::op;
use super::wire::Fields;

/// The header of a chunk, before its records.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ChunkHead {
    /// `log_time` of the first message and of the last.
    pub(super) times: (u64, u64),
    /// Bytes of its records.
    pub(super) size: u64,
    /// Their check value; zero means none.
    pub(super) crc: u32,
    pub(super) packing: Packing,
    /// Bytes of its records as they lie in the file.
    pub(super) packed: u64,
    /// Bytes of this head.
    pub(super) bytes: u64,
}

/// How the records of a chunk are compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Packing {
    Plain,
    Zstd,
    Lz4,
    Unknown,
}

impl ChunkHead {
    /// Reads it from the beginning of a chunk's content; `None` if that is too short or no text names the packing.
    pub(super) fn read(content: &[u8]) -> Option<Self> {
        let mut fields = Fields(content);
        let times = (fields.u64()?, fields.u64()?);
        let (size, crc, compression, packed) = (fields.u64()?, fields.u32()?, fields.string()?, fields.u64()?);
        let packing = match compression {
            "" => Packing::Plain,
            "zstd" => Packing::Zstd,
            "lz4" => Packing::Lz4,
            _ => Packing::Unknown,
        };
        Some(Self { times, size, crc, packing, packed, bytes: (content.len() - fields.0.len()) as u64 })
    }

    /// Bytes of the whole content, by this head.
    pub(super) fn content(&self) -> u64 {
        self.bytes.saturating_add(self.packed)
    }
}

/// The location of the records of a chunk.
#[derive(Debug)]
pub(super) struct Records {
    /// In the decompressed bytes; otherwise in the chunk itself.
    pub(super) unpacked: bool,
    /// Which of those bytes.
    pub(super) range: Range<usize>,
}

/// The state of a chunk's content.
pub(super) enum Opened {
    /// Its check value is right, or there is none.
    Right(Records),
    /// It differs from what was written.
    Damaged,
    /// It would decompress to more than the remaining budget.
    TooMuch,
}

/// The cost of a record of a compressed chunk, in decompressed bytes: every record is processed, however short. Samples
/// of a 1 kHz sensor compress to six bytes and more.
const RECORD: u64 = 400;

/// Opens `content`, which begins with `head`. Decompressed records go to `unpacked`; their bytes, and [`RECORD`] for
/// each record, are subtracted from `budget`.
pub(super) fn open(head: &ChunkHead, content: &[u8], unpacked: &mut Vec<u8>, budget: &mut u64) -> Opened {
    let packed = usize::try_from(head.bytes).ok().and_then(|begin| Some((begin, content.get(begin..)?)));
    let Some((begin, rest)) = packed else { return Opened::Damaged };
    let Some(packed) = usize::try_from(head.packed).ok().and_then(|count| rest.get(..count)) else {
        return Opened::Damaged;
    };
    if head.packing == Packing::Plain {
        let right = head.size == head.packed && is_sound(packed, head.crc) && count(packed).is_some();
        let range = begin..begin + packed.len();
        return if right { Opened::Right(Records { unpacked: false, range }) } else { Opened::Damaged };
    }
    unpacked.clear();
    if head.size > MAX_RECORD {
        return Opened::Damaged;
    }
    if head.size > *budget {
        return Opened::TooMuch;
    }
    let whole = unpack(head.packing, packed, head.size, unpacked).is_some();
    *budget = budget.saturating_sub(unpacked.len() as u64);
    let Some(records) = count(unpacked).filter(|_| whole && is_sound(unpacked, head.crc)) else {
        return Opened::Damaged;
    };
    let Some(left) = budget.checked_sub(records.saturating_mul(RECORD)) else { return Opened::TooMuch };
    *budget = left;
    Opened::Right(Records { unpacked: true, range: 0..unpacked.len() })
}

/// Whether `bytes` match the check value. A check value of zero means that there is none.
pub(crate) fn is_sound(bytes: &[u8], crc: u32) -> bool {
    crc == 0 || crc32fast::hash(bytes) == crc
}

/// Takes the first record off `records`: its opcode and content.
pub(super) fn first_record<'a>(records: &mut Fields<'a>) -> Option<(u8, &'a [u8])> {
    let (opcode, length) = (records.u8()?, records.u64()?);
    Some((opcode, records.bytes(length)?))
}

/// How many records fill these bytes; `None` if the last is not whole.
fn count(records: &[u8]) -> Option<u64> {
    let (mut fields, mut count) = (Fields(records), 0);
    while !fields.0.is_empty() {
        first_record(&mut fields)?;
        count += 1;
    }
    Some(count)
}

/// May a record of a chunk begin like this: opcode and length, and of a message `begin`, the first of its bytes?
pub(super) fn may_begin(head: &ChunkHead, opcode: u8, begin: &[u8]) -> bool {
    match opcode {
        op::SCHEMA | op::CHANNEL | op::PRIVATE.. => true,
        op::MESSAGE => {
            let mut fields = Fields(begin);
            let time = (|| {
                let _ = (fields.u16()?, fields.u32()?);
                fields.u64()
            })();
            time.is_none_or(|time| (head.times.0..=head.times.1).contains(&time))
        }
        _ => false,
    }
}

/// Decompresses `packed` to exactly `size` bytes; memory grows with the actual output, not with the stated size.
fn unpack(packing: Packing, packed: &[u8], size: u64, into: &mut Vec<u8>) -> Option<()> {
    let read = match packing {
        Packing::Zstd => zstd::stream::read::Decoder::new(packed).ok()?.take(size).read_to_end(into),
        Packing::Lz4 => lz4::Decoder::new(packed).ok()?.take(size).read_to_end(into),
        Packing::Plain | Packing::Unknown => return None,
    };
    (read.ok()? as u64 == size).then_some(())
}
