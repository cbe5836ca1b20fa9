//! The session's file: which episodes were recorded, and the labels, marks and notes that people gave them.
//!
//! `session.toml` in the folder of the episodes while the session lasts, `session-BEGUN.toml` afterwards, and while another
//! task is collected: the next run with the task of such a session continues it. It is written at each change, atomically,
//! and waits for the disk: a crash or a power cut loses none of it.
//!
//! Invariant: a file that this session did not write is never replaced: it is moved aside, or this session takes another
//! name.
//! Invariant: a session belongs to one run at a time, which holds the lock of its file.
//! Invariant: what is written goes to the folder that was opened, also after that was moved.

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::time::{realtime_ns, rfc3339};
use rapid_episode::notes;
use rapid_status::session::EpisodeEntry;
use rapid_system::folder::{self, Folder, FolderError, Links, Missing, Sync};
use rustix::fs::{AtFlags, fstat, statat};
use serde::{Deserialize, Serialize};

use super::trash;

/// The name of the file of a session in progress.
const CURRENT: &str = "session.toml";
/// A file of a hundred thousand episodes is smaller; a larger one is not ours.
const LARGEST: u64 = 1 << 26;
/// For people who open it.
const HEAD: &str = "# A session of rapid. Written at each change while it lasts; edit it only when it has ended.\n";

/// What a session is to collect.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Plan {
    /// The task.
    pub task: String,
    /// How many episodes are wanted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub goal: Option<u32>,
    /// Each episode ends by itself after this time.
    #[serde(skip_serializing_if = "Option::is_none", with = "span")]
    pub episode_time: Option<Duration>,
    /// The next episode begins by itself this long after the end of the last, for which the scene is reset.
    #[serde(skip_serializing_if = "Option::is_none", with = "span")]
    pub reset_time: Option<Duration>,
    /// Time from the request to begin an episode to its beginning.
    #[serde(skip_serializing_if = "Option::is_none", with = "span")]
    pub countdown: Option<Duration>,
    /// Tags of the episodes.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub tags: BTreeMap<String, String>,
}

/// The contents of the file.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SessionFile {
    /// When the session began, RFC 3339, UTC.
    pub begun: String,
    /// When it ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ended: Option<String>,
    /// What was to be collected.
    #[serde(default)]
    pub plan: Plan,
    /// Names of the episodes that were deleted at its end: they are not given again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub deleted: Vec<String>,
    /// The episodes, in the order in which they were recorded.
    #[serde(default, rename = "episode")]
    pub episodes: Vec<EpisodeEntry>,
}

impl SessionFile {
    /// Whether it is of this task, or some of its episodes are.
    pub fn has(&self, task: &str) -> bool {
        self.plan.task == task || self.episodes.iter().any(|entry| entry.task == task)
    }

    /// Takes over what is found of its episodes: where they are, and what is noted beside them.
    fn examine(&mut self, folder: &Folder) {
        for episode in &mut self.episodes {
            let is_here = folder.has(&episode.file);
            let is_in_trash = trash::holds(folder, &episode.file);
            episode.discarded = was_discarded(episode.discarded, is_here, is_in_trash);
        }
        self.take_notes(folder);
    }

    /// Takes over what is noted beside its episodes: other programs may have noted it.
    fn take_notes(&mut self, folder: &Folder) {
        for episode in &mut self.episodes {
            match notes::read(folder, episode.file.as_ref()) {
                Ok(Some(notes)) => episode.set_notes(notes),
                Ok(None) => {}
                Err(error) => tracing::warn!(%error, "labels and notes of an episode are not read"),
            }
        }
    }

    /// The names of all its episodes.
    pub fn into_names(self) -> impl Iterator<Item = String> {
        self.episodes.into_iter().map(|entry| entry.file).chain(self.deleted)
    }
}

/// Why a session cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The file is not a session.
    #[error("{}: not a session file: {why}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Where, and what is wrong.
        why: String,
    },
    /// The file of a session in progress could not be read, and was moved.
    #[error(
        "{error}; it was moved to {}, and what it records about episodes is not used: what was discarded stays in .trash",
        moved.display()
    )]
    Moved {
        /// What is wrong with it.
        error: Box<JournalError>,
        /// Where it is.
        moved: PathBuf,
    },
}

