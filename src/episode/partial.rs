//! A file being written or repaired: its lock, and its final name, which is given once and never taken from another
//! file.
//!
//! The lock is an advisory lock of the open file (flock): it ends with its process, however that ends, and copies of
//! the handle share it.
//!
//! Invariant: a process that writes, repairs or removes a `.partial` holds its lock.

use std::fs::{File, TryLockError};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rapid_system::folder::{Folder, Links, Missing};

/// Extension of a file that is not finished.
pub(crate) const PARTIAL: &str = "partial";
/// Folder beside the episodes for those that were discarded.
pub const TRASH: &str = ".trash";

/// The name that this file of an episode has once it is finished, without its folder.
pub fn finished_name(file: &Path) -> PathBuf {
    let name = Path::new(file.file_name().unwrap_or_default());
    if name.extension().is_some_and(|ending| ending == PARTIAL) { name.with_extension("") } else { name.to_owned() }
}

/// The owner of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lock {
    /// Ours, as long as the handle or a copy of it is open.
    Ours,
    /// Another process writes or repairs it.
    Others,
    /// The name is gone, or means another file by now.
    Gone,
    /// This file system has no locks.
    Unknown,
}

/// Tries to take the lock of `file`, which was opened as `path`. Never waits.
pub(crate) fn lock(file: &File, path: &Path) -> io::Result<Lock> {
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Ok(Lock::Others),
        // A file system without locks gives one of a dozen errors.
        Err(TryLockError::Error(error)) => {
            tracing::debug!(path = %path.display(), %error, "no lock");
            return Ok(Lock::Unknown);
        }
    }
    // Between opening and locking another program may have finished and removed it.
    let ours = file.metadata()?;
    Ok(match std::fs::symlink_metadata(path) {
        Ok(named) if (named.dev(), named.ino()) == (ours.dev(), ours.ino()) => Lock::Ours,
        Ok(_) => Lock::Gone,
        Err(error) if error.kind() == io::ErrorKind::NotFound => Lock::Gone,
        Err(error) => return Err(error),
    })
}

/// Gives a file its final name, in the same folder, which must be free, and waits for the name to be
/// on the disk where the file system can be asked for that.
pub(crate) fn publish(file: &Path, name: &Path) -> io::Result<()> {
    let folder = Folder::open(name.parent().unwrap_or(Path::new("")), Links::Own, Missing::Refused);
    rename(&folder.map_err(io::Error::from)?, file, name)
}

/// [`publish`] in a folder that is open.
pub(crate) fn rename(folder: &Folder, file: &Path, name: &Path) -> io::Result<()> {
    let part = |path: &'_ Path| path.file_name().unwrap_or_default().to_owned();
    folder.rename_new(&part(file), &part(name))?;
    // The file has its name; only a loss of power right now could undo that.
    if let Err(error) = folder.sync() {
        tracing::warn!(folder = %folder.path().display(), %error, "folder not synced");
    }
    Ok(())
}
