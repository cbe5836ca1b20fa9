//! What people noted about the episodes of any folder, in progress or long ended: the one reader for lists, pictures and
//! datasets.
//!
//! The file beside an episode ([`rapid_episode::notes`]) holds; without one, the latest of the folder's sessions that has
//! the episode does.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rapid_episode::notes::{self, NotesError};
use rapid_episode::partial::finished_name;
use rapid_status::session::{Notes, NotesChange};
use rapid_system::folder::{Folder, FolderError, Links, Missing};

use super::journal::{self, JournalError};
use super::{LONGEST_TEXT, Refusal};

/// Why it is not known what was noted, or it cannot be changed.
#[derive(Debug, thiserror::Error)]
pub enum NotedError {
    /// The file beside an episode.
    #[error(transparent)]
    Notes(#[from] NotesError),
    /// A session's file.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// The folder.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A text is too long.
    #[error(transparent)]
    TooLong(Refusal),
}

/// Label, note and marks of each of these files about which something is noted. `warn` gets what could not be read.
pub fn noted(files: &[PathBuf], warn: &mut dyn FnMut(&NotedError)) -> BTreeMap<PathBuf, Notes> {
    let mut by_folder: BTreeMap<&Path, Vec<&PathBuf>> = BTreeMap::new();
    for file in files {
        by_folder.entry(file.parent().unwrap_or(Path::new(""))).or_default().push(file);
    }
    let mut all = BTreeMap::new();
    for (folder, files) in by_folder {
        let here = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let mut of_sessions = of_sessions(here, warn);
        let open = Folder::open(here, Links::Own, Missing::Refused);
        for file in files {
            let name = finished_name(file);
            let beside = match &open {
                Ok(open) => notes::read(open, &name).unwrap_or_else(|error| {
                    warn(&error.into());
                    None
                }),
                Err(_) => None,
            };
            let notes = beside.or_else(|| of_sessions.remove(&*name.to_string_lossy()));
            all.extend(notes.filter(|notes| !notes.is_empty()).map(|notes| (file.clone(), notes)));
        }
        if let Err(error) = open {
            warn(&error.into());
        }
    }
    all
}

/// Changes what is noted about this file, whether or not a run has its session; the notes from then on.
///
/// # Errors
/// When what is noted cannot be read or written; nothing has changed then.
pub fn change(file: &Path, changes: &[NotesChange]) -> Result<Notes, NotedError> {
    let is_long = |change: &NotesChange| change.text().len() > LONGEST_TEXT;
    if changes.iter().any(is_long) {
        return Err(NotedError::TooLong(Refusal::TooLong));
    }
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let open = Folder::open(folder, Links::Own, Missing::Refused)?;
    let name = finished_name(file);
    let before = || of_sessions(folder, &mut |_| {}).remove(&*name.to_string_lossy()).unwrap_or_default();
    Ok(notes::change(&open, &name, before, changes)?)
}

/// What the sessions of a folder say, by the name of the episode; the latest session counts.
fn of_sessions(folder: &Path, warn: &mut dyn FnMut(&NotedError)) -> BTreeMap<String, Notes> {
    let (sessions, errors) = journal::sessions(folder);
    for error in errors {
        warn(&error.into());
    }
    let entries = sessions.into_iter().flat_map(|session| session.episodes);
    entries.filter(|entry| !entry.discarded).map(|entry| (entry.file.clone(), entry.notes())).collect()
}