/// Every session of the folder `episodes`, oldest first, and what could not be read.
pub fn sessions(episodes: &Path) -> (Vec<SessionFile>, Vec<JournalError>) {
    let (files, errors) = named_sessions(episodes);
    (files.into_iter().map(|(_, file)| file).collect(), errors)
}

/// The same, each with the name of its file. Of two that began at the same time, the order of their names decides: that in
/// progress is the last.
fn named_sessions(episodes: &Path) -> (Vec<(String, SessionFile)>, Vec<JournalError>) {
    let is_session = |name: &str| {
        let is_other = name.starts_with("session-") && !name.ends_with(".mcap.toml");
        name == CURRENT || (is_other && Path::new(name).extension().is_some_and(|ending| ending == "toml"))
    };
    let (mut files, mut errors) = (Vec::new(), Vec::new());
    let entries = match std::fs::read_dir(episodes) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return (files, errors),
        Err(source) => return (files, vec![JournalError::Io { path: episodes.to_owned(), source }]),
    };
    for entry in entries.flatten() {
        let Some(name) = entry.file_name().to_str().filter(|name| is_session(name)).map(str::to_owned) else {
            continue;
        };
        match read(&entry.path()) {
            Ok(file) => files.push((name, file)),
            Err(error) => errors.push(error),
        }
    }
    files.sort_by(|(a, one), (b, other)| one.begun.cmp(&other.begun).then_with(|| a.cmp(b)));
    (files, errors)
}

fn read(path: &Path) -> Result<SessionFile, JournalError> {
    let text = folder::read_text(path, LARGEST).map_err(|source| JournalError::Io { path: path.to_owned(), source })?;
    let invalid = |why: String| JournalError::Invalid { path: path.to_owned(), why };
    let line = |before: &str| before.matches('\n').count() + 1;
    let mut file: SessionFile = toml::from_str(&text).map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        invalid(format!("line {}: {}", line(before), error.message()))
    })?;
    let names = file.episodes.iter().map(|entry| &entry.file).chain(&file.deleted);
    if let Some(wrong) = names.into_iter().find(|name| !trash::is_name(name)) {
        let before = text.find(&**wrong).and_then(|at| text.get(..at)).unwrap_or_default();
        return Err(invalid(format!("line {}: {wrong:?} is not the name of an episode's file", line(before))));
    }
    // Older files have one task.
    for entry in file.episodes.iter_mut().filter(|entry| entry.task.is_empty()) {
        entry.task.clone_from(&file.plan.task);
    }
    Ok(file)
}

/// Whether an episode is discarded, by what was noted and where files with its name are. The run may have been killed
/// between the move of a file and the note of it, and its file may be gone from the trash.
fn was_discarded(noted: bool, is_here: bool, is_in_trash: bool) -> bool {
    match (is_here, is_in_trash) {
        (true, false) => false,
        (false, true) => true,
        _ => noted,
    }
}

/// The file of the session in progress. It is locked (flock) while a run has the session.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    /// The folder, open since it was there.
    folder: Option<Folder>,
    name: String,
    /// The file as read or written last, which holds the lock.
    held: Option<File>,
    /// When the session of another task began whose file is [`CURRENT`]. That is archived before this session's is written
    /// for the first time: a run that records nothing changes nothing.
    superseded: Option<String>,
}

impl Journal {
    /// The session in progress in `folder` that has this task, if there is one, continued with what is found of its
    /// episodes; and what was wrong with a file, which is then moved aside. A session that another run has is not continued.
    pub fn open(folder: &Path, task: &str) -> (Self, Option<SessionFile>, Option<JournalError>) {
        let mut journal = Self {
            path: folder.to_owned(),
            folder: Folder::open(folder, Links::Own, Missing::Refused).ok(),
            name: CURRENT.to_owned(),
            held: None,
            superseded: None,
        };
        remove_leftovers(folder);
        let (mut found, error) = journal.current(task);
        if found.is_none() {
            found = journal.earlier(task);
        }
        if let (Some(file), Some(folder)) = (&mut found, &journal.folder) {
            file.examine(folder);
        }
        (journal, found, error)
    }

