//! What a recorder writes behind a file that it called BAD because the disk or another program damaged it: the summary
//! may be GOOD by then, and its name may be given back. What is damaged is unknown, so that this stands behind
//! everything else and is found from the end of the file alone: the reason, its length and check value, [`MARK`].
//!
//! Invariant: to every other reader these are bytes behind the end, which make no file whole.

use std::io;

use super::source::ReadAt;
use super::wire::Fields;

/// The last bytes of such a file.
const MARK: [u8; 16] = *b"\0rapid/failed/1\n";
/// Bytes of length and check value.
const HEAD: usize = 8;
/// Longest reason in bytes.
const LONGEST: usize = 4096;

/// Why the recorder of a file called it BAD.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Failed {
    /// For people.
    pub(crate) why: String,
    /// Bytes of the file before this.
    pub(crate) at: u64,
}

impl Failed {
    /// What is to be written behind the file.
    pub(crate) fn mark(why: &str) -> Vec<u8> {
        let why = why.get(..why.floor_char_boundary(LONGEST)).unwrap_or_default().as_bytes();
        let length = u32::try_from(why.len()).unwrap_or_default();
        [why, &length.to_le_bytes(), &crc32fast::hash(why).to_le_bytes(), &MARK].concat()
    }

    /// Reads it from the end of a file of `size` bytes, if it stands there.
    pub(crate) fn of(file: &(impl ReadAt + ?Sized), size: u64) -> io::Result<Option<Self>> {
        let mut end = vec![0; usize::try_from(size).unwrap_or(usize::MAX).min(LONGEST + HEAD + MARK.len())];
        let mut read = 0;
        let from = size - end.len() as u64;
        while let Some(room) = end.get_mut(read..).filter(|room| !room.is_empty()) {
            match file.read_at(room, from + read as u64) {
                Ok(0) => return Ok(None),
                Ok(count) => read += count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        let found = end.strip_suffix(&MARK).and_then(|end| end.split_last_chunk::<HEAD>());
        Ok(found.and_then(|(reasons, head)| {
            let mut head = Fields(head);
            let (length, crc) = (usize::try_from(head.u32()?).ok()?, head.u32()?);
            let why = reasons.get(reasons.len().checked_sub(length)?..).filter(|why| crc32fast::hash(why) == crc)?;
            let at = size - (length + HEAD + MARK.len()) as u64;
            Some(Self { why: str::from_utf8(why).ok()?.to_owned(), at })
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_found_behind_whatever_is_there_and_nowhere_else() {
        let long = "ü".repeat(LONGEST);
        for before in [&b""[..], b"x", &[0; 9000]] {
            for why in ["", "another program cut it", &long] {
                let bytes = [before, &Failed::mark(why)].concat();
                let found = Failed::of(&bytes[..], bytes.len() as u64).unwrap().unwrap();
                assert_eq!((found.at, found.why.len()), (before.len() as u64, why.len().min(LONGEST)));
                assert!(why.starts_with(&found.why));
                for at in before.len()..bytes.len() {
                    let mut flipped = bytes.clone();
                    flipped[at] ^= 1;
                    assert_eq!(Failed::of(&flipped[..], bytes.len() as u64).unwrap(), None, "byte {at}");
                    if before.len() < 2 {
                        assert_eq!(Failed::of(&bytes[..at], at as u64).unwrap(), None, "cut at {at}");
                    }
                }
            }
        }
    }
}
