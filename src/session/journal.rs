//! The session's file: which episodes were recorded, and the labels, marks and notes that people gave them.
//!
//! `session.toml` in the folder of the episodes while the session lasts, `session-BEGUN.toml` afterwards. It is written
//! at each change, atomically, and waits for the disk: a crash or a power cut loses none of it.
//!
//! Invariant: a file that this session did not write is never replaced: it is moved aside, or this session takes another
//! name.

use std::collections::BTreeMap;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::time::{realtime_ns, rfc3339};
use rapid_status::session::EpisodeEntry;
use rapid_system::folder::{self, Folder, Links, Missing, Sync};
use serde::{Deserialize, Serialize};

use super::trash;

/// The name of the file of a session in progress.
const CURRENT: &str = "session.toml";
/// A file of a hundred thousand episodes is smaller; a larger one is not ours.
const LARGEST: u64 = 1 << 26;
/// No episode is longer, in seconds: a year.
const LONGEST: f64 = 366.0 * 86_400.0;
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
    let is_session = |name: &str| {
        name == CURRENT
            || (name.starts_with("session-") && Path::new(name).extension().is_some_and(|ending| ending == "toml"))
    };
    let (mut files, mut errors) = (Vec::new(), Vec::new());
    let entries = match std::fs::read_dir(episodes) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return (files, errors),
        Err(source) => return (files, vec![JournalError::Io { path: episodes.to_owned(), source }]),
    };
    for entry in entries.flatten() {
        if entry.file_name().to_str().is_some_and(is_session) {
            match read(&entry.path()) {
                Ok(file) => files.push(file),
                Err(error) => errors.push(error),
            }
        }
    }
    files.sort_by(|a, b| a.begun.cmp(&b.begun));
    (files, errors)
}

