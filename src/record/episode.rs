//! An episode's name and place: `<out>/<date>_<task>_<nnn>.mcap`, `.partial` until it is finished.
//!
//! Invariant: no file that exists is ever opened for writing or replaced.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;

use super::RecordError;
use super::lock::{self, Lock};
use super::publishers::Publisher;
use crate::folder::{Folder, FolderError, Links, Missing};
use crate::status::{Board, Level, Verdict, What};
use crate::{text, time};

/// Extension of a file that is not finished.
pub(super) const PARTIAL: &str = "partial";
/// Longest slug of a task in bytes: with date, number and endings a name stays far below the 255
/// bytes a file name may have.
const SLUG_BYTES: usize = 64;
/// Numbers tried beyond the highest one seen, while other processes take them.
const ATTEMPTS: u32 = 100;
/// Beyond every number of an episode.
const LARGEST: u32 = 1_000_000;

/// What to record.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct EpisodeRequest {
    /// The folder, made if the one above it exists.
    pub out: PathBuf,
    /// The task, in the user's words.
    pub task: String,
    /// `key=value` pairs of the user.
    pub tags: Vec<(String, String)>,
    /// Names of the modules that are mounted, as far as nothing tells of them but the user.
    pub modules: Vec<String>,
    /// The episode ends by itself after exactly this time of capture, if given.
    pub duration: Option<Duration>,
}

/// How an episode ended.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpisodeReport {
    /// The file; `.partial` remains at its end if it could not be finished.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// Length in seconds.
    pub seconds: f64,
    /// Messages handed to the file.
    pub messages: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Samples lost on the way to the file.
    pub dropped: u64,
    /// Why the file, or the episode in it, is not whole, if it is not.
    pub error: Option<String>,
    /// What it is worth.
    #[serde(flatten)]
    pub verdict: Verdict,
}

/// What the recorder knows of an episode, beside its samples, when its file is closed.
#[derive(Default)]
pub(super) struct Closing<'a> {
    /// Why the episode is not whole although its file may be.
    pub(super) reason: Option<String>,
    /// Other programs that published on topics of ours.
    pub(super) publishers: &'a [Publisher],
}

/// The folder of an episode's file, held open, and its two names in it; the file is locked until the
/// second one is given.
#[derive(Debug)]
pub(super) struct EpisodePath {
    pub(super) folder: Folder,
    /// Once it is finished.
    pub(super) finished: PathBuf,
    /// While it is written.
    pub(super) partial: PathBuf,
    /// The open file itself, whatever becomes of its names; it holds the lock.
    pub(super) file: Arc<File>,
    /// Names that other programs know as another episode's.
    pub(super) dropped: Vec<PathBuf>,
}

impl EpisodePath {
    /// Takes the next free number in `out` for `task` on the day of `wall_ns` (UTC) and creates the
    /// partial file.
    pub(super) fn create(out: &Path, task: &str, wall_ns: u64) -> Result<Self, RecordError> {
        Self::create_beside(out, task, wall_ns, &[])
    }

