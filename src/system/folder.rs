//! A folder held open: files in it are created, replaced and removed by name, even if its path leads
//! elsewhere meanwhile.
//!
//! For folders that others may write to as well (/dev/shm, /tmp, a shared disk): a file or link
//! that another user planted under a name we are about to use is never followed, opened or written to.
//!
//! Invariant: the last part of a name is never followed if it is a symbolic link; on the way to a
//! folder only links of root and of this user are followed, and none at all with [`Links::Refused`].
//! Invariant: a file is written only if this call created it, and gets its name when it is complete.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::ffi::OsStringExt;
use std::path::{Component, Path, PathBuf};

use rapid_core::time::realtime_ns;
use rustix::fs::{AtFlags, CWD, FileType, Mode, OFlags, RenameFlags, Stat};
use rustix::io::Errno;

use super::limited;
use crate::fault;

/// Links on one path before it is taken for a loop; as in Linux, see `path_resolution(7)`.
const MOST_LINKS: usize = 40;
/// Names tried for a temporary file, in case another program takes them first.
const TRIES: u32 = 8;

/// Which symbolic links on the way to a folder are followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Links {
    /// None.
    Refused,
    /// Those that root or this user created: another user's may be planted, and redirected at any time.
    Own,
}

/// Which missing folders are created.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// None: it is an error.
    Refused,
    /// The last one.
    Last,
    /// All of them.
    All,
}