    /// The session of [`CURRENT`], if it has this task.
    fn current(&mut self, task: &str) -> (Option<SessionFile>, Option<JournalError>) {
        let path = self.path.join(CURRENT);
        if matches!(path.symlink_metadata(), Err(error) if error.kind() == io::ErrorKind::NotFound) {
            return (None, None);
        }
        let held = match self.hold(CURRENT) {
            // This session gets another name.
            Err(Lock::Taken) => return (None, None),
            Err(Lock::None) => None,
            Ok(held) => Some(held),
        };
        match read(&path) {
            Ok(file) if file.ended.is_none() && file.has(task) => {
                self.held = held;
                (Some(file), None)
            }
            Ok(file) if file.ended.is_none() => {
                self.superseded = Some(file.begun);
                (None, None)
            }
            Ok(file) => (None, self.archive(&file.begun).err()),
            Err(error) => {
                let moved = self.archive(&format!("unreadable-{}", rfc3339(realtime_ns())));
                let error = match moved {
                    Ok(moved) => JournalError::Moved { error: Box::new(error), moved },
                    Err(error) => error,
                };
                (None, Some(error))
            }
        }
    }

    /// The latest session with this task that was put aside for another task's.
    fn earlier(&mut self, task: &str) -> Option<SessionFile> {
        let (sessions, _) = named_sessions(&self.path);
        for (name, file) in sessions.into_iter().rev() {
            if name != CURRENT
                && file.ended.is_none()
                && file.has(task)
                && let Ok(held) = self.hold(&name)
            {
                (self.held, self.name) = (Some(held), name);
                return Some(file);
            }
        }
        None
    }

