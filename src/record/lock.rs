//! The lock on a file that is being written or repaired.
//!
//! An advisory lock of the open file (flock): it ends with the process that holds it, however that
//! ends, and copies of the handle share it.
//!
//! Invariant: whoever writes a `.partial`, repairs it or takes it away holds its lock.

use std::fs::{File, TryLockError};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// Whose a file is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Lock {
    /// Ours, as long as the handle or a copy of it is open.
    Ours,
    /// Somebody else writes or repairs it.
    Others,
    /// The name has gone, or means another file by now.
    Gone,
    /// This file system knows no locks.
    Unknown,
}

/// Tries to take the lock of `file`, which was opened as `path`. Never waits.
pub(super) fn take(file: &File, path: &Path) -> io::Result<Lock> {
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Ok(Lock::Others),
        // A file system without locks says one of a dozen things.
        Err(TryLockError::Error(error)) => {
            tracing::debug!(path = %path.display(), %error, "no lock");
            return Ok(Lock::Unknown);
        }
    }
    // Between opening and locking somebody may have finished and removed it.
    let ours = file.metadata()?;
    Ok(match std::fs::symlink_metadata(path) {
        Ok(named) if (named.dev(), named.ino()) == (ours.dev(), ours.ino()) => Lock::Ours,
        Ok(_) => Lock::Gone,
        Err(error) if error.kind() == io::ErrorKind::NotFound => Lock::Gone,
        Err(error) => return Err(error),
    })
}
