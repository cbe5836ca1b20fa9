//! The mask's file: created without following links, locked, and written so that no reader sees half a record.

use std::fs::{File, Metadata};
use std::io::ErrorKind;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{Ordering, fence};
use std::time::Duration;

use rapid_core::mask::{MaskRecord, MaskRecordError, PhysicalMask, RECORD_LEN};
use rapid_core::time::{Stamp, realtime_ns};
use rapid_system::folder::FolderError;
use rustix::fs::{FlockOperation, Mode, OFlags};
use rustix::io::Errno;

use super::json::{self, json_path};

/// If a publisher dies between creating and locking a file, the next one tries again.
const TRIES: usize = 10;
/// A reader that meets a write in progress retries for this long: the writer may be waiting for a busy core.
const READ_PATIENCE: Duration = Duration::from_secs(1);
/// Immediate retries before a reader sleeps between them.
const QUICK_LOOKS: u32 = 50;
const PAUSE: Duration = Duration::from_micros(100);

/// Why the mask cannot be published or read.
#[derive(Debug, thiserror::Error)]
pub enum PresenceError {
    /// Another process publishes there.
    #[error(
        "{path}: another rapid{} publishes the physical mask of this rig; end it first, or give this one \
         another name with --instance", pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default()
    )]
    Taken {
        /// The file.
        path: PathBuf,
        /// Its process id, if it can be determined.
        pid: Option<u32>,
    },
    /// The path holds something other than our own file.
    #[error("{path}: {what}; remove it: rm -r {path}")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What it is.
        what: String,
    },
    /// The folder of the file cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The file cannot be made, written or read.
    #[error("{path}: {error}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        error: std::io::Error,
    },
    /// No process publishes there.
    #[error("{path}: there is no physical mask: no rapid of this name (--instance) runs on this machine")]
    NotPublished {
        /// The file.
        path: PathBuf,
    },
    /// The file was created, but its process has not published a mask yet.
    #[error("{path}: no mask yet: rapid is starting; try again")]
    Starting {
        /// The file.
        path: PathBuf,
    },
    /// The file does not hold a mask.
    #[error("{path}: {error}")]
    Record {
        /// The file.
        path: PathBuf,
        /// Why not.
        error: MaskRecordError,
    },
    /// It is shorter than a mask record.
    #[error(
        "{path}: only part of a mask is there: it was cut, or its disk was full; the next start of rapid writes it again"
    )]
    Cut {
        /// The file.
        path: PathBuf,
    },
    /// A write was in progress at every read: its writer died during it.
    #[error("{path}: the record is torn: its writer died while writing")]
    Torn {
        /// The file.
        path: PathBuf,
    },
}

/// The published file, held open and locked.
#[derive(Debug)]
pub(super) struct MaskFile {
    path: PathBuf,
    file: File,
    record: MaskRecord,
}

impl MaskFile {
    /// Creates the file, or takes over that of a dead process.
    pub(super) fn create(path: &Path, device_count: u8) -> Result<Self, PresenceError> {
        // First the file that shows whether another process owns the rig.
        let file = open_locked(path)?;
        json::claim(&json_path(path)).inspect_err(|_| {
            // We hold its lock, and it is empty or belongs to a dead process.
            let _ = std::fs::remove_file(path);
        })?;
        let record = MaskRecord { device_count, generation: 0, mask: PhysicalMask::EMPTY, realtime_ns: 0, sequence: 0 };
        let io = |error| PresenceError::Io { path: path.to_owned(), error };
        // A complete record of the dead process stays readable until it is overwritten.
        if file.metadata().map_err(io)?.len() != RECORD_LEN as u64 {
            file.set_len(0).map_err(io)?;
            file.write_all_at(&record.to_bytes(), 0).map_err(io)?;
        }
        Ok(Self { path: path.to_owned(), file, record })
    }

    /// Creates the file again if it was removed or replaced; returns whether it did. The next publication goes to the
    /// new file.
    pub(super) fn restore(&mut self) -> Result<bool, PresenceError> {
        if self.is_there() {
            return Ok(false);
        }
        self.file = open_locked(&self.path)?;
        Ok(true)
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) const fn device_count(&self) -> u8 {
        self.record.device_count
    }