    /// Locks a file.
    fn hold(&self, name: &str) -> Result<File, Lock> {
        let file = self.folder.as_ref().and_then(|folder| folder.open_file(name).ok()).ok_or(Lock::None)?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => Err(Lock::Taken),
            // Not every file system has locks.
            Ok(()) | Err(TryLockError::Error(_)) => Ok(file),
        }
    }

    /// The folder, which is made if it is not there.
    ///
    /// # Errors
    /// When it cannot be opened or made.
    pub fn folder(&mut self) -> Result<&Folder, FolderError> {
        match self.folder.take_if(|folder| !folder.is_removed()) {
            Some(folder) => Ok(self.folder.insert(folder)),
            None => Ok(self.folder.insert(Folder::open(&self.path, Links::Own, Missing::Last)?)),
        }
    }

    /// The folder, if it is open.
    pub fn open_folder(&self) -> Option<&Folder> {
        self.folder.as_ref()
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where the folder was moved to since it was opened, if it was.
    pub fn moved_to(&self) -> Option<PathBuf> {
        self.folder.as_ref()?.moved_to()
    }

    /// Writes the file and waits for the disk.
    ///
    /// # Errors
    /// When the disk does not accept it.
    pub fn save(&mut self, file: &SessionFile) -> Result<(), JournalError> {
        let place = self.path.join(&self.name);
        self.folder().map_err(|error| JournalError::Io { path: place, source: error.into() })?;
        self.become_current()?;
        if !self.is_ours() {
            // Another run writes it too: both sessions are kept.
            let stem = format!("session-{}-{}", compact(&file.begun), std::process::id());
            let is_free = |name: &String| self.folder.as_ref().is_some_and(|folder| !folder.has(name));
            let taken =
                || JournalError::Io { path: self.path.join(&self.name), source: io::ErrorKind::AlreadyExists.into() };
            self.name = names(&stem).find(is_free).ok_or_else(taken)?;
        }
        let path = self.path.join(&self.name);
        let io = |source| JournalError::Io { path: path.clone(), source };
        let text = toml::to_string(file).map_err(|error| io(io::Error::other(error)))?;
        let folder = self.folder.as_ref().ok_or_else(|| io(io::ErrorKind::NotFound.into()))?;
        let written = folder.replace_locked(&self.name, format!("{HEAD}{text}").as_bytes(), Sync::Wait).map_err(io)?;
        // A file system without this keeps the name at its own pace.
        let _ = folder.sync();
        self.held = Some(written);
        Ok(())
    }

    /// Before the first time that it is written: the session of another task gives way, and one that had given way is
    /// current again.
    fn become_current(&mut self) -> Result<(), JournalError> {
        if let Some(begun) = self.superseded.take()
            && self.hold(CURRENT).is_ok()
        {
            self.rename(CURRENT, &format!("session-{}", compact(&begun)))
                .inspect_err(|_| self.superseded = Some(begun))?;
        }
        if self.name != CURRENT
            && let Some(folder) = &self.folder
        {
            // It keeps its name while another run's file has that one.
            match folder.rename_new(self.name.as_ref(), CURRENT.as_ref()) {
                Ok(()) => CURRENT.clone_into(&mut self.name),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(source) => return Err(JournalError::Io { path: self.path.join(&self.name), source }),
            }
        }
        Ok(())
    }

    /// Whether the file of this name is what was read or written last, or there is none.
    fn is_ours(&self) -> bool {
        let Some(folder) = &self.folder else { return true };
        let named = statat(folder.descriptor(), &self.name, AtFlags::SYMLINK_NOFOLLOW).ok();
        let held = self.held.as_ref().and_then(|file| fstat(file).ok());
        named.is_none_or(|named| held.is_some_and(|held| (named.st_dev, named.st_ino) == (held.st_dev, held.st_ino)))
    }

    /// Writes the summary of the session beside its file, as Markdown.
    ///
    /// # Errors
    /// When the disk does not accept it.
    pub fn summarise(&mut self, file: &SessionFile) -> Result<(), JournalError> {
        let mut file = file.clone();
        let name = format!("session-{}.md", compact(&file.begun));
        let path = self.path.join(&name);
        let io = |source| JournalError::Io { path, source };
        let folder = match self.folder() {
            Ok(folder) => folder,
            Err(error) => return Err(io(error.into())),
        };
        file.take_notes(folder);
        folder.replace_by_umask(&name, super::markdown(&file).as_bytes(), Sync::Wait).map_err(io)
    }

    /// Gives the file, which is saved, its final contents and name, and writes the summary.
    ///
    /// # Errors
    /// When the disk does not accept it; the session is then not closed, and its file is as before.
    pub fn close(&mut self, file: &SessionFile) -> Result<(), JournalError> {
        self.summarise(file)?;
        let before = self.name.clone();
        self.name = self.rename(&before, &format!("session-{}", compact(&file.begun)))?;
        if let Err(error) = self.write_final(file) {
            // With its final name it is a session in progress all the same, and is found again.
            let folder = self.folder.as_ref();
            if folder.is_some_and(|folder| folder.rename_new(self.name.as_ref(), before.as_ref()).is_ok()) {
                self.name = before;
            }
            return Err(error);
        }
        self.held = None;
        CURRENT.clone_into(&mut self.name);
        Ok(())
    }

    fn write_final(&self, file: &SessionFile) -> Result<(), JournalError> {
        let io = |source| JournalError::Io { path: self.path.join(&self.name), source };
        let folder = self.folder.as_ref().ok_or_else(|| io(io::ErrorKind::NotFound.into()))?;
        let mut file = file.clone();
        file.take_notes(folder);
        let text = toml::to_string(&file).map_err(|error| io(io::Error::other(error)))?;
        folder.replace_by_umask(&self.name, format!("{HEAD}{text}").as_bytes(), Sync::Wait).map_err(io)?;
        let _ = folder.sync();
        Ok(())
    }

    /// Gives the file the name of a session that has ended.
    ///
    /// # Errors
    /// When it cannot be renamed; then it keeps its name.
    pub fn archive(&mut self, begun: &str) -> Result<PathBuf, JournalError> {
        let name = self.name.clone();
        let to = self.rename(&name, &format!("session-{}", compact(begun)))?;
        self.held = None;
        CURRENT.clone_into(&mut self.name);
        Ok(self.path.join(to))
    }

    /// Renames a file to the first free name `STEM.toml`, `STEM-2.toml`, …; returns it.
    fn rename(&self, from: &str, stem: &str) -> Result<String, JournalError> {
        let io = |source| JournalError::Io { path: self.path.join(from), source };
        let folder = self.folder.as_ref().ok_or_else(|| io(io::ErrorKind::NotFound.into()))?;
        for name in names(stem) {
            match folder.rename_new(from.as_ref(), name.as_ref()) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                renamed => return renamed.map(|()| name).map_err(io),
            }
        }
        Err(io(io::ErrorKind::AlreadyExists.into()))
    }
}

