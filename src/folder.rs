//! A folder held open: files in it are made, replaced and removed by name, wherever its path leads
//! meanwhile.
//!
//! For folders that others may write to as well (/dev/shm, /tmp, a shared disk): what somebody
//! planted there under a name we are about to use is never followed, opened or written to.
//!
//! Invariant: the last part of a name is never followed if it is a symbolic link; on the way to a
//! folder only links of root and of this user are, as root none if so asked.
//! Invariant: a file is written only if this call made it, and gets its name when it is whole.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::path::{Component, Path, PathBuf};

use rustix::fs::{AtFlags, FileType, Mode, OFlags, RenameFlags};
use rustix::io::Errno;

use crate::time::realtime_ns;

/// Links on one way before it is taken for a circle; as in Linux, see `path_resolution(7)`.
const MOST_LINKS: usize = 40;
/// Names tried for a temporary file, should somebody take them before us.
const TRIES: u32 = 8;

/// Which symbolic links on the way to a folder are followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Links {
    /// None.
    Refused,
    /// Those that root or this user made: another's may be planted, and led elsewhere at any time.
    Own,
}

/// Which folders are made when they are missing.
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
    #[error("{}: a symbolic link{}, which is not followed here; name the real folder", path.display(), of(*owner))]
    Link {
        /// The link.
        path: PathBuf,
        /// Its owner.
        owner: u32,
    },
    /// A part of the path is something else.
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
/// Specification 0.8. `None` where nothing says.
#[must_use]
pub fn state_directory() -> Option<PathBuf> {
    let absolute = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let systemd = std::env::var_os("STATE_DIRECTORY").and_then(|list| std::env::split_paths(&list).next());
    systemd.filter(|path| path.is_absolute()).or_else(|| {
        let state = absolute("XDG_STATE_HOME").or_else(|| Some(absolute("HOME")?.join(".local/state")));
        state.map(|state| state.join("rapid"))
    })
}