fn read(path: &Path) -> Result<SessionFile, JournalError> {
    let text = folder::read_text(path, LARGEST).map_err(|source| JournalError::Io { path: path.to_owned(), source })?;
    let invalid = |why: String| JournalError::Invalid { path: path.to_owned(), why };
    let file: SessionFile = toml::from_str(&text).map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        invalid(format!("line {}: {}", before.matches('\n').count() + 1, error.message()))
    })?;
    if let Some(episode) = file.episodes.iter().find(|episode| !trash::is_name(&episode.file)) {
        return Err(invalid(format!("{:?} is not the name of an episode's file", episode.file)));
    }
    // Also false of what is not a number.
    let is_length = |seconds: &f64| (0.0..=LONGEST).contains(seconds);
    for episode in &file.episodes {
        let mut lengths = episode.seconds.iter().chain(episode.marks.iter().map(|mark| &mark.at));
        if let Some(wrong) = lengths.find(|seconds| !is_length(seconds)) {
            return Err(invalid(format!("{}: {wrong} is not a length in seconds", episode.file)));
        }
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

/// The file of the session in progress.
#[derive(Debug)]
pub struct Journal {
    folder: PathBuf,
    name: String,
    /// Device and inode of the file as written last.
    written: Option<(u64, u64)>,
}

impl Journal {
    /// The session in progress in `folder`, if there is one, continued with what is found of its episodes; and what
    /// was wrong with its file, which is then moved aside.
    pub fn open(folder: &Path) -> (Self, Option<SessionFile>, Option<JournalError>) {
        let mut journal = Self { folder: folder.to_owned(), name: CURRENT.to_owned(), written: None };
        remove_leftovers(folder);
        let path = folder.join(CURRENT);
        if matches!(path.symlink_metadata(), Err(error) if error.kind() == io::ErrorKind::NotFound) {
            return (journal, None, None);
        }
        match read(&path) {
            Ok(mut file) if file.ended.is_none() => {
                journal.written = identity(&path);
                for episode in &mut file.episodes {
                    let is_here = folder.join(&episode.file).exists();
                    let is_in_trash = trash::holds(folder, &episode.file);
                    episode.discarded = was_discarded(episode.discarded, is_here, is_in_trash);
                }
                (journal, Some(file), None)
            }
            Ok(file) => {
                let moved = journal.archive(&file.begun);
                (journal, None, moved.err())
            }
            Err(error) => {
                let moved = journal.archive(&format!("unreadable-{}", rfc3339(realtime_ns())));
                let error = match moved {
                    Ok(moved) => JournalError::Moved { error: Box::new(error), moved },
                    Err(error) => error,
                };
                (journal, None, Some(error))
            }
        }
    }

    /// Writes the file and waits for the disk.
    ///
    /// # Errors
    /// When the disk does not accept it.
    pub fn save(&mut self, file: &SessionFile) -> Result<(), JournalError> {
        let path = self.folder.join(&self.name);
        if identity(&path) != self.written && path.exists() {
            // Another run writes it too: both sessions are kept.
            self.name = format!("session-{}-{}.toml", compact(&file.begun), std::process::id());
        }
        let path = self.folder.join(&self.name);
        let io = |source| JournalError::Io { path: path.clone(), source };
        let text = toml::to_string(file).map_err(|error| io(io::Error::other(error)))?;
        let folder = Folder::open(&self.folder, Links::Own, Missing::Last).map_err(|error| io(error.into()))?;
        folder.replace_by_umask(&self.name, format!("{HEAD}{text}").as_bytes(), Sync::Wait).map_err(io)?;
        // A file system without this keeps the name at its own pace.
        let _ = folder.sync();
        self.written = identity(&path);
        Ok(())
    }

    /// Writes the summary of the session beside its file, as Markdown.
    ///
    /// # Errors
    /// When the disk does not accept it.
    pub fn summarise(&self, file: &SessionFile) -> Result<(), JournalError> {
        let name = format!("session-{}.md", compact(&file.begun));
        let io = |source| JournalError::Io { path: self.folder.join(&name), source };
        let folder = Folder::open(&self.folder, Links::Own, Missing::Refused).map_err(|error| io(error.into()))?;
        folder.replace_by_umask(&name, super::markdown(file).as_bytes(), Sync::Wait).map_err(io)
    }

    /// Gives the file its final contents and name, and writes the summary.
    ///
    /// # Errors
    /// When the disk does not accept it; the session is then not closed, and is saved as before.
    pub fn close(&mut self, file: &SessionFile) -> Result<(), JournalError> {
        self.save(file)?;
        self.summarise(file)?;
        let written = self.written;
        self.archive(&file.begun).map(drop).inspect_err(|_| self.written = written)
    }

    /// Gives the file the name of a session that has ended.
    ///
    /// # Errors
    /// When it cannot be renamed; then it keeps its name.
    pub fn archive(&mut self, begun: &str) -> Result<PathBuf, JournalError> {
        let from = self.folder.join(&self.name);
        let io = |source| JournalError::Io { path: from.clone(), source };
        let folder = Folder::open(&self.folder, Links::Own, Missing::Refused).map_err(|error| io(error.into()))?;
        let stem = format!("session-{}", compact(begun));
        let names = std::iter::once(format!("{stem}.toml")).chain((2..100).map(|n| format!("{stem}-{n}.toml")));
        let mut outcome = Err(io::ErrorKind::AlreadyExists.into());
        for name in names {
            outcome = folder.rename_new(self.name.as_ref(), name.as_ref()).map(|()| self.folder.join(&name));
            if !matches!(&outcome, Err(error) if error.kind() == io::ErrorKind::AlreadyExists) {
                break;
            }
        }
        // If it keeps its name, the next session takes another.
        self.written = None;
        let path = outcome.map_err(io)?;
        CURRENT.clone_into(&mut self.name);
        Ok(path)
    }
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

fn identity(path: &Path) -> Option<(u64, u64)> {
    std::fs::symlink_metadata(path).ok().map(|file| (file.dev(), file.ino()))
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
            sensors: Some(Sensors { registered: 3, recorded: 2, without: vec!["tof".to_owned()] }),
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
            Journal::open(folder.path()).0.save(&session(vec![noted_entry])).unwrap();
            let trash = folder.path().join(rapid_episode::partial::TRASH);
            std::fs::create_dir(&trash).unwrap();
            let places = [(is_here, folder.path().join(name)), (is_in_trash, trash.join(name))];
            for (_, place) in places.into_iter().filter(|(is_there, _)| *is_there) {
                std::fs::write(place, "an episode").unwrap();
            }
            let (_, opened, error) = Journal::open(folder.path());
            assert!(error.is_none(), "{error:?}");
            let found = opened.unwrap().episodes[0].discarded;
            assert_eq!(found, expected, "noted {noted}, here {is_here}, in the trash {is_in_trash}");
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        let folder = tempfile::tempdir().unwrap();
        let (mut journal, none, error) = Journal::open(folder.path());
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
            ..entry("20261124_place-block_002.mcap")
        };
        let file = session(vec![entry("20261124_place-block_001.mcap"), bare]);
        journal.save(&file).unwrap();
        journal.save(&file).unwrap();
        assert_eq!(names(folder.path()), ["session.toml"]);
        let (_, read, error) = Journal::open(folder.path());
        assert!(error.is_none(), "{error:?}");
        assert_eq!(read.unwrap(), file);
        insta::assert_snapshot!(std::fs::read_to_string(folder.path().join("session.toml")).unwrap());
    }

    #[test]
    fn no_length_of_a_session_is_impossible_and_no_file_endless() {
        let folder = tempfile::tempdir().unwrap();
        let (mut journal, ..) = Journal::open(folder.path());
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
                assert!(error.contains("001.mcap: ") && error.contains("not a length in seconds"), "{number}: {error}");
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
        let (mut journal, ..) = Journal::open(folder.path());
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
            let (mut journal, none, error) = Journal::open(folder.path());
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
        let error = Journal::open(folder.path()).2.unwrap().to_string();
        assert!(error.contains("\"../x.mcap\" is not the name of an episode's file"), "{error}");
    }

    #[test]
    fn what_a_killed_process_left_is_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let (dead, alive) = (".session.toml.4294967290.tmp", format!(".session.toml.{}.tmp", std::process::id()));
        for name in [dead, alive.as_str(), ".session.toml.x.tmp", ".other.4294967290.tmp"] {
            std::fs::write(folder.path().join(name), "x").unwrap();
        }
        let _ = Journal::open(folder.path());
        assert!(!folder.path().join(dead).exists());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 3);
    }

    #[test]
    fn two_runs_in_one_folder_keep_a_file_each() {
        let folder = tempfile::tempdir().unwrap();
        let (mut first, ..) = Journal::open(folder.path());
        let (mut second, ..) = Journal::open(folder.path());
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