/// Why a folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// A part of the path is a symbolic link that is not followed.
    #[error("{}: a symbolic link{}, which is not followed here; name the real folder", path.display(), of_user(*owner))]
    Link {
        /// The link.
        path: PathBuf,
        /// Its owner.
        owner: u32,
    },
    /// A part of the path is not a folder.
    #[error("{}: not a folder", .0.display())]
    NoFolder(PathBuf),
    /// The system refuses.
    #[error("{}: {error}", path.display())]
    Io {
        /// The part of the path it is about.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

impl From<FolderError> for io::Error {
    fn from(error: FolderError) -> Self {
        match error {
            FolderError::Io { error, .. } => error,
            link @ FolderError::Link { .. } => Self::other(link),
            file @ FolderError::NoFolder(_) => Self::new(io::ErrorKind::NotADirectory, file),
        }
    }
}

/// Where this program keeps what should survive a restart: systemd.exec(5), XDG Base Directory
/// Specification 0.8. `None` without any of them.
pub fn state_directory() -> Option<PathBuf> {
    let absolute = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let systemd = std::env::var_os("STATE_DIRECTORY").and_then(|list| std::env::split_paths(&list).next());
    systemd.filter(|path| path.is_absolute()).or_else(|| {
        let state = absolute("XDG_STATE_HOME").or_else(|| Some(absolute("HOME")?.join(".local/state")));
        state.map(|state| state.join("rapid"))
    })
}

fn of_user(owner: u32) -> String {
    if owner == rustix::process::geteuid().as_raw() { String::new() } else { format!(" of user {owner}") }
}

/// See the module's comment.
#[derive(Debug)]
pub struct Folder {
    open: OwnedFd,
    path: PathBuf,
}

impl Folder {
    /// Opens the folder at `path`.
    ///
    /// # Errors
    /// When it does not exist and may not be created, or is behind a link that is not followed.
    pub fn open(path: &Path, links: Links, missing: Missing) -> Result<Self, FolderError> {
        let mut check = |link: &Path, stat: &Stat| {
            let is_link = FileType::from_raw_mode(stat.st_mode) == FileType::Symlink;
            if is_link && (links == Links::Refused || !is_trusted(stat.st_uid)) {
                return Err(FolderError::Link { path: link.to_owned(), owner: stat.st_uid });
            }
            Ok(())
        };
        let mut walk = PathWalk::new(missing, &mut check);
        let at = walk.to(path)?;
        // A folder on the way need not be readable, this one must be.
        let flags = OFlags::DIRECTORY | OFlags::CLOEXEC;
        let open = walk.shown_error(rustix::fs::openat(&at, ".", flags, Mode::empty()))?;
        Ok(Self { open, path: path.to_owned() })
    }

    /// Opens a folder in this one; a link is refused.
    ///
    /// # Errors
    /// When it does not exist and may not be created, or is not a folder.
    pub fn subfolder(&self, name: &str, missing: Missing) -> Result<Self, FolderError> {
        let path = self.path.join(name);
        let io = |error: io::Error| FolderError::Io { path: path.clone(), error };
        let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let open = || rustix::fs::openat(&self.open, name, flags, Mode::empty());
        let opened = match open() {
            Err(Errno::NOENT) if missing != Missing::Refused => {
                fault::change(&self.path).map_err(io)?;
                match rustix::fs::mkdirat(&self.open, name, Mode::from_raw_mode(0o755)) {
                    Ok(()) | Err(Errno::EXIST) => open(),
                    Err(error) => Err(error),
                }
            }
            opened => opened,
        };
        match opened {
            Ok(open) => Ok(Self { open, path }),
            Err(Errno::LOOP | Errno::NOTDIR) => {
                let stat = rustix::fs::statat(&self.open, name, AtFlags::SYMLINK_NOFOLLOW)
                    .map_err(|error| io(error.into()))?;
                let is_link = FileType::from_raw_mode(stat.st_mode) == FileType::Symlink;
                Err(if is_link { FolderError::Link { path, owner: stat.st_uid } } else { FolderError::NoFolder(path) })
            }
            Err(error) => Err(io(error.into())),
        }
    }

    /// Where it is now, if not at its path: it was moved while it was open. `None` also if it was removed.
    pub fn moved_to(&self) -> Option<PathBuf> {
        let own = rustix::fs::fstat(&self.open).ok()?;
        let is_it = |path: &Path| {
            rustix::fs::stat(path).is_ok_and(|named| (named.st_dev, named.st_ino) == (own.st_dev, own.st_ino))
        };
        if self.is_removed() || is_it(&self.path) {
            return None;
        }
        std::fs::read_link(format!("/proc/self/fd/{}", self.open.as_raw_fd())).ok().filter(|path| is_it(path))
    }

    /// Whether it was removed while it was open.
    pub fn is_removed(&self) -> bool {
        rustix::fs::fstat(&self.open).is_ok_and(|own| own.st_nlink == 0)
    }

    /// Its path, as it was named.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its descriptor, for listing it.
    pub fn descriptor(&self) -> &OwnedFd {
        &self.open
    }

    /// Creates a file that does not exist yet, for writing; `mode` is subject to the umask.
    ///
    /// # Errors
    /// `AlreadyExists` when anything has that name, including a dangling link.
    pub fn create_new(&self, name: impl AsRef<OsStr>, mode: u32) -> io::Result<File> {
        fault::change(&self.path)?;
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let file = rustix::fs::openat(&self.open, name.as_ref(), flags, Mode::from_raw_mode(mode))?;
        Ok(File::from(file))
    }

    /// Opens an ordinary file for reading; does not wait for the other end of a pipe.
    ///
    /// # Errors
    /// When it does not exist, or is not an ordinary file.
    pub fn open_file(&self, name: impl AsRef<OsStr>) -> io::Result<File> {
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
        let file = File::from(rustix::fs::openat(&self.open, name.as_ref(), flags, Mode::empty())?);
        if !file.metadata()?.is_file() {
            return Err(io::Error::other("not an ordinary file"));
        }
        Ok(file)
    }

    /// Gives `name` these contents and this mode, atomically: a reader sees the old contents or all of the new.
    ///
    /// # Errors
    /// When the disk does not accept it, or the name belongs to something that cannot be replaced.
    pub fn replace(&self, name: impl AsRef<OsStr>, contents: &[u8], mode: u32, sync: Sync) -> io::Result<()> {
        self.replace_with(name.as_ref(), contents, Some(mode), sync).map(drop)
    }

    /// The same, with the permissions that the umask leaves of 0666, as any new file has.
    ///
    /// # Errors
    /// As [`Self::replace`].
    pub fn replace_by_umask(&self, name: impl AsRef<OsStr>, contents: &[u8], sync: Sync) -> io::Result<()> {
        self.replace_with(name.as_ref(), contents, None, sync).map(drop)
    }

    /// The same; the file is returned, and is locked (flock) before it has its name, where the file system has locks.
    ///
    /// # Errors
    /// As [`Self::replace`].
    pub fn replace_locked(&self, name: impl AsRef<OsStr>, contents: &[u8], sync: Sync) -> io::Result<File> {
        self.replace_with(name.as_ref(), contents, None, sync)
    }

    fn replace_with(&self, name: &OsStr, contents: &[u8], mode: Option<u32>, sync: Sync) -> io::Result<File> {
        let (temporary, file) = self.temporary(name, if mode.is_some() { 0o600 } else { 0o666 })?;
        // Nobody else knows it yet, and whoever does not keep it ends the lock.
        let _ = file.try_lock();
        let set_mode = |mode: u32| rustix::fs::fchmod(&file, Mode::from_raw_mode(mode));
        let written = fault::change(&self.path)
            .and_then(|()| (&file).write_all(contents))
            // The umask may have taken bits away.
            .and_then(|()| Ok(mode.map_or(Ok(()), set_mode)?))
            .and_then(|()| if sync == Sync::Wait { file.sync_all() } else { Ok(()) })
            .and_then(|()| fault::change(&self.path))
            .and_then(|()| Ok(rustix::fs::renameat(&self.open, &temporary, &self.open, name)?));
        if written.is_err() {
            // The unfinished file is of no use; the first error is the one to report.
            let _ = self.remove(&temporary);
        }
        written.map(|()| file)
    }

    fn temporary(&self, name: &OsStr, mode: u32) -> io::Result<(OsString, File)> {
        let mut begin = OsString::from(".");
        begin.push(name);
        begin.push(format!(".{}", std::process::id()));
        let mut temporary = begin.clone();
        temporary.push(".tmp");
        // Leftovers of a process with this number are removed. Another user's file stays, and is avoided.
        let _ = self.remove(&temporary);
        for _ in 0..TRIES {
            match self.create_new(&temporary, mode) {
                Ok(file) => return Ok((temporary, file)),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
            temporary.clone_from(&begin);
            temporary.push(format!(".{}.tmp", realtime_ns()));
        }
        Err(io::ErrorKind::AlreadyExists.into())
    }

    /// Renames a file; an existing file with the new name is not changed.
    ///
    /// # Errors
    /// `AlreadyExists` when the new name is taken.
    pub fn rename_new(&self, from: &OsStr, to: &OsStr) -> io::Result<()> {
        self.move_new(from, self, to)
    }

    /// Moves a file to another folder, under a new name; an existing file with that name is not changed.
    ///
    /// # Errors
    /// `AlreadyExists` when the new name is taken.
    pub fn move_new(&self, from: &OsStr, into: &Self, to: &OsStr) -> io::Result<()> {
        fault::change(&self.path)?;
        match rustix::fs::renameat_with(&self.open, from, &into.open, to, RenameFlags::NOREPLACE) {
            Ok(()) => Ok(()),
            // A file system without the flag (NFS, some FUSE): checked instead.
            Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) if !into.has(to) => {
                Ok(rustix::fs::renameat(&self.open, from, &into.open, to)?)
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Removes a file or a link.
    ///
    /// # Errors
    /// When it does not exist, or may not be removed.
    pub fn remove(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::unlinkat(&self.open, name.as_ref(), AtFlags::empty())?)
    }

    /// Whether anything has this name, including a dangling link.
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        !matches!(rustix::fs::statat(&self.open, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW), Err(Errno::NOENT))
    }

    /// Waits until changes of names in it are on the disk.
    ///
    /// # Errors
    /// When the file system does not support it.
    pub fn sync(&self) -> io::Result<()> {
        Ok(rustix::fs::fsync(&self.open)?)
    }
}

/// Whether [`Folder::replace`] waits for the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sync {
    /// It waits until the contents are on it.
    Wait,
    /// It does not: the file is in memory, or is written again soon.
    Skip,
}

/// The text of an ordinary file at `path`, of at most `limit` bytes: for files that other users may
/// have planted.
///
/// # Errors
/// When it does not exist, is not an ordinary file, is larger, or is not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    let folder = path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    let folder = Folder::open(folder, Links::Own, Missing::Refused).map_err(io::Error::other)?;
    limited::read_text(&folder.open_file(path.file_name().unwrap_or_default())?, limit)
}

