//! An episode's name and place: `<out>/<date>_<task>_<nnn>.mcap`, `.partial` until it is finished.
//!
//! Invariant: no file that exists is ever opened for writing or replaced.

use std::fs::{self, File};
use std::io::{self, Seek, SeekFrom, Write};
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rapid_core::time;
use rapid_status::{Board, EventKind, Level};
use rapid_system::folder::{Folder, FolderError, Links, Missing};
use rustix::fs::{Mode, OFlags};

use super::RecordError;
use crate::Failed;
use crate::partial::{self, Lock, PARTIAL, TRASH, rename};

/// Longest slug of a task in bytes: with date, number and endings a name stays far below the 255
/// bytes a file name may have.
const SLUG_BYTES: usize = 64;
/// Numbers, or names of a rewritten file, that are tried while other processes take them.
const ATTEMPTS: u32 = 100;
/// Above every number of an episode.
const LARGEST: u32 = 1_000_000;

/// What to record.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct EpisodeRequest {
    /// The folder, created if its parent exists.
    pub out: PathBuf,
    /// The task, in the user's words.
    pub task: String,
    /// `key=value` pairs of the user.
    pub tags: Vec<(String, String)>,
    /// Names of mounted modules that only the user knows.
    pub modules: Vec<String>,
    /// The episode ends by itself after exactly this time of capture, if given.
    pub duration: Option<Duration>,
    /// Names that the session gave before: none is given twice, also when its file was moved away meanwhile.
    pub taken: Vec<String>,
}

/// The folder of an episode's file, held open, and its two names in it; the file is locked until the
/// second one is given.
#[derive(Debug)]
pub(super) struct EpisodePath {
    pub(super) folder: Folder,
    pub(super) finished: PathBuf,
    pub(super) partial: PathBuf,
    /// The open file itself, independent of its names; it holds the lock.
    pub(super) file: Arc<File>,
}

impl EpisodePath {
    /// Takes the next free number in the folder for the task, on the day of `wall_ns` (UTC), and creates the partial file.
    pub(super) fn create(request: &EpisodeRequest, wall_ns: u64) -> Result<Self, RecordError> {
        let EpisodeRequest { out, task, taken, .. } = request;
        let refused = |source| RecordError::Io { path: out.clone(), source };
        let folder = open_folder(out)?;
        // The day in UTC: names sort by time and do not depend on the rig's time zone.
        let stem = format!("{}_{}_", time::compact_date(wall_ns), slug(task));
        let taken = taken.iter().filter_map(|name| number_of(name, &stem)).max().unwrap_or(0);
        let first = next_number(&folder, &stem).map_err(refused)?.max(taken + 1);
        for number in first..first.saturating_add(ATTEMPTS) {
            let name = format!("{stem}{number:03}.mcap");
            let failed = |source| RecordError::Io { path: out.join(format!("{name}.{PARTIAL}")), source };
            if let Some((file, finished, partial)) = claim(&folder, out, &name).map_err(failed)? {
                return Ok(Self { folder, finished, partial, file: Arc::new(file) });
            }
        }
        Err(refused(io::Error::new(io::ErrorKind::AlreadyExists, "no free number for this task")))
    }