    /// From the next publication on.
    pub(super) const fn set_device_count(&mut self, device_count: u8) {
        self.record.device_count = device_count;
    }

    /// Whether the path still leads to our file.
    fn is_there(&self) -> bool {
        let (Ok(ours), Ok(named)) = (self.file.metadata(), std::fs::symlink_metadata(&self.path)) else { return false };
        (ours.dev(), ours.ino()) == (named.dev(), named.ino())
    }

    /// Publishes `mask` and returns its sequence number.
    pub(super) fn publish(&mut self, mask: PhysicalMask, realtime_ns: u64) -> std::io::Result<u64> {
        self.record.generation = self.record.generation.wrapping_add(2);
        self.record.mask = mask;
        self.record.realtime_ns = realtime_ns;
        self.record.sequence += 1;
        let bytes = self.record.to_bytes();
        let odd = self.record.generation.wrapping_sub(1).to_le_bytes();
        // A reader maps the page or reads it on another core: the generation is meaningful only because of the order of
        // the three writes. The head, with the magic, goes with the first.
        let mut head = [0; 8];
        head.copy_from_slice(&bytes[..8]);
        head[6..8].copy_from_slice(&odd);
        self.file.write_all_at(&head, 0)?;
        fence(Ordering::SeqCst);
        self.file.write_all_at(&bytes[8..], 8)?;
        fence(Ordering::SeqCst);
        self.file.write_all_at(&bytes[6..8], 6)?;
        Ok(self.record.sequence)
    }
}

impl Drop for MaskFile {
    fn drop(&mut self) {
        // For readers that have it open.
        let _ = self.publish(PhysicalMask::EMPTY, realtime_ns());
        if !self.is_there() {
            return;
        }
        // Under the lock, so that no other process's files are removed. Another user's file stays: in a folder where
        // everybody may write, it cannot be removed.
        let _ = std::fs::remove_file(json_path(&self.path));
        let _ = std::fs::remove_file(&self.path);
    }
}

fn open_locked(path: &Path) -> Result<File, PresenceError> {
    let io = |error: Errno| PresenceError::Io { path: path.to_owned(), error: error.into() };
    let foreign = |what: &str| PresenceError::Foreign { path: path.to_owned(), what: what.to_owned() };
    for _ in 0..TRIES {
        let flags =
            OFlags::RDWR | OFlags::CREATE | OFlags::NOFOLLOW | OFlags::CLOEXEC | OFlags::NONBLOCK | OFlags::NOCTTY;
        let mode = Mode::RUSR | Mode::WUSR | Mode::RGRP | Mode::ROTH;
        let file = match rustix::fs::open(path, flags, mode) {
            Ok(descriptor) => File::from(descriptor),
            Err(Errno::LOOP) => return Err(foreign("it is a symbolic link, and rapid follows none there")),
            Err(Errno::ISDIR) => return Err(foreign("it is a folder")),
            Err(error @ (Errno::ACCESS | Errno::PERM)) => return Err(refused(path, error)),
            Err(error) => return Err(io(error)),
        };
        let opened = file.metadata().map_err(|error| PresenceError::Io { path: path.to_owned(), error })?;
        if !opened.is_file() || opened.nlink() > 1 {
            return Err(foreign("it is not an ordinary file of its own"));
        }
        // Its owner may write to it at any time, even if we may as well.
        if opened.uid() != rustix::process::geteuid().as_raw() {
            return Err(refused(path, Errno::ACCESS));
        }
        match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => {}
            Err(Errno::WOULDBLOCK) => {
                return Err(PresenceError::Taken { path: path.to_owned(), pid: holder(&opened) });
            }
            Err(error) => return Err(io(error)),
        }
        // A publisher that ended meanwhile has removed the name: the locked file is no longer at the path.
        if std::fs::symlink_metadata(path).is_ok_and(|named| named.ino() == opened.ino()) {
            // The mode given at creation is subject to the umask; readers need all of it.
            rustix::fs::fchmod(&file, mode).map_err(io)?;
            return Ok(file);
        }
    }
    Err(PresenceError::Taken { path: path.to_owned(), pid: None })
}

