//! What people noted about an episode, in a file beside it: `X.mcap.toml` beside `X.mcap`.
//!
//! It travels with the episode, whoever copies the folder, and is about its content, whatever the session's file says.
//! While an episode is being recorded, its notes are in the session's file alone.
//!
//! Invariant: the file changes from one whole version to the next, and a change waits for the disk.
//! Invariant: of changes made by several programs at the same time none is lost.

use std::ffi::OsString;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_status::session::{Notes, NotesChange};
use rapid_system::folder::{Folder, Sync};
use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

use crate::partial::finished_name;

/// Larger than the notes of any episode.
const LARGEST: u64 = 1 << 24;
/// How often another program is waited for that changes notes in the same folder, each time 5 ms.
const TRIES: u32 = 200;
/// For people who open it.
const HEAD: &str = "# What people noted about the episode beside it; `rapid label` changes it.\n";
/// Ending of the file, after the whole name of the episode.
const ENDING: &str = ".toml";

/// Why notes cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum NotesError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The file is not one of notes.
    #[error("{}: line {line}: {why}; correct it, or remove the file", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong there.
        why: String,
    },
}

/// The name of the file with the notes of the episode `name`, finished or not.
pub fn name_for(name: &Path) -> OsString {
    let mut name = finished_name(name).into_os_string();
    name.push(ENDING);
    name
}

/// What is noted about the episode `name` of this folder; `None` if there is no such file.
///
/// # Errors
/// When the file cannot be read, or holds something else.
pub fn read(folder: &Folder, name: &Path) -> Result<Option<Notes>, NotesError> {
    let name = name_for(name);
    let path = folder.path().join(&name);
    let mut text = String::new();
    let read = folder.open_file(&name).and_then(|file| file.take(LARGEST).read_to_string(&mut text));
    match read {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(source) => return Err(NotesError::Io { path, source }),
        Ok(_) => {}
    }
    toml::from_str(&text).map(Some).map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        NotesError::Invalid { path, line: before.matches('\n').count() + 1, why: error.message().to_owned() }
    })
}

/// Changes what is noted about the episode `name` of this folder, and waits for the disk. `before` is what is noted if
/// there is no file yet: what the session's file says.
///
/// # Errors
/// When the file cannot be read or is not one of notes, or the disk does not accept it; nothing has changed then.
pub fn change(
    folder: &Folder,
    name: &Path,
    before: impl FnOnce() -> Notes,
    changes: &[NotesChange],
) -> Result<Notes, NotesError> {
    let _alone = Alone::take(folder);
    let mut notes = read(folder, name)?.unwrap_or_else(before);
    for change in changes {
        notes.apply(change);
    }
    write(folder, name, &notes)?;
    Ok(notes)
}

/// The right to change files of notes in a folder.
struct Alone<'a>(&'a Folder);

impl<'a> Alone<'a> {
    /// Waits for another program that changes some, not for one that never ends, nor where the file system has no locks:
    /// the last of two changes counts then.
    fn take(folder: &'a Folder) -> Self {
        for _ in 0..TRIES {
            match flock(folder.descriptor(), FlockOperation::NonBlockingLockExclusive) {
                Err(Errno::WOULDBLOCK) => std::thread::sleep(Duration::from_millis(5)),
                _ => break,
            }
        }
        Self(folder)
    }
}

impl Drop for Alone<'_> {
    fn drop(&mut self) {
        // What is not locked need not be unlocked.
        let _ = flock(self.0.descriptor(), FlockOperation::Unlock);
    }
}

/// Gives the episode `to` what is noted about the episode `from`, if anything is and nothing is noted about `to`.
///
/// # Errors
/// When it cannot be read or written.
pub(crate) fn copy(folder: &Folder, from: &Path, to: &Path) -> Result<(), NotesError> {
    match read(folder, from)? {
        Some(notes) if !folder.has(name_for(to)) => write(folder, to, &notes),
        _ => Ok(()),
    }
}

fn write(folder: &Folder, name: &Path, notes: &Notes) -> Result<(), NotesError> {
    let name = name_for(name);
    let io = |source| NotesError::Io { path: folder.path().join(&name), source };
    let text = toml::to_string(notes).map_err(|error| io(io::Error::other(error)))?;
    folder.replace_by_umask(&name, format!("{HEAD}{text}").as_bytes(), Sync::Wait).map_err(io)?;
    // A file system without this keeps the name at its own pace.
    let _ = folder.sync();
    Ok(())
}

#[cfg(test)]
mod tests;