fn of(owner: u32) -> String {
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
    /// When it is not there and may not be made, or lies behind a link that is not followed.
    pub fn open(path: &Path, links: Links, missing: Missing) -> Result<Self, FolderError> {
        let mut walk = Walk { links, missing, shown: PathBuf::new(), followed: 0 };
        let open = walk.enter(path)?;
        Ok(Self { open, path: path.to_owned() })
    }

    /// Its path, as it was named.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its descriptor, to list it.
    #[must_use]
    pub fn descriptor(&self) -> &OwnedFd {
        &self.open
    }

    /// Makes a file that is not there yet, for writing; `mode` is subject to the umask.
    ///
    /// # Errors
    /// `AlreadyExists` when anything has that name, a link that leads nowhere included.
    pub fn create_new(&self, name: impl AsRef<OsStr>, mode: u32) -> io::Result<File> {
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let file = rustix::fs::openat(&self.open, name.as_ref(), flags, Mode::from_raw_mode(mode))?;
        Ok(File::from(file))
    }

    /// Opens an ordinary file for reading; does not wait for the other end of a pipe.
    ///
    /// # Errors
    /// When there is none, or something else has that name.
    pub fn open_file(&self, name: impl AsRef<OsStr>) -> io::Result<File> {
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
        let file = File::from(rustix::fs::openat(&self.open, name.as_ref(), flags, Mode::empty())?);
        if !file.metadata()?.is_file() {
            return Err(io::Error::other("not an ordinary file"));
        }
        Ok(file)
    }

    /// Gives `name` these contents and this mode, whole: a reader sees what was there before, or all of it.
    ///
    /// # Errors
    /// When the disk does not take it, or the name belongs to something that cannot be replaced.
    pub fn replace(&self, name: impl AsRef<OsStr>, contents: &[u8], mode: u32, sync: Sync) -> io::Result<()> {
        let name = name.as_ref();
        let (temporary, mut file) = self.temporary(name)?;
        let written = file
            .write_all(contents)
            // The umask may have taken bits away.
            .and_then(|()| Ok(rustix::fs::fchmod(&file, Mode::from_raw_mode(mode))?))
            .and_then(|()| if sync == Sync::Wait { file.sync_all() } else { Ok(()) })
            .and_then(|()| Ok(rustix::fs::renameat(&self.open, &temporary, &self.open, name)?));
        if written.is_err() {
            // What was begun is of no use to anyone; the first error is the one to tell.
            let _ = self.remove(&temporary);
        }
        written
    }

    fn temporary(&self, name: &OsStr) -> io::Result<(OsString, File)> {
        let mut begin = OsString::from(".");
        begin.push(name);
        begin.push(format!(".{}", std::process::id()));
        let mut temporary = begin.clone();
        temporary.push(".tmp");
        // What a process of this number left behind goes. What is another user's stays, and is avoided.
        let _ = self.remove(&temporary);
        for _ in 0..TRIES {
            match self.create_new(&temporary, 0o600) {
                Ok(file) => return Ok((temporary, file)),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
            temporary.clone_from(&begin);
            temporary.push(format!(".{}.tmp", realtime_ns()));
        }
        Err(io::ErrorKind::AlreadyExists.into())
    }

    /// Renames a file; one that has the new name already stays as it is.
    ///
    /// # Errors
    /// `AlreadyExists` when the new name is taken.
    pub fn rename_new(&self, from: &OsStr, to: &OsStr) -> io::Result<()> {
        match rustix::fs::renameat_with(&self.open, from, &self.open, to, RenameFlags::NOREPLACE) {
            Ok(()) => Ok(()),
            // A file system without the flag (NFS, some FUSE): looked at instead.
            Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) if !self.has(to) => {
                Ok(rustix::fs::renameat(&self.open, from, &self.open, to)?)
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Removes a file or a link.
    ///
    /// # Errors
    /// When there is none, or it may not be removed.
    pub fn remove(&self, name: impl AsRef<OsStr>) -> io::Result<()> {
        Ok(rustix::fs::unlinkat(&self.open, name.as_ref(), AtFlags::empty())?)
    }

    /// Has anything this name? A link that leads nowhere is something.
    #[must_use]
    pub fn has(&self, name: impl AsRef<OsStr>) -> bool {
        !matches!(rustix::fs::statat(&self.open, name.as_ref(), AtFlags::SYMLINK_NOFOLLOW), Err(Errno::NOENT))
    }

    /// Waits until names given in it are on the disk.
    ///
    /// # Errors
    /// When the file system cannot be asked for that.
    pub fn sync(&self) -> io::Result<()> {
        Ok(rustix::fs::fsync(&self.open)?)
    }
}

/// Does [`Folder::replace`] wait for the disk?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sync {
    /// Until the contents are on it.
    Wait,
    /// No: the file lives in memory, or is written again soon.
    Skip,
}

/// The text of an ordinary file at `path`, at most `limit` bytes of it: for files that others may
/// have planted.
///
/// # Errors
/// When there is none, something else lies there, or it is not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    let folder = path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    let folder = Folder::open(folder, Links::Own, Missing::Refused).map_err(io::Error::other)?;
    let mut text = String::new();
    folder.open_file(path.file_name().unwrap_or_default())?.take(limit).read_to_string(&mut text)?;
    Ok(text)
}

/// The way to a folder, one part at a time: each is opened in the one before, so that nothing on the
/// way can be exchanged between a look and a step.
struct Walk {
    links: Links,
    missing: Missing,
    /// As far as it has gone.
    shown: PathBuf,
    followed: usize,
}

impl Walk {
    fn enter(&mut self, path: &Path) -> Result<OwnedFd, FolderError> {
        let start = if path.is_absolute() { "/" } else { "." };
        let mut at = self.told(rustix::fs::open(start, FOLDER, Mode::empty()))?;
        // Still to go, the next part last.
        let mut rest = parts(path);
        self.shown = PathBuf::from(if path.is_absolute() { "/" } else { "" });
        while let Some(name) = rest.pop() {
            let before = self.shown.clone();
            self.shown.push(&name);
            at = match rustix::fs::openat(&at, &name, FOLDER | OFlags::NOFOLLOW, Mode::empty()) {
                Err(Errno::NOENT) if self.makes(rest.is_empty()) => self.make(&at, &name)?,
                // O_DIRECTORY with O_NOFOLLOW answers a link with either.
                Err(error @ (Errno::LOOP | Errno::NOTDIR)) => {
                    let Some(target) = self.target(&at, &name)? else { return Err(self.io(error)) };
                    rest.extend(parts(&target));
                    self.shown = before;
                    if !target.is_absolute() {
                        continue;
                    }
                    self.shown = PathBuf::from("/");
                    self.told(rustix::fs::open("/", FOLDER, Mode::empty()))?
                }
                opened => self.told(opened)?,
            };
        }
        // A folder on the way need not be readable, this one must be.
        self.told(rustix::fs::openat(&at, ".", FOLDER.difference(OFlags::PATH), Mode::empty()))
    }

    fn makes(&self, is_last: bool) -> bool {
        self.missing == Missing::All || (self.missing == Missing::Last && is_last)
    }

    fn make(&self, at: &OwnedFd, name: &OsStr) -> Result<OwnedFd, FolderError> {
        match rustix::fs::mkdirat(at, name, Mode::from_raw_mode(0o755)) {
            Ok(()) | Err(Errno::EXIST) => {}
            Err(error) => return Err(self.io(error)),
        }
        self.told(rustix::fs::openat(at, name, FOLDER | OFlags::NOFOLLOW, Mode::empty()))
    }

    /// Where the link `name` leads, if it is one and is followed.
    fn target(&mut self, at: &OwnedFd, name: &OsStr) -> Result<Option<PathBuf>, FolderError> {
        let link = rustix::fs::openat(at, name, OFlags::PATH | OFlags::NOFOLLOW | OFlags::CLOEXEC, Mode::empty());
        let link = self.told(link)?;
        let stat = self.told(rustix::fs::fstat(&link))?;
        if FileType::from_raw_mode(stat.st_mode) != FileType::Symlink {
            return Ok(None);
        }
        let trusted = stat.st_uid == 0 || stat.st_uid == rustix::process::geteuid().as_raw();
        if self.links == Links::Refused || !trusted {
            return Err(FolderError::Link { path: self.shown.clone(), owner: stat.st_uid });
        }
        self.followed += 1;
        if self.followed > MOST_LINKS {
            return Err(self.io(Errno::LOOP));
        }
        // An empty name: the link that was opened, not what has its name by now.
        let target = self.told(rustix::fs::readlinkat(&link, "", Vec::new()))?;
        Ok(Some(PathBuf::from(OsString::from_vec(target.into_bytes()))))
    }

    fn told<T>(&self, result: Result<T, Errno>) -> Result<T, FolderError> {
        result.map_err(|error| self.io(error))
    }

    fn io(&self, error: Errno) -> FolderError {
        match error {
            Errno::NOTDIR => FolderError::NoFolder(self.shown.clone()),
            error => FolderError::Io { path: self.shown.clone(), error: error.into() },
        }
    }
}

const FOLDER: OFlags = OFlags::PATH.union(OFlags::DIRECTORY).union(OFlags::CLOEXEC);

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