/// Why an existing file may not be opened: it belongs to another user. In a folder like /dev/shm not even root may open
/// it for writing (`fs.protected_regular`, see proc(5)).
pub(super) fn refused(path: &Path, error: Errno) -> PresenceError {
    match std::fs::symlink_metadata(path) {
        Ok(there) if holder(&there).is_some() => PresenceError::Taken { path: path.to_owned(), pid: holder(&there) },
        Ok(there) if there.uid() != rustix::process::geteuid().as_raw() => {
            let what = format!("it belongs to user {}: another user's rapid left it behind", there.uid());
            PresenceError::Foreign { path: path.to_owned(), what }
        }
        _ => PresenceError::Io { path: path.to_owned(), error: error.into() },
    }
}

/// The holder of a lock on this file, from /proc/locks (proc(5)): the fifth field is the pid, the sixth
/// `major:minor:inode`, the device in hexadecimal.
fn holder(file: &Metadata) -> Option<u32> {
    let (major, minor) = (rustix::fs::major(file.dev()), rustix::fs::minor(file.dev()));
    let wanted = format!("{major:02x}:{minor:02x}:{}", file.ino());
    let locks = std::fs::read_to_string("/proc/locks").ok()?;
    locks.lines().find_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [_, "FLOCK", _, "WRITE", pid, file, ..] = fields[..] else { return None };
        (file == wanted).then(|| pid.parse().ok())?
    })
}

/// The names (`--instance`) under which masks are published beside `path`, which is of the run without a name; that run
/// itself has the empty name.
pub fn instances(path: &Path) -> Vec<String> {
    let stem = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let entries = path.parent().and_then(|folder| std::fs::read_dir(folder).ok());
    let name = |entry: std::fs::DirEntry| {
        let file = entry.file_name().into_string().ok()?;
        let name = file.strip_prefix(&stem)?;
        let name = if name.is_empty() { name } else { name.strip_prefix('.')? };
        let is_mask = name != "json" && Path::new(name).extension().is_none_or(|extension| extension != "json");
        // A file that no process holds was left behind.
        (is_mask && holder(&entry.metadata().ok()?).is_some()).then(|| name.to_owned())
    };
    let mut names: Vec<_> = entries.into_iter().flatten().flatten().filter_map(name).collect();
    names.sort();
    names
}

/// Reads the complete published record.
///
/// # Errors
/// When no process publishes at `path`, or the file does not hold a mask.
pub fn read_mask(path: &Path) -> Result<MaskRecord, PresenceError> {
    let io = |error: std::io::Error| match error.kind() {
        ErrorKind::NotFound => PresenceError::NotPublished { path: path.to_owned() },
        _ => PresenceError::Io { path: path.to_owned(), error },
    };
    let cut = |error: std::io::Error| match error.kind() {
        ErrorKind::UnexpectedEof => PresenceError::Cut { path: path.to_owned() },
        _ => io(error),
    };
    let foreign = |what: &str| PresenceError::Foreign { path: path.to_owned(), what: what.to_owned() };
    // Never follows a planted link or waits for a planted pipe.
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
    let file = match rustix::fs::open(path, flags, Mode::empty()) {
        Ok(file) => File::from(file),
        Err(Errno::LOOP) => return Err(foreign("it is a symbolic link, and rapid follows none there")),
        Err(error) => return Err(io(error.into())),
    };
    if !file.metadata().map_err(io)?.is_file() {
        return Err(foreign("it is not an ordinary file"));
    }
    let begun = Stamp::now();
    for look in 0_u32.. {
        let mut bytes = [0; RECORD_LEN];
        file.read_exact_at(&mut bytes, 0).map_err(cut)?;
        fence(Ordering::SeqCst);
        let mut generation = [0; 2];
        file.read_exact_at(&mut generation, 6).map_err(cut)?;
        if bytes[6] % 2 == 0 && bytes[6..8] == generation {
            let record = MaskRecord::from_bytes(&bytes)
                .map_err(|error| PresenceError::Record { path: path.to_owned(), error })?;
            // The first publication has number 1.
            return if record.sequence > 0 {
                Ok(record)
            } else {
                Err(PresenceError::Starting { path: path.to_owned() })
            };
        }
        if Stamp::now().since(begun) > READ_PATIENCE {
            break;
        }
        if look < QUICK_LOOKS {
            std::thread::yield_now();
        } else {
            std::thread::sleep(PAUSE);
        }
    }
    Err(PresenceError::Torn { path: path.to_owned() })
}
