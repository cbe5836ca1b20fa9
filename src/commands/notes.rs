//! `rapid label`: what people note about an episode of any folder.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_episode::partial::finished_name;
use rapid_episode::record::inspect::{self, Judgement};
use rapid_status::session::NotesChange;

use super::Format;
use crate::session::noted::{NotedError, change};

/// Why something is not noted.
#[derive(Debug, thiserror::Error)]
pub enum NoteError {
    /// There is no such file.
    #[error("{}: {source}", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// Something else than an episode.
    #[error("{}: not an episode: name a file X.mcap or X.mcap.partial", .0.display())]
    NoEpisode(PathBuf),
    /// The moment is not in the episode.
    #[error("{}: it has no moment at {at} s: its length is {seconds:.3} s", file.display())]
    Beyond {
        /// The file.
        file: PathBuf,
        /// The time of the mark, in seconds.
        at: f64,
        /// Its length.
        seconds: f64,
    },
    /// Nothing is to be changed.
    #[error("nothing to note: give a label (success, failure or none), --note or --mark")]
    Nothing,
    /// What is noted cannot be read or written.
    #[error(transparent)]
    Noted(#[from] NotedError),
    /// The output.
    #[error(transparent)]
    Output(#[from] io::Error),
}

/// Changes what is noted about an episode, all of it or nothing, and prints what was done once it is on the disk.
///
/// # Errors
/// When it is no episode, or the disk does not accept the change; nothing has changed then.
pub fn note(file: &Path, changes: &[NotesChange], format: Format, out: &mut dyn Write) -> Result<(), NoteError> {
    let is_file = file.metadata().map_err(|source| NoteError::Io { file: file.to_owned(), source })?.is_file();
    let name = finished_name(file);
    if !is_file || name.extension().is_none_or(|ending| ending != "mcap") {
        return Err(NoteError::NoEpisode(file.to_owned()));
    }
    if changes.is_empty() {
        return Err(NoteError::Nothing);
    }
    let marks =
        changes.iter().filter_map(|change| if let NotesChange::Mark(mark) = change { Some(mark.at) } else { None });
    if let Some(at) = marks.reduce(f64::max) {
        let listed = inspect::list(file);
        if matches!(listed.verdict, Judgement::Episode(_)) && at > listed.seconds {
            return Err(NoteError::Beyond { file: file.to_owned(), at, seconds: listed.seconds });
        }
    }
    change(file, changes)?;
    let done: Vec<String> = changes.iter().map(done).collect();
    let answer = format!("{}: {}", name.display(), done.join(", "));
    Ok(super::session::done(&text::plain(&answer), format, out)?)
}

fn done(change: &NotesChange) -> String {
    match change {
        NotesChange::Label(Some(label), _) => label.to_string(),
        NotesChange::Label(None, _) => "label removed".to_owned(),
        NotesChange::Note(text) if text.is_empty() => "note removed".to_owned(),
        NotesChange::Note(_) => "noted".to_owned(),
        NotesChange::Mark(mark) => format!("marked at {} s", mark.at),
    }
}