/// Why a file is not locked.
enum Lock {
    /// Another run has the session.
    Taken,
    /// There is no such file, or it cannot be read.
    None,
}

/// Names for a session's file, the best first.
fn names(stem: &str) -> impl Iterator<Item = String> {
    std::iter::once(format!("{stem}.toml")).chain((2..100).map(move |n| format!("{stem}-{n}.toml")))
}

/// `2026-11-24T14:03:00.000Z` without what a file's name should not contain.
fn compact(time: &str) -> String {
    time.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').collect()
}

/// Removes what a process that was killed had not finished to write: `.session.toml.PROCESS.tmp`.
fn remove_leftovers(folder: &Path) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name();
        let process = name.to_str().and_then(|name| name.strip_prefix(".session.toml.")?.strip_suffix(".tmp"));
        let is_left = |process: &str| process.parse::<u32>().is_ok() && !Path::new("/proc").join(process).exists();
        if process.is_some_and(is_left) {
            // What cannot be removed disturbs nothing.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// A time as people write it: `30s`.
mod span {
    use std::time::Duration;

    use rapid_registry::units::{parse_duration, show_duration};
    use serde::{Deserialize, Deserializer, Serializer, de};

    #[expect(clippy::ref_option, reason = "serde gives it so")]
    pub(super) fn serialize<S: Serializer>(span: &Option<Duration>, serializer: S) -> Result<S::Ok, S::Error> {
        match span {
            Some(span) => serializer.serialize_str(&show_duration(*span)),
            None => serializer.serialize_none(),
        }
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Duration>, D::Error> {
        let text = Option::<String>::deserialize(deserializer)?;
        let read = |text: String| {
            let wrong =
                || de::Error::custom(format!("{text:?} is not a duration: write a number and a unit, such as 30s"));
            parse_duration(&text).ok_or_else(wrong)
        };
        text.map(read).transpose()
    }
}

#[cfg(test)]
mod tests {
    use rapid_status::session::{Label, Mark};
    use rapid_status::{Grade, Sensors};

    use super::*;

    fn entry(file: &str) -> EpisodeEntry {
        EpisodeEntry {
            file: file.to_owned(),
            begun: "2026-11-24T14:03:00.000Z".to_owned(),
            seconds: Some(29.8),
            verdict: Some(Grade::Suspect),
            reasons: vec!["tof: 3 of 213 samples lost".to_owned()],
            label: Some(Label::Failure),
            label_reason: "it \"slipped\"\n".to_owned(),
            note: "# not a comment = 1".to_owned(),
            discarded: false,
            marks: vec![Mark { at: 12.5, text: String::new() }, Mark { at: 13.0, text: "grasp".to_owned() }],
            task: "place block".to_owned(),
            sensors: Some(Sensors { registered: 3, recorded: 2, without: vec!["tof".to_owned()], away: Vec::new() }),
            replay_of: vec!["before.mcap".to_owned()],
        }
    }

    fn session(episodes: Vec<EpisodeEntry>) -> SessionFile {
        let plan = Plan {
            task: "place block".to_owned(),
            goal: Some(50),
            episode_time: Some(Duration::from_secs(30)),
            reset_time: None,
            countdown: Some(Duration::from_millis(2500)),
            tags: [("finger".to_owned(), "soft".to_owned())].into(),
        };
        SessionFile { begun: "2026-11-24T14:02:00.000Z".to_owned(), plan, episodes, ..SessionFile::default() }
    }

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn what_was_discarded_stays_so_unless_it_was_moved_back() {
        let name = "20261124_place-block_001.mcap";
        for (noted, is_here, is_in_trash, expected) in [
            (false, true, false, false),
            (true, false, true, true),
            // Killed between a move and the note of it.
            (false, false, true, true),
            (true, true, false, false),
            // Its file was deleted from the trash: it is not kept for that.
            (true, false, false, true),
            // Being recorded when the run was killed.
            (false, false, false, false),
            // Another file has the name.
            (true, true, true, true),
            (false, true, true, false),
        ] {
            let folder = tempfile::tempdir().unwrap();
            let noted_entry = EpisodeEntry { discarded: noted, ..entry(name) };
            Journal::open(folder.path(), "place block").0.save(&session(vec![noted_entry])).unwrap();
            let trash = folder.path().join(rapid_episode::partial::TRASH);
            std::fs::create_dir(&trash).unwrap();
            let places = [(is_here, folder.path().join(name)), (is_in_trash, trash.join(name))];
            for (_, place) in places.into_iter().filter(|(is_there, _)| *is_there) {
                std::fs::write(place, "an episode").unwrap();
            }
            let (_, opened, error) = Journal::open(folder.path(), "place block");
            assert!(error.is_none(), "{error:?}");
            let found = opened.unwrap().episodes[0].discarded;
            assert_eq!(found, expected, "noted {noted}, here {is_here}, in the trash {is_in_trash}");
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        let folder = tempfile::tempdir().unwrap();
        let (mut journal, none, error) = Journal::open(folder.path(), "place block");
        assert!(none.is_none() && error.is_none());
        let bare = EpisodeEntry {
            seconds: None,
            verdict: None,
            reasons: Vec::new(),
            label: None,
            label_reason: String::new(),
            note: String::new(),
            marks: Vec::new(),
            sensors: None,
            replay_of: Vec::new(),
            ..entry("20261124_place-block_002.mcap")
        };
        let file = session(vec![entry("20261124_place-block_001.mcap"), bare]);
        journal.save(&file).unwrap();
        journal.save(&file).unwrap();
        assert_eq!(names(folder.path()), ["session.toml"]);
        // While a run has it, no other continues it.
        assert_eq!(Journal::open(folder.path(), "place block").1, None);
        drop(journal);
        let (_, read, error) = Journal::open(folder.path(), "place block");
        assert!(error.is_none(), "{error:?}");
        assert_eq!(read.unwrap(), file);
        insta::assert_snapshot!(std::fs::read_to_string(folder.path().join("session.toml")).unwrap());
    }

    #[test]
    fn no_length_of_a_session_is_impossible_and_no_file_endless() {
        let folder = tempfile::tempdir().unwrap();
        let (mut journal, ..) = Journal::open(folder.path(), "place block");
        journal.save(&session(vec![entry("20261124_place-block_001.mcap")])).unwrap();
        let path = folder.path().join("session.toml");
        let written = std::fs::read_to_string(&path).unwrap();
        for (was, key) in [("seconds = 29.8", "seconds"), ("at = 12.5", "at"), ("at = 13.0", "at")] {
            assert!(written.contains(was), "{written}");
            for number in ["inf", "-inf", "nan", "1e300", "-1.0", "1e18"] {
                let text = written.replace(was, &format!("{key} = {number}"));
                std::fs::write(&path, text).unwrap();
                let (read, errors) = sessions(folder.path());
                // What is shown of each.
                for file in &read {
                    crate::session::markdown(file);
                }
                let error = errors.first().map(ToString::to_string).unwrap_or_default();
                assert!(error.contains(": line ") && error.contains("no time in seconds"), "{number}: {error}");
            }
        }
        for inside in ["[".repeat(500_000), "{a=".repeat(300_000), format!("1\n{}=1", "a.".repeat(400_000))] {
            std::fs::write(&path, format!("begun = {inside}")).unwrap();
            assert_eq!(sessions(folder.path()).1.len(), 1);
        }
        std::fs::write(&path, written).unwrap();
        std::fs::File::options().write(true).open(&path).unwrap().set_len(1 << 40).unwrap();
        let error = sessions(folder.path()).1.remove(0).to_string();
        assert!(error.contains("larger than 67.1 MB"), "{error}");
    }

    #[test]
    fn an_ended_session_gets_its_own_name_and_all_are_listed() {
        let folder = tempfile::tempdir().unwrap();
        let (mut journal, ..) = Journal::open(folder.path(), "place block");
        for _ in 0..3 {
            let mut file = session(vec![entry("a.mcap")]);
            file.ended = Some(file.begun.clone());
            journal.save(&file).unwrap();
            journal.archive(&file.begun).unwrap();
        }
        journal.save(&session(vec![entry("b.mcap")])).unwrap();
        let stem = "session-2026-11-24T140200000Z";
        let expected = [format!("{stem}-2.toml"), format!("{stem}-3.toml"), format!("{stem}.toml")];
        assert_eq!(names(folder.path()), [&expected[..], &["session.toml".to_owned()]].concat());
        let (all, errors) = sessions(folder.path());
        assert_eq!((all.len(), errors.len()), (4, 0));
    }

    #[test]
    fn a_file_that_is_no_session_is_moved_aside_and_reported() {
        for text in ["begun = 1", "\u{0}", "[[episode]]\nfile = \"../../etc/passwd\"", "begun=\"\"\nsurprise = 1"] {
            let folder = tempfile::tempdir().unwrap();
            std::fs::write(folder.path().join(CURRENT), text).unwrap();
            let (mut journal, none, error) = Journal::open(folder.path(), "place block");
            assert!(none.is_none());
            let Some(JournalError::Moved { error: why, moved }) = error else { panic!("{text:?}: {error:?}") };
            assert!(matches!(*why, JournalError::Invalid { .. }), "{text:?}: {why:?}");
            assert_eq!(std::fs::read_to_string(moved).unwrap(), text);
            journal.save(&session(Vec::new())).unwrap();
            let names = names(folder.path());
            assert_eq!(names.len(), 2, "{names:?}");
            assert!(names.iter().any(|name| name.starts_with("session-unreadable-")), "{names:?}");
        }
        let hostile = "begun = \"x\"\n[[episode]]\nfile = \"../x.mcap\"\nbegun = \"x\"\n";
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(CURRENT), hostile).unwrap();
        let error = Journal::open(folder.path(), "place block").2.unwrap().to_string();
        assert!(error.contains("\"../x.mcap\" is not the name of an episode's file"), "{error}");
    }

    #[test]
    fn what_a_killed_process_left_is_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let (dead, alive) = (".session.toml.4294967290.tmp", format!(".session.toml.{}.tmp", std::process::id()));
        for name in [dead, alive.as_str(), ".session.toml.x.tmp", ".other.4294967290.tmp"] {
            std::fs::write(folder.path().join(name), "x").unwrap();
        }
        let _ = Journal::open(folder.path(), "place block");
        assert!(!folder.path().join(dead).exists());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 3);
    }

    #[test]
    fn two_runs_in_one_folder_keep_a_file_each() {
        let folder = tempfile::tempdir().unwrap();
        let (mut first, ..) = Journal::open(folder.path(), "place block");
        let (mut second, ..) = Journal::open(folder.path(), "place block");
        first.save(&session(vec![entry("a.mcap")])).unwrap();
        second.save(&session(vec![entry("b.mcap")])).unwrap();
        first.save(&session(vec![entry("a.mcap"), entry("c.mcap")])).unwrap();
        second.save(&session(vec![entry("b.mcap"), entry("d.mcap")])).unwrap();
        let (all, errors) = sessions(folder.path());
        assert!(errors.is_empty());
        let mut files: Vec<_> = all.iter().flat_map(|session| session.episodes.iter().map(|e| &e.file)).collect();
        files.sort();
        assert_eq!(files, ["a.mcap", "b.mcap", "c.mcap", "d.mcap"]);
    }
}
