//! Data that a device sends instead of the bench's own pictures and lines: recorded data, in order, restarting with the
//! first record at the end.
//!
//! A feed is a file of records, each four bytes of length (little-endian) and that many bytes: a JPEG or a line.
//!
//! Invariant: a record is sent unchanged, except that a picture gets its identity like every picture of the bench.

use std::path::{Path, PathBuf};

use thiserror::Error;

/// The records of a feed.
pub type Records = std::sync::Arc<Vec<Vec<u8>>>;

/// A feed that cannot be sent.
#[derive(Debug, Error)]
pub enum FeedError {
    /// The file is missing or not readable.
    #[error("feed {0}: {1}")]
    Io(PathBuf, #[source] std::io::Error),
    /// It is not a file of records.
    #[error("feed {0}: not a file of records, each four bytes of length and that many bytes")]
    Records(PathBuf),
}

/// The contents of a feed with these records.
pub fn pack<R: AsRef<[u8]>>(records: impl IntoIterator<Item = R>) -> Vec<u8> {
    let mut packed = Vec::new();
    for record in records {
        let record = record.as_ref();
        packed.extend(u32::try_from(record.len()).expect("a picture or a line").to_le_bytes());
        packed.extend(record);
    }
    packed
}

/// Reads a feed, which must have at least one record.
pub fn load(path: &Path) -> Result<Records, FeedError> {
    let packed = std::fs::read(path).map_err(|error| FeedError::Io(path.into(), error))?;
    unpack(&packed)
        .filter(|records| !records.is_empty())
        .map(Records::new)
        .ok_or_else(|| FeedError::Records(path.into()))
}

fn unpack(mut packed: &[u8]) -> Option<Vec<Vec<u8>>> {
    let mut records = Vec::new();
    while let Some((length, rest)) = packed.split_first_chunk() {
        let (record, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
        records.push(record.to_vec());
        packed = rest;
    }
    packed.is_empty().then_some(records)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_frames_round_trip() {
        let records: [&[u8]; 3] = [b"one", b"", b"three\n"];
        let packed = pack(records);
        assert_eq!(unpack(&packed), Some(records.map(<[u8]>::to_vec).to_vec()));
        for cut in [1, 4, packed.len() - 1] {
            assert_eq!(unpack(&packed[..cut]), None, "{cut} bytes");
        }
    }
}