    /// The same, under none of the names `dropped`: other programs know these as another episode's.
    pub(super) fn create_beside(
        out: &Path,
        task: &str,
        wall_ns: u64,
        dropped: &[PathBuf],
    ) -> Result<Self, RecordError> {
        let refused = |source| RecordError::Io { path: out.to_owned(), source };
        let folder = open_folder(out)?;
        let stem = format!("{}_{}_", date(wall_ns), slug(task));
        let first = next_number(&folder, &stem).map_err(refused)?;
        for number in first..first.saturating_add(ATTEMPTS) {
            let name = format!("{stem}{number:03}.mcap");
            let partial = format!("{name}.{PARTIAL}");
            if folder.has(&name) || dropped.contains(&out.join(&name)) {
                continue;
            }
            match folder.create_new(&partial, 0o666) {
                Ok(file) => {
                    let (finished, partial) = (out.join(name), out.join(partial));
                    match lock(&file, &partial) {
                        Ok(true) => {
                            return Ok(Self {
                                folder,
                                finished,
                                partial,
                                file: Arc::new(file),
                                dropped: dropped.to_owned(),
                            });
                        }
                        // Somebody took the empty file for one that was left behind.
                        Ok(false) => {}
                        Err(source) => return Err(RecordError::Io { path: partial, source }),
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(source) => return Err(RecordError::Io { path: out.join(partial), source }),
            }
        }
        Err(refused(io::Error::new(io::ErrorKind::AlreadyExists, "no free number for this task")))
    }

    /// Gives the finished file its name, or the next free one where another file took that meanwhile; returns it.
    pub(super) fn publish(&self) -> io::Result<PathBuf> {
        match rename(&self.folder, &self.partial, &self.finished) {
            Ok(()) => Ok(self.finished.clone()),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => self.publish_as_next(),
            Err(error) => Err(error),
        }
    }

    /// Announces that the file is not `self.finished` but beside it, if so.
    pub(super) fn tell_name(&self, to: &Path, board: &Board) {
        if to != self.finished && to.parent() == self.finished.parent() {
            let (file, name) = (self.finished.display(), to.file_name().unwrap_or_default().to_string_lossy());
            let why = "another program took this name while the episode was recorded";
            board.announce(What::Log { level: Level::Warn, text: format!("{file}: {why}, which is {name} now") });
        }
    }

    fn publish_as_next(&self) -> io::Result<PathBuf> {
        let name = self.finished.file_stem().unwrap_or_default().to_string_lossy();
        let numbered = name.rsplit_once('_').filter(|(_, number)| number.parse::<u32>().is_ok());
        let stem = format!("{}_", numbered.map_or(&*name, |(stem, _)| stem));
        let first = next_number(&self.folder, &stem)?;
        for number in first..first.saturating_add(ATTEMPTS) {
            let name = format!("{stem}{number:03}.mcap");
            let to = self.finished.with_file_name(&name);
            // Another recorder may be writing the file that is to have this name.
            if self.dropped.contains(&to) || self.folder.has(format!("{name}.{PARTIAL}")) {
                continue;
            }
            match rename(&self.folder, &self.partial, &to) {
                Ok(()) => return Ok(to),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
        }
        Err(io::Error::new(io::ErrorKind::AlreadyExists, "its name is taken, and no other number is free"))
    }
}

/// Gives a file its final name, in the same folder, which must be free, and waits for the name to be
/// on the disk where the file system can be asked for that.
pub(super) fn publish(file: &Path, name: &Path) -> io::Result<()> {
    let folder = Folder::open(name.parent().unwrap_or(Path::new("")), Links::Own, Missing::Refused);
    rename(&folder.map_err(io::Error::from)?, file, name)
}

fn rename(folder: &Folder, file: &Path, name: &Path) -> io::Result<()> {
    let part = |path: &'_ Path| path.file_name().unwrap_or_default().to_owned();
    folder.rename_new(&part(file), &part(name))?;
    // The file has its name: what remains is what a loss of power right now would do to it.
    if let Err(error) = folder.sync() {
        tracing::warn!(folder = %folder.path().display(), %error, "folder not synced");
    }
    Ok(())
}

/// Locks a partial file just made; false if somebody else has it.
pub(super) fn lock(file: &File, partial: &Path) -> io::Result<bool> {
    Ok(matches!(lock::take(file, partial)?, Lock::Ours | Lock::Unknown))
}

/// Opens the folder for episodes; makes it if the one above it exists.
///
/// # Errors
/// When it cannot be made or entered, or lies behind another user's symbolic link.
pub fn open_folder(out: &Path) -> Result<Folder, RecordError> {
    Folder::open(out, Links::Own, Missing::Last).map_err(|error| match error {
        FolderError::Io { error, .. } if error.kind() == io::ErrorKind::NotFound => {
            RecordError::NoFolder(out.to_owned())
        }
        FolderError::NoFolder(path) => RecordError::NotAFolder(path),
        error => RecordError::Folder(error),
    })
}

/// One more than the highest number of any file, finished, repaired or not, whose name begins with
/// `stem`.
///
/// A number that no count of ours reaches does not count: somebody else made that name.
fn next_number(folder: &Folder, stem: &str) -> io::Result<u32> {
    let mut highest = 0;
    for entry in rustix::fs::Dir::read_from(folder.descriptor())? {
        let entry = entry?;
        let name = entry.file_name().to_str().ok().and_then(|name| name.strip_prefix(stem));
        let number = name.and_then(|rest| rest.split_once('.')?.0.parse::<u32>().ok());
        highest = highest.max(number.filter(|number| *number < LARGEST).unwrap_or(0));
    }
    Ok(highest + 1)
}

/// The task as part of a file name: letters and digits of any script in lower case, one hyphen for
/// everything between them; `episode` if nothing is left. Underscores stay free to part the fields.
pub(super) fn slug(task: &str) -> String {
    let mut slug = String::new();
    for c in task.chars().flat_map(char::to_lowercase) {
        if c.is_alphanumeric() {
            if slug.len() + c.len_utf8() > SLUG_BYTES {
                break;
            }
            slug.push(c);
        } else if !slug.is_empty() && !slug.ends_with('-') && slug.len() < SLUG_BYTES {
            slug.push('-');
        }
    }
    let slug = slug.trim_end_matches('-');
    if slug.is_empty() { "episode".to_owned() } else { slug.to_owned() }
}

/// The day in UTC, `20261121`, so that names sort by time and do not depend on the rig's time zone.
fn date(wall_ns: u64) -> String {
    let (year, month, day) = time::date(wall_ns);
    format!("{year:04}{month:02}{day:02}")
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::*;

    const WALL: u64 = 1_700_000_000_000_000_000;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (seconds, expected) in [
            (0, "19700101"),
            (951_782_399, "20000228"),
            (951_782_400, "20000229"),
            (951_868_800, "20000301"),
            (1_700_000_000, "20231114"),
            (1_735_689_599, "20241231"),
            (4_107_542_400, "21000301"),
        ] {
            assert_eq!(date(seconds * 1_000_000_000), expected);
        }
    }

    #[test]
    fn slugs_are_safe_whatever_the_task() {
        for (task, expected) in [
            ("place block", "place-block"),
            ("Place  Block!! #2", "place-block-2"),
            ("", "episode"),
            ("../../etc/passwd", "etc-passwd"),
            ("a/b\\c\0d\ne", "a-b-c-d-e"),
            ("-rf *", "rf"),
            ("under_score", "under-score"),
            ("放置积木", "放置积木"),
            ("🙂", "episode"),
        ] {
            assert_eq!(slug(task), expected, "{task:?}");
        }
        assert_eq!(slug(&"x".repeat(1000)).len(), 64);
        assert_eq!(slug(&"木".repeat(1000)).len(), 63);
    }

    #[test]
    fn numbers_go_up_and_no_file_is_touched() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("made");
        let first = EpisodePath::create(&out, "t", WALL).unwrap();
        assert_eq!(first.finished.file_name().unwrap(), "20231114_t_001.mcap");
        let second = EpisodePath::create(&out, "t", WALL).unwrap();
        assert_eq!(second.partial.file_name().unwrap(), "20231114_t_002.mcap.partial");
        first.publish().unwrap();
        fs::write(out.join("20231114_t_041.mcap"), "kept").unwrap();
        fs::write(out.join("20231114_t_nonsense.mcap"), "kept").unwrap();
        let third = EpisodePath::create(&out, "t", WALL).unwrap();
        assert_eq!(third.finished.file_name().unwrap(), "20231114_t_042.mcap");
        for (number, ending) in [(50, "partial"), (60, "recovering"), (70, "damaged"), (80, "empty")] {
            fs::write(out.join(format!("20231114_t_0{number}.mcap.{ending}")), "kept").unwrap();
            let next = EpisodePath::create(&out, "t", WALL).unwrap();
            assert_eq!(next.finished.file_name().unwrap(), format!("20231114_t_0{}.mcap", number + 1).as_str());
        }
        let other = EpisodePath::create(&out, "other", WALL).unwrap();
        assert_eq!(other.finished.file_name().unwrap(), "20231114_other_001.mcap");
        // A file that took the name meanwhile stays as it is; what another recorder writes and what was dropped keep
        // their names too.
        fs::write(&third.finished, "kept").unwrap();
        let mut third = third;
        third.dropped = vec![out.join("20231114_t_082.mcap")];
        let next = third.publish().unwrap();
        assert_eq!(next.file_name().unwrap(), "20231114_t_083.mcap");
        assert_eq!(fs::read_to_string(&third.finished).unwrap(), "kept");
        assert!(!third.partial.exists());
    }

    #[test]
    fn nothing_that_others_planted_is_written_to() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        fs::create_dir(&out).unwrap();
        let victim = folder.path().join("victim");
        fs::write(&victim, "precious").unwrap();
        for name in ["20231114_t_001.mcap.partial", "20231114_t_002.mcap"] {
            symlink(&victim, out.join(name)).unwrap();
        }
        let nowhere = folder.path().join("nowhere");
        symlink(&nowhere, out.join("20231114_t_003.mcap")).unwrap();
        let fifo = rustix::fs::FileType::Fifo;
        rustix::fs::mknodat(rustix::fs::CWD, out.join("20231114_t_004.mcap.partial"), fifo, 0o666.into(), 0).unwrap();
        fs::write(out.join("20231114_t_4294967295.mcap"), "").unwrap();
        let path = EpisodePath::create(&out, "t", WALL).unwrap();
        assert_eq!(path.finished.file_name().unwrap(), "20231114_t_005.mcap");
        // Planted in the middle of the episode, under the name it was to get.
        symlink(&nowhere, &path.finished).unwrap();
        let to = path.publish().unwrap();
        assert_eq!(to.file_name().unwrap(), "20231114_t_006.mcap");
        assert!(!nowhere.exists() && fs::symlink_metadata(&path.finished).unwrap().is_symlink());
        fs::rename(&to, &path.partial).unwrap();
        assert_eq!(fs::read_to_string(&victim).unwrap(), "precious");
        // The folder itself is exchanged: the episode stays where it began.
        fs::remove_file(&path.finished).unwrap();
        fs::rename(&out, folder.path().join("moved")).unwrap();
        let elsewhere = folder.path().join("elsewhere");
        fs::create_dir(&elsewhere).unwrap();
        symlink(&elsewhere, &out).unwrap();
        path.publish().unwrap();
        assert!(folder.path().join("moved/20231114_t_005.mcap").exists());
        assert_eq!(fs::read_dir(&elsewhere).unwrap().count(), 0);
        if std::os::unix::fs::lchown(&out, Some(12_345), None).is_err() {
            println!("NOT CHECKED: only root can give links away");
            return;
        }
        let error = EpisodePath::create(&out, "t", WALL).unwrap_err().to_string();
        assert!(error.contains("out: a symbolic link of user 12345, which is not followed here; name"), "{error}");
    }

    #[test]
    fn a_folder_that_cannot_be_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("a/b");
        let error = EpisodePath::create(&missing, "t", WALL).unwrap_err();
        assert!(matches!(error, RecordError::NoFolder(_)), "{error}");
        assert!(error.to_string().contains("--out") && error.to_string().contains("a/b"));
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        let error = EpisodePath::create(&file, "t", WALL).unwrap_err();
        assert!(error.to_string().contains("file: "), "{error}");
    }
}