/// A walk along a path, one part at a time: each is opened in the one before, so that nothing on the way can be
/// exchanged between a check and a step. Links are followed.
pub struct PathWalk<'a> {
    missing: Missing,
    /// Called for each folder, link and file on the way before it is entered or followed.
    check: &'a mut dyn FnMut(&Path, &Stat) -> Result<(), FolderError>,
    /// The path walked so far.
    shown: PathBuf,
    followed: usize,
}

impl<'a> PathWalk<'a> {
    /// Creates what is `missing`, and walks as far as `check` allows.
    pub fn new(missing: Missing, check: &'a mut dyn FnMut(&Path, &Stat) -> Result<(), FolderError>) -> Self {
        Self { missing, check, shown: PathBuf::new(), followed: 0 }
    }

    /// The target of `path`, opened only as a reference (`O_PATH`).
    ///
    /// # Errors
    /// When it does not exist, or is not allowed.
    pub fn to(&mut self, path: &Path) -> Result<OwnedFd, FolderError> {
        let start = Path::new(if path.is_absolute() { "/" } else { "." });
        let (mut at, _) = self.enter(CWD, start)?;
        // Remaining parts, the next part last.
        let mut rest = parts(path);
        self.shown = PathBuf::from(if path.is_absolute() { "/" } else { "" });
        while let Some(name) = rest.pop() {
            let before = self.shown.clone();
            if name == ".." && self.shown.file_name().is_some() {
                self.shown.pop();
            } else {
                self.shown.push(&name);
            }
            let (next, kind) = match self.enter(&at, Path::new(&name)) {
                Err(FolderError::Io { error, .. })
                    if error.kind() == io::ErrorKind::NotFound && self.makes(rest.is_empty()) =>
                {
                    self.make(&at, &name)?;
                    self.enter(&at, Path::new(&name))?
                }
                entered => entered?,
            };
            at = match kind {
                FileType::Symlink => {
                    // An empty name: the link that was opened, not what has its name now.
                    let target = self.shown_error(rustix::fs::readlinkat(&next, "", Vec::new()))?;
                    let target = PathBuf::from(OsString::from_vec(target.into_bytes()));
                    self.followed += 1;
                    if self.followed > MOST_LINKS {
                        return Err(self.io(Errno::LOOP));
                    }
                    rest.extend(parts(&target));
                    self.shown = before;
                    if target.is_absolute() {
                        self.shown = PathBuf::from("/");
                        self.enter(CWD, Path::new("/"))?.0
                    } else {
                        at
                    }
                }
                FileType::Directory => next,
                _ if rest.is_empty() => next,
                _ => return Err(FolderError::NoFolder(self.shown.clone())),
            };
        }
        Ok(at)
    }

