//! What a recorder writes behind a file that it called BAD because the disk or another program damaged it: the summary
//! may be GOOD by then, and its name may be given back. What is damaged is unknown, so that this stands behind
//! everything else and is found from the end of the file alone: the reason, its length and check value, [`MARK`].
//!
//! The program that damaged the file may write more behind that: it is looked for in the last [`SEARCHED`] bytes, unless
//! the file ends as a whole one does.
//!
//! Invariant: to every other reader these are bytes behind the end, which make no file whole.

use std::io;

use super::record_iter::MAGIC;
use super::source::{ReadAt, Source};
use super::wire::Fields;

/// The last bytes of such a file.
const MARK: [u8; 16] = *b"\0rapid/failed/1\n";
/// Bytes of length and check value.
const HEAD: usize = 8;
/// Bytes at the end in which it is looked for: the program that damaged the file may have written more since.
const SEARCHED: u64 = 1 << 20;
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

    /// Reads it from the end of a file of `size` bytes, if it stands there; of several the last.
    pub(crate) fn of(file: &(impl ReadAt + ?Sized), size: u64) -> io::Result<Option<Self>> {
        let mut end = Vec::new();
        let from = size.saturating_sub(SEARCHED);
        if !Source::new(file, size).read(from, size - from, &mut end)? || end.ends_with(&MAGIC) {
            return Ok(None);
        }
        // A reason may contain the text of a mark, but nothing that is right as one.
        let mut marks = end.windows(MARK.len()).enumerate().rev().filter(|(_, bytes)| *bytes == MARK);
        Ok(marks.find_map(|(mark, _)| Self::before(end.get(..mark)?, from)))
    }

    /// What stands before a mark; `bytes` are those of the file from `from` up to it.
    fn before(bytes: &[u8], from: u64) -> Option<Self> {
        let (reasons, head) = bytes.split_last_chunk::<HEAD>()?;
        let mut head = Fields(head);
        let (length, crc) = (usize::try_from(head.u32()?).ok()?, head.u32()?);
        let begin = reasons.len().checked_sub(length)?;
        let why = reasons.get(begin..).filter(|why| crc32fast::hash(why) == crc)?;
        Some(Self { why: str::from_utf8(why).ok()?.to_owned(), at: from + begin as u64 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_behind_it_hide_it_only_where_they_end_a_file() {
        let bytes = |behind: &[u8]| [&b"content"[..], &Failed::mark("another program cut it"), behind].concat();
        let found = |bytes: &[u8]| Failed::of(bytes, bytes.len() as u64).unwrap();
        for behind in [&b"\n"[..], b"a line\n", &[0; 300], &vec![7; 1 << 19]] {
            let found = found(&bytes(behind)).unwrap_or_else(|| panic!("{} bytes", behind.len()));
            assert_eq!((found.at, found.why.as_str()), (7, "another program cut it"), "{} bytes", behind.len());
        }
        // Of several the last; a whole file with such a mark in one of its messages has not failed.
        assert_eq!(found(&bytes(&Failed::mark("the disk"))).unwrap().why, "the disk");
        assert_eq!(found(&bytes(b"\x89MCAP0\r\n")), None);
        // What looks like a mark and is none hides none.
        assert_eq!(found(&bytes(&MARK)).unwrap().why, "another program cut it");
    }

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
