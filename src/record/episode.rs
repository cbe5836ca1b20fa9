//! An episode's name and place: `<out>/<date>_<task>_<nnn>.mcap`, `.partial` until it is finished.
//!
//! Invariant: no file that exists is ever opened for writing or replaced.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;
use serde::Serialize;

use super::RecordError;
use super::lock::{self, Lock};
use crate::time;

/// Longest slug of a task in bytes: with date, number and endings a name stays far below the 255
/// bytes a file name may have.
const SLUG_BYTES: usize = 64;
/// Numbers tried beyond the highest one seen, while other processes take them.
const ATTEMPTS: u32 = 100;

/// What to record.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct EpisodeRequest {
    /// The folder, made if the one above it exists.
    pub out: PathBuf,
    /// The task, in the user's words.
    pub task: String,
    /// `key=value` pairs of the user.
    pub tags: Vec<(String, String)>,
    /// The episode ends by itself after exactly this time of capture, if given.
    pub duration: Option<Duration>,
}

/// How an episode ended.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpisodeReport {
    /// The file; `.partial` remains at its end if it could not be finished.
    pub file: PathBuf,
    /// Length in seconds.
    pub seconds: f64,
    /// Messages handed to the file.
    pub messages: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Samples lost on the way to the file.
    pub dropped: u64,
    /// Why the file is not whole, if it is not.
    pub error: Option<String>,
}

/// The two names of an episode's file, which is locked until the second one is given.
#[derive(Debug)]
pub(super) struct EpisodePath {
    /// Once it is finished.
    pub(super) finished: PathBuf,
    /// While it is written.
    pub(super) partial: PathBuf,
    /// Holds the lock.
    _locked: File,
}

impl EpisodePath {
    /// Takes the next free number in `out` for `task` on the day of `wall_ns` (UTC) and creates the
    /// partial file.
    pub(super) fn create(out: &Path, task: &str, wall_ns: u64) -> Result<(Self, File), RecordError> {
        let at = |path: &Path| {
            let path = path.to_owned();
            move |source| RecordError::Io { path, source }
        };
        make_folder(out)?;
        let stem = format!("{}_{}_", date(wall_ns), slug(task));
        let first = next_number(out, &stem).map_err(at(out))?;
        for number in first..first.saturating_add(ATTEMPTS) {
            let finished = out.join(format!("{stem}{number:03}.mcap"));
            let partial = out.join(format!("{stem}{number:03}.mcap.partial"));
            if fs::symlink_metadata(&finished).is_ok() {
                continue;
            }
            match OpenOptions::new().write(true).create_new(true).open(&partial) {
                Ok(file) => match lock(&file, &partial) {
                    Ok(Some(locked)) => return Ok((Self { finished, partial, _locked: locked }, file)),
                    // Somebody took the empty file for one that was left behind.
                    Ok(None) => {}
                    Err(source) => return Err(RecordError::Io { path: partial, source }),
                },
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(source) => return Err(RecordError::Io { path: partial, source }),
            }
        }
        Err(at(out)(io::Error::new(io::ErrorKind::AlreadyExists, "no free number for this task")))
    }

    /// Gives the finished file its name.
    pub(super) fn publish(&self) -> io::Result<()> {
        publish(&self.partial, &self.finished)
    }
}

/// Gives a file its final name, which must be free, and waits for the name to be on the disk where
/// the file system can be asked for that.
pub(super) fn publish(file: &Path, name: &Path) -> io::Result<()> {
    match renameat_with(CWD, file, CWD, name, RenameFlags::NOREPLACE) {
        Ok(()) => {}
        // A file system without the flag (NFS, some FUSE): the name was free when it was chosen.
        Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) if fs::symlink_metadata(name).is_err() => {
            fs::rename(file, name)?;
        }
        Err(error) => return Err(error.into()),
    }
    let folder = name.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    // The file has its name: what remains is what a loss of power right now would do to it.
    if let Err(error) = File::open(folder).and_then(|folder| folder.sync_all()) {
        tracing::warn!(folder = %folder.display(), %error, "folder not synced");
    }
    Ok(())
}

/// Locks a partial file just made; a handle that holds the lock, `None` if somebody else has it.
fn lock(file: &File, partial: &Path) -> io::Result<Option<File>> {
    match lock::take(file, partial)? {
        Lock::Ours | Lock::Unknown => file.try_clone().map(Some),
        Lock::Others | Lock::Gone => Ok(None),
    }
}

fn make_folder(out: &Path) -> Result<(), RecordError> {
    match fs::create_dir(out) {
        Ok(()) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Err(RecordError::NoFolder(out.to_owned())),
        Err(source) => Err(RecordError::Io { path: out.to_owned(), source }),
    }
}

/// One more than the highest number of any file, finished, repaired or not, whose name begins with
/// `stem`.
fn next_number(out: &Path, stem: &str) -> io::Result<u32> {
    let mut highest = 0;
    for entry in fs::read_dir(out)? {
        let name = entry?.file_name();
        let number = name
            .to_str()
            .and_then(|name| name.strip_prefix(stem))
            .and_then(|rest| rest.split_once('.')?.0.parse::<u32>().ok());
        highest = highest.max(number.unwrap_or(0));
    }
    Ok(highest.saturating_add(1))
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
        let (first, _) = EpisodePath::create(&out, "t", WALL).unwrap();
        assert_eq!(first.finished.file_name().unwrap(), "20231114_t_001.mcap");
        let (second, _) = EpisodePath::create(&out, "t", WALL).unwrap();
        assert_eq!(second.partial.file_name().unwrap(), "20231114_t_002.mcap.partial");
        first.publish().unwrap();
        fs::write(out.join("20231114_t_041.mcap"), "kept").unwrap();
        fs::write(out.join("20231114_t_nonsense.mcap"), "kept").unwrap();
        let (third, _) = EpisodePath::create(&out, "t", WALL).unwrap();
        assert_eq!(third.finished.file_name().unwrap(), "20231114_t_042.mcap");
        for (number, ending) in [(50, "partial"), (60, "recovering"), (70, "damaged"), (80, "empty")] {
            fs::write(out.join(format!("20231114_t_0{number}.mcap.{ending}")), "kept").unwrap();
            let (next, _) = EpisodePath::create(&out, "t", WALL).unwrap();
            assert_eq!(next.finished.file_name().unwrap(), format!("20231114_t_0{}.mcap", number + 1).as_str());
        }
        let (other, _) = EpisodePath::create(&out, "other", WALL).unwrap();
        assert_eq!(other.finished.file_name().unwrap(), "20231114_other_001.mcap");
        // A file that took the name meanwhile stays as it is.
        fs::write(&third.finished, "kept").unwrap();
        assert_eq!(third.publish().unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read_to_string(&third.finished).unwrap(), "kept");
        assert!(third.partial.exists());
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