    /// Opens `name`, a link itself and not its target, and checks it.
    fn enter(&mut self, at: impl AsFd, name: &Path) -> Result<(OwnedFd, FileType), FolderError> {
        let flags = OFlags::PATH | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let next = self.shown_error(rustix::fs::openat(at, name, flags, Mode::empty()))?;
        let stat = self.shown_error(rustix::fs::fstat(&next))?;
        let shown = if self.shown.as_os_str().is_empty() { name } else { &self.shown };
        (self.check)(shown, &stat)?;
        Ok((next, FileType::from_raw_mode(stat.st_mode)))
    }

    fn makes(&self, is_last: bool) -> bool {
        self.missing == Missing::All || (self.missing == Missing::Last && is_last)
    }

    fn make(&self, at: &OwnedFd, name: &OsStr) -> Result<(), FolderError> {
        match rustix::fs::mkdirat(at, name, Mode::from_raw_mode(0o755)) {
            Ok(()) | Err(Errno::EXIST) => Ok(()),
            Err(error) => Err(self.io(error)),
        }
    }

    fn shown_error<T>(&self, result: Result<T, Errno>) -> Result<T, FolderError> {
        result.map_err(|error| self.io(error))
    }

    fn io(&self, error: Errno) -> FolderError {
        match error {
            Errno::NOTDIR => FolderError::NoFolder(self.shown.clone()),
            error => FolderError::Io { path: self.shown.clone(), error: error.into() },
        }
    }
}

/// Whether files of this user may be changed by `owner`: root and this user may.
pub fn is_trusted(owner: u32) -> bool {
    owner == 0 || owner == rustix::process::geteuid().as_raw()
}

/// The names of a path, the last first.
fn parts(path: &Path) -> Vec<OsString> {
    let name = |component: Component<'_>| match component {
        Component::Normal(name) => Some(name.to_owned()),
        Component::ParentDir => Some(OsString::from("..")),
        Component::RootDir | Component::CurDir | Component::Prefix(_) => None,
    };
    path.components().rev().filter_map(name).collect()
}

#[cfg(test)]
mod tests;
