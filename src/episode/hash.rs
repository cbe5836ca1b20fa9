//! SHA-256 of a file, hexadecimal: what an episode is known by, whatever its name.
//!
//! Invariant: memory holds one piece of the file.

use std::io;
use std::path::Path;

use rapid_core::text;
use sha2::{Digest, Sha256};

use super::{ReadAt, ReadError, open};

/// Bytes read at once.
const PIECE: usize = 256 << 10;

/// The SHA-256 of the file at `path`.
///
/// # Errors
/// When it cannot be read, or is not a file.
pub fn sha256(path: &Path) -> Result<String, ReadError> {
    let (file, size) = open(path)?;
    sha256_of(&file, size, |_| ()).map_err(|source| ReadError::Io { path: path.to_owned(), source })
}

/// The SHA-256 of the first `size` bytes of `file`, or of all if it is shorter; `progress` gets the bytes done so far.
pub(super) fn sha256_of(file: &impl ReadAt, size: u64, mut progress: impl FnMut(u64)) -> io::Result<String> {
    let (mut hasher, mut piece) = (Sha256::new(), vec![0; PIECE]);
    let mut done = 0;
    while done < size {
        let count = usize::try_from(size - done).unwrap_or(usize::MAX).min(PIECE);
        let Some(room) = piece.get_mut(..count) else { break };
        let read = match file.read_at(room, done) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            read => read?,
        };
        if read == 0 {
            break;
        }
        hasher.update(room.get(..read).unwrap_or_default());
        done += read as u64;
        progress(done);
    }
    Ok(text::hexadecimal(&hasher.finalize()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    /// FIPS 180-2, appendix B.1 and B.3: "abc", and a million times "a".
    #[test]
    fn the_hash_is_that_of_the_standard() {
        const ABC: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        const MILLION: &str = "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0";
        let (bytes, mut seen) = (vec![b'a'; 1_000_000], Vec::new());
        assert_eq!(sha256_of(&&b"abcd"[..], 3, |_| ()).unwrap(), ABC);
        assert_eq!(sha256_of(&&b"abc"[..], 9, |_| ()).unwrap(), ABC, "shorter than it was");
        assert_eq!(sha256_of(&&bytes[..], 1_000_000, |done| seen.push(done)).unwrap(), MILLION);
        assert_eq!(seen.last(), Some(&1_000_000));
    }

    #[test]
    fn a_folder_is_refused() {
        assert!(matches!(sha256(Path::new("/")), Err(ReadError::NotFile(_))));
    }
}
