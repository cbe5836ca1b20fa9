//! Reading files of which nobody knows who wrote them: no more of one is read than it may have, and bytes that were never
//! written are no content.
//!
//! Invariant: a file that is larger than allowed is an error, and not cut; nothing of it is read if its size shows it.

use std::fs::File;
use std::io::{self, Read};

use rapid_core::text;
use rustix::fs::{SeekFrom, seek};
use rustix::io::Errno;

/// The bytes of `file`, which may be `limit` at most.
///
/// # Errors
/// When it has more, or cannot be read.
pub fn read_bytes(file: &File, limit: u64) -> io::Result<Vec<u8>> {
    let too_large = || io::Error::other(format!("it is larger than {}: is it the right file?", text::size(limit)));
    if file.metadata()?.len() > limit {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    // What grows meanwhile, or reports no size.
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit { Err(too_large()) } else { Ok(bytes) }
}

/// The same of a text.
///
/// # Errors
/// As [`read_bytes`], and when it is not UTF-8.
pub fn read_text(file: &File, limit: u64) -> io::Result<String> {
    String::from_utf8(read_bytes(file, limit)?)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()))
}

/// A part of a file that was never written and reads as zeros; see `lseek(2)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hole {
    /// Where it begins, bytes.
    pub at: u64,
    /// Its length, bytes.
    pub bytes: u64,
}

/// The first hole in the `size` bytes of `file` that is longer than `longest`, or with which all so far exceed `total` and
/// `share` times the bytes that were written. `None` if there is none, or the file system does not say. Moves the position of
/// `file`, and puts it back.
pub fn large_hole(file: &File, size: u64, longest: u64, total: u64, share: u64) -> Option<Hole> {
    let before = seek(file, SeekFrom::Current(0)).ok()?;
    let found = first_hole(file, size, longest, total, share);
    // It was there before.
    let _ = seek(file, SeekFrom::Start(before));
    found
}

fn first_hole(file: &File, size: u64, longest: u64, total: u64, share: u64) -> Option<Hole> {
    let (mut next, mut written, mut missing) = (0, 0_u64, 0_u64);
    while next < size {
        let at = seek(file, SeekFrom::Hole(next)).ok()?.min(size);
        let end = match seek(file, SeekFrom::Data(at)) {
            Ok(end) => end.min(size),
            Err(Errno::NXIO) => size,
            Err(_) => return None,
        };
        let bytes = end.saturating_sub(at);
        (written, missing) = (written.saturating_add(at - next), missing.saturating_add(bytes));
        if bytes > longest || missing > total.saturating_add(written.saturating_mul(share)) {
            return Some(Hole { at, bytes });
        }
        if end <= next {
            return None;
        }
        next = end;
    }
    None
}

#[cfg(test)]
mod tests {
    use std::io::{Seek as _, Write as _};
    use std::os::unix::fs::FileExt as _;

    use super::*;

    #[test]
    fn a_file_that_is_larger_than_allowed_is_an_error() {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(b"0123456789").unwrap();
        for (limit, is_read) in [(9, false), (10, true), (u64::MAX, true)] {
            file.rewind().unwrap();
            assert_eq!(read_bytes(&file, limit).ok().as_deref(), is_read.then_some(&b"0123456789"[..]), "{limit}");
        }
        // Terabytes that were never written.
        file.set_len(1 << 40).unwrap();
        assert!(read_text(&file, 1 << 30).unwrap_err().to_string().contains("larger than 1.1 GB"));
        // No size is reported.
        let endless = File::open("/dev/zero").unwrap();
        assert!(read_bytes(&endless, 1 << 20).is_err());
        assert!(!read_text(&File::open("/proc/self/stat").unwrap(), 1 << 20).unwrap().is_empty());
    }

    #[test]
    fn holes_are_found_by_length_and_in_all() {
        const MIB: u64 = 1 << 20;
        let file = tempfile::tempfile_in(".").unwrap();
        // Data, 3 MiB of nothing, data, 5 MiB of nothing.
        file.write_all_at(&[1; 4096], 0).unwrap();
        file.write_all_at(&[1; 4096], 3 * MIB).unwrap();
        file.set_len(8 * MIB).unwrap();
        let found = |longest, total, share| {
            (&file).seek(std::io::SeekFrom::Start(7)).unwrap();
            let found = large_hole(&file, 8 * MIB, longest, total, share);
            assert_eq!((&file).stream_position().unwrap(), 7);
            found.map(|hole| hole.at / MIB)
        };
        if found(0, 0, 0).is_none() {
            // A file system that does not say.
            return;
        }
        assert_eq!(found(2 * MIB, 100 * MIB, 0), Some(0));
        assert_eq!(found(4 * MIB, 100 * MIB, 0), Some(3));
        assert_eq!(found(6 * MIB, 100 * MIB, 0), None);
        assert_eq!((found(6 * MIB, 7 * MIB, 0), found(6 * MIB, 7 * MIB, 200)), (Some(3), None));
    }
}