    /// Gives the finished file its name, or the next free one if another file took it meanwhile; returns it.
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
            board.announce(EventKind::Log { level: Level::Warn, text: format!("{file}: {why}, which is {name} now") });
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
            if self.folder.has(format!("{name}.{PARTIAL}")) {
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

/// Creates the partial file of the episode `name` in `folder`, which is at `out`, and locks it before there is anything
/// in it that could be repaired: the file, its finished name and its partial one. `None`: a name is taken, or another
/// program took the empty file for one that was left behind.
fn claim(folder: &Folder, out: &Path, name: &str) -> io::Result<Option<(File, PathBuf, PathBuf)>> {
    if folder.has(name) {
        return Ok(None);
    }
    let partial = format!("{name}.{PARTIAL}");
    let file = match folder.create_new(&partial, 0o666) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return Ok(None),
        made => made?,
    };
    let (finished, partial) = (out.join(name), out.join(partial));
    let is_ours = matches!(partial::lock(&file, &partial)?, Lock::Ours | Lock::Unknown);
    Ok(is_ours.then_some((file, finished, partial)))
}

/// Opens the folder for episodes; creates it if its parent exists.
///
/// # Errors
/// When it cannot be created or entered, or lies behind another user's symbolic link.
pub fn open_folder(out: &Path) -> Result<Folder, RecordError> {
    Folder::open(out, Links::Own, Missing::Last).map_err(|error| match error {
        FolderError::Io { error, .. } if error.kind() == io::ErrorKind::NotFound => {
            RecordError::NoFolder(out.to_owned())
        }
        FolderError::NoFolder(path) => RecordError::NotAFolder(path),
        error => RecordError::Folder(error),
    })
}

/// One more than the highest number of any file, finished, repaired, discarded or not, whose name begins with
/// `stem`.
fn next_number(folder: &Folder, stem: &str) -> io::Result<u32> {
    let highest = highest_number(folder.descriptor(), stem)?;
    // Other programs know a discarded episode by its name. A trash that cannot be read has none.
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let trash = rustix::fs::openat(folder.descriptor(), TRASH, flags, Mode::empty()).ok();
    let discarded = trash.and_then(|trash| highest_number(&trash, stem).ok());
    Ok(highest.max(discarded.unwrap_or(0)) + 1)
}

fn highest_number(folder: impl AsFd, stem: &str) -> io::Result<u32> {
    let mut highest = 0;
    for entry in rustix::fs::Dir::read_from(folder)? {
        let entry = entry?;
        let number = entry.file_name().to_str().ok().and_then(|name| number_of(name, stem));
        highest = highest.max(number.unwrap_or(0));
    }
    Ok(highest)
}

/// The number in `name` after `stem`. One too high for our count is ignored: another program made that name.
fn number_of(name: &str, stem: &str) -> Option<u32> {
    let number = name.strip_prefix(stem)?.split_once('.')?.0.parse().ok()?;
    (number < LARGEST).then_some(number)
}

/// The task as part of a file name: letters and digits of any script in lower case, one hyphen for
/// everything between them; `episode` if nothing is left. Underscores separate only the fields.
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

/// Gives a finished file its name, whatever became of its folder while it was recorded; returns where it is. The file is
/// open all the time, so that what was written is there although its name is gone: a folder that was moved is followed,
/// and a file that was removed is written again. A name that means another file is left alone.
///
/// # Errors
/// When it keeps its partial name, or cannot be saved.
pub(super) fn keep(path: &EpisodePath) -> io::Result<PathBuf> {
    match whereabouts(path)? {
        Whereabouts::Here => path.publish(),
        Whereabouts::Moved(partial) => {
            let (from, to) = (path.finished.display(), partial.display());
            tracing::warn!(%from, %to, "the episode was moved while it was recorded");
            if partial.extension().is_none_or(|extension| extension != PARTIAL) {
                // The program that moved it gave it the name it is to have.
                return Ok(partial);
            }
            let folder = open(partial.parent().unwrap_or(Path::new("")), Missing::Refused)?;
            let (finished, file) = (partial.with_extension(""), Arc::clone(&path.file));
            EpisodePath { folder, finished, partial, file }.publish()
        }
        Whereabouts::Removed => {
            let file = write_again(path, Content::Whole)?;
            tracing::warn!(file = %file.display(), "the episode was removed while it was recorded, and is written again");
            Ok(file)
        }
    }
}

/// The place of a file that could not be finished; a removed one is written again. The reason `why` it is BAD is
/// appended for later readers: its summary may be GOOD by then.
pub(super) fn failed(path: &EpisodePath, why: &str) -> PathBuf {
    let mut file = &*path.file;
    let marked = file.seek(SeekFrom::End(0)).and_then(|_| file.write_all(&Failed::mark(why)));
    if let Err(error) = marked.and_then(|()| file.sync_data()) {
        let file = path.partial.display();
        tracing::error!(%file, %error, "BAD, and after a loss of power the file itself may not show it; remove it");
    }
    let found = whereabouts(path).and_then(|whereabouts| match whereabouts {
        Whereabouts::Here => Ok(path.partial.clone()),
        Whereabouts::Moved(partial) => Ok(partial),
        Whereabouts::Removed => write_again(path, Content::Partial),
    });
    found.unwrap_or_else(|error| {
        tracing::error!(file = %path.partial.display(), %error, "the episode is lost");
        path.partial.clone()
    })
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Content {
    Whole,
    Partial,
}

enum Whereabouts {
    Here,
    /// Its partial name, in another folder.
    Moved(PathBuf),
    Removed,
}

fn whereabouts(path: &EpisodePath) -> io::Result<Whereabouts> {
    let open = path.file.metadata()?;
    if open.nlink() == 0 {
        return Ok(Whereabouts::Removed);
    }
    let is_ours = |path: &Path| {
        fs::symlink_metadata(path).is_ok_and(|named| (named.dev(), named.ino()) == (open.dev(), open.ino()))
    };
    if is_ours(&path.partial) {
        return Ok(Whereabouts::Here);
    }
    // proc(5): the name the file has now.
    let there = fs::read_link(format!("/proc/self/fd/{}", path.file.as_raw_fd()))?;
    if is_ours(&there) {
        return Ok(if is_hidden(&there) { Whereabouts::Removed } else { Whereabouts::Moved(there) });
    }
    Err(io::Error::new(io::ErrorKind::NotFound, "the file is in none of the folders that can be seen"))
}

/// Is it the name a file system without open files that have none gives to one that was removed, until
/// it is closed (NFS, libfuse)?
fn is_hidden(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().as_encoded_bytes();
    [&b".nfs"[..], b".fuse_hidden"].iter().any(|hidden| name.starts_with(hidden))
}

/// Copies the open file to its folder, which is made again, or to that for temporary files.
fn write_again(path: &EpisodePath, content: Content) -> io::Result<PathBuf> {
    let name = path.finished.file_stem().unwrap_or_default();
    let mut first = None;
    let folder = path.finished.parent().map(Path::to_owned).unwrap_or_default();
    for folder in [folder, std::env::temp_dir()] {
        match write_into(&folder, &name.to_string_lossy(), content, path) {
            Ok(written) => return Ok(written),
            Err(error) => {
                tracing::error!(folder = %folder.display(), %error, "the episode cannot be written again here");
                first = first.or(Some(error));
            }
        }
    }
    Err(first.unwrap_or_else(|| io::ErrorKind::NotFound.into()))
}

fn write_into(out: &Path, stem: &str, content: Content, path: &EpisodePath) -> io::Result<PathBuf> {
    for attempt in 1..=ATTEMPTS {
        let folder = open(out, Missing::All)?;
        let stem = if attempt == 1 { stem.to_owned() } else { format!("{stem}-{attempt}") };
        let Some((mut copy, finished, partial)) = claim(&folder, out, &format!("{stem}.mcap"))? else { continue };
        let mut source = &*path.file;
        let copied = source.seek(SeekFrom::Start(0)).and_then(|_| io::copy(&mut source, &mut copy));
        if let Err(error) = copied.and_then(|_| copy.sync_all()) {
            // A partial copy is useless; the whole may fit elsewhere.
            let _ = fs::remove_file(&partial);
            return Err(error);
        }
        if content == Content::Partial {
            return Ok(partial);
        }
        return EpisodePath { folder, finished, partial, file: Arc::new(copy) }.publish();
    }
    Err(io::Error::new(io::ErrorKind::AlreadyExists, "no free name"))
}

fn open(folder: &Path, missing: Missing) -> io::Result<Folder> {
    Folder::open(folder, Links::Own, missing).map_err(io::Error::from)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    const WALL: u64 = 1_700_000_000_000_000_000;

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

    fn request(out: &Path, task: &str) -> EpisodeRequest {
        EpisodeRequest { out: out.to_owned(), task: task.to_owned(), ..EpisodeRequest::default() }
    }

    #[test]
    fn numbers_increase_and_no_existing_file_is_touched() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("made");
        let first = EpisodePath::create(&request(&out, "t"), WALL).unwrap();
        assert_eq!(first.finished.file_name().unwrap(), "20231114_t_001.mcap");
        let second = EpisodePath::create(&request(&out, "t"), WALL).unwrap();
        assert_eq!(second.partial.file_name().unwrap(), "20231114_t_002.mcap.partial");
        first.publish().unwrap();
        fs::write(out.join("20231114_t_041.mcap"), "kept").unwrap();
        fs::write(out.join("20231114_t_nonsense.mcap"), "kept").unwrap();
        let third = EpisodePath::create(&request(&out, "t"), WALL).unwrap();
        assert_eq!(third.finished.file_name().unwrap(), "20231114_t_042.mcap");
        for (number, ending) in [(50, "partial"), (60, "recovering"), (70, "damaged"), (80, "empty")] {
            fs::write(out.join(format!("20231114_t_0{number}.mcap.{ending}")), "kept").unwrap();
            let next = EpisodePath::create(&request(&out, "t"), WALL).unwrap();
            assert_eq!(next.finished.file_name().unwrap(), format!("20231114_t_0{}.mcap", number + 1).as_str());
        }
        let other = EpisodePath::create(&request(&out, "other"), WALL).unwrap();
        assert_eq!(other.finished.file_name().unwrap(), "20231114_other_001.mcap");
        // Another program may have moved an episode of this session elsewhere, where its name is taken.
        let taken = ["20231114_moved_007.mcap", "20231114_moved_99999999999.mcap", "20231113_moved_009.mcap"];
        let moved = EpisodeRequest { taken: taken.map(str::to_owned).to_vec(), ..request(&out, "moved") };
        let moved = EpisodePath::create(&moved, WALL).unwrap();
        assert_eq!(moved.finished.file_name().unwrap(), "20231114_moved_008.mcap");
        // A file that took the name meanwhile stays as it is; what another recorder writes and what is in the
        // trash keep their names too.
        fs::write(&third.finished, "kept").unwrap();
        fs::create_dir(out.join(TRASH)).unwrap();
        fs::write(out.join(TRASH).join("20231114_t_082.mcap"), "discarded").unwrap();
        let next = third.publish().unwrap();
        assert_eq!(next.file_name().unwrap(), "20231114_t_083.mcap");
        assert_eq!(fs::read_to_string(&third.finished).unwrap(), "kept");
        assert!(!third.partial.exists());
    }

    #[test]
    fn files_planted_by_others_are_not_written_to() {
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
        let path = EpisodePath::create(&request(&out, "t"), WALL).unwrap();
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
            crate::skip::skipped("only root can give links away");
            return;
        }
        let error = EpisodePath::create(&request(&out, "t"), WALL).unwrap_err().to_string();
        assert!(error.contains("out: a symbolic link of user 12345, which is not followed here; name"), "{error}");
    }

    #[test]
    fn an_impossible_folder_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("a/b");
        let error = EpisodePath::create(&request(&missing, "t"), WALL).unwrap_err();
        assert!(matches!(error, RecordError::NoFolder(_)), "{error}");
        assert!(error.to_string().contains("--out") && error.to_string().contains("a/b"));
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        let error = EpisodePath::create(&request(&file, "t"), WALL).unwrap_err();
        assert!(error.to_string().contains("file: "), "{error}");
    }
}
