//! The mark that a recorder appends to a file that it called BAD because the disk or another program damaged it: the
//! summary may be GOOD by then, and the file may get its name back. The damaged place is unknown, so the mark follows
//! everything else and is found from the end of the file alone: the reason, its length and check value, [`MARK`].
//!
//! The program that damaged the file may append more: the mark is searched in the last [`SEARCHED`] bytes, unless the
//! file ends like a whole one.
//!
//! Invariant: other readers see only bytes after the end, which do not make a file whole.

use std::io;

use super::framing::MAGIC;
use super::source::{ReadAt, WindowedFile};
use super::wire::Fields;

/// The last bytes of such a file.
const MARK: [u8; 16] = *b"\0rapid/failed/1\n";
/// Bytes of length and check value.
const HEAD: usize = 8;
/// Bytes at the end that are searched: the program that damaged the file may have appended more.
const SEARCHED: u64 = 1 << 20;
/// Longest reason in bytes.
const LONGEST: usize = 4096;

/// Why the recorder of a file called it BAD.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Failed {
    /// For people.
    pub(crate) why: String,
    /// Bytes of the file before the mark.
    pub(crate) at: u64,
}

impl Failed {
    /// The bytes to append to the file.
    pub(crate) fn mark(why: &str) -> Vec<u8> {
        let why = why.get(..why.floor_char_boundary(LONGEST)).unwrap_or_default().as_bytes();
        let length = u32::try_from(why.len()).unwrap_or_default();
        [why, &length.to_le_bytes(), &crc32fast::hash(why).to_le_bytes(), &MARK].concat()
    }

    /// Reads the mark from the end of a file of `size` bytes, if present; the last of several.
    pub(crate) fn read(file: &(impl ReadAt + ?Sized), size: u64) -> io::Result<Option<Self>> {
        let mut end = Vec::new();
        let from = size.saturating_sub(SEARCHED);
        if !WindowedFile::new(file, size).read(from, size - from, &mut end)? || end.ends_with(&MAGIC) {
            return Ok(None);
        }
        // A reason may contain the text of a mark, but not a valid mark.
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
    fn trailing_bytes_hide_the_mark_only_if_they_end_an_mcap_file() {
        let bytes = |behind: &[u8]| [&b"content"[..], &Failed::mark("another program cut it"), behind].concat();
        let found = |bytes: &[u8]| Failed::read(bytes, bytes.len() as u64).unwrap();
        for behind in [&b"\n"[..], b"a line\n", &[0; 300], &vec![7; 1 << 19]] {
            let found = found(&bytes(behind)).unwrap_or_else(|| panic!("{} bytes", behind.len()));
            assert_eq!((found.at, found.why.as_str()), (7, "another program cut it"), "{} bytes", behind.len());
        }
        // The last of several counts; a whole file with such a mark in a message has not failed.
        assert_eq!(found(&bytes(&Failed::mark("the disk"))).unwrap().why, "the disk");
        assert_eq!(found(&bytes(b"\x89MCAP0\r\n")), None);
        // An invalid mark hides no valid one.
        assert_eq!(found(&bytes(&MARK)).unwrap().why, "another program cut it");
    }

    #[test]
    fn the_mark_is_found_after_any_content_and_nowhere_else() {
        let long = "ü".repeat(LONGEST);
        for before in [&b""[..], b"x", &[0; 9000]] {
            for why in ["", "another program cut it", &long] {
                let bytes = [before, &Failed::mark(why)].concat();
                let found = Failed::read(&bytes[..], bytes.len() as u64).unwrap().unwrap();
                assert_eq!((found.at, found.why.len()), (before.len() as u64, why.len().min(LONGEST)));
                assert!(why.starts_with(&found.why));
                for at in before.len()..bytes.len() {
                    let mut flipped = bytes.clone();
                    flipped[at] ^= 1;
                    assert_eq!(Failed::read(&flipped[..], bytes.len() as u64).unwrap(), None, "byte {at}");
                    if before.len() < 2 {
                        assert_eq!(Failed::read(&bytes[..at], at as u64).unwrap(), None, "cut at {at}");
                    }
                }
            }
        }
    }
}
