//! The free space on a disk, the reserve that is kept free, and how large a file may become.

use std::fmt;
use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;

use rapid_core::text;
use rustix::fs::{SeekFrom, fstatvfs, seek};
use rustix::process::{Resource, getrlimit};

/// The reserve unless the registry sets another: this, or [`SHARE`] of a smaller disk.
const RESERVE: u64 = 1 << 30;
/// Part of a disk, as its divisor.
const SHARE: u64 = 20;

/// A disk, in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Disk {
    /// Space available to an ordinary user.
    pub free: u64,
    /// Its size; 0 where the file system does not report it.
    pub size: u64,
}

impl Disk {
    /// The disk that holds `file`.
    ///
    /// # Errors
    /// When the file system does not answer.
    pub fn of_file(file: &File) -> io::Result<Self> {
        let stat = fstatvfs(file)?;
        Ok(Self {
            free: stat.f_bavail.saturating_mul(stat.f_frsize),
            size: stat.f_blocks.saturating_mul(stat.f_frsize),
        })
    }

    /// Whether `bytes` more would leave so little that an episode being recorded causes a warning, or is closed.
    /// `reserve` is the registry's `disk_reserve`.
    pub fn lacks_room_beside_an_episode(self, bytes: u64, reserve: Option<u64>) -> bool {
        self.free < self.reserve(reserve).saturating_mul(2).saturating_add(bytes)
    }

    /// Bytes that are kept free: the value of the registry (`wanted`), else 1 GiB, or a twentieth of a smaller disk.
    pub fn reserve(self, wanted: Option<u64>) -> u64 {
        wanted.unwrap_or_else(|| RESERVE.min(self.size / SHARE))
    }
}

/// Whether a write failed because there is no room for more: on the disk, for this user (a quota), or in this file.
pub fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge)
}

/// How large a file may become.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FileLimit {
    /// Its largest size in bytes; `u64::MAX` if nothing is known to limit it.
    pub bytes: u64,
    /// Who limits it.
    pub by: LimitedBy,
}

/// Who limits the size of files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitedBy {
    /// The file system: FAT32 has no files of 4 GiB.
    FileSystem,
    /// The limit of this process for files, see `setrlimit(2)`.
    Process,
}

impl FileLimit {
    /// Of a file that nothing is known to limit.
    pub const NONE: Self = Self { bytes: u64::MAX, by: LimitedBy::FileSystem };

    /// The limit of `file` at this moment.
    pub fn of(file: &File) -> Self {
        let system = Self { bytes: largest_offset(file).unwrap_or(u64::MAX), by: LimitedBy::FileSystem };
        match getrlimit(Resource::Fsize).current {
            Some(bytes) if bytes < system.bytes => Self { bytes, by: LimitedBy::Process },
            _ => system,
        }
    }
}

/// The limit, and how to have a higher one.
impl fmt::Display for FileLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = text::size(self.bytes);
        match self.by {
            LimitedBy::FileSystem => write!(
                f,
                "the file system has no files larger than {size}; use one that has, such as ext4 or exFAT, or record \
                 shorter episodes"
            ),
            LimitedBy::Process => write!(
                f,
                "files are limited to {size}; raise the limit (`ulimit -f unlimited`, or LimitFSIZE=infinity in the unit)"
            ),
        }
    }
}

/// The largest offset that the kernel accepts in `file`, which is where its file system has the end of the largest file.
fn largest_offset(file: &File) -> Option<u64> {
    // Opened again: its own position is not moved.
    let probe = File::open(format!("/proc/self/fd/{}", file.as_raw_fd())).ok()?;
    let accepts = |offset: u64| seek(&probe, SeekFrom::Start(offset)).is_ok();
    let (mut accepted, mut refused) = (0, u64::try_from(i64::MAX).ok()?);
    if accepts(refused) {
        return None;
    }
    while refused - accepted > 1 {
        let middle = accepted + (refused - accepted) / 2;
        if accepts(middle) {
            accepted = middle;
        } else {
            refused = middle;
        }
    }
    Some(accepted)
}

#[cfg(test)]
mod tests {
    use std::io::{Seek, Write};

    use super::*;

    #[test]
    fn the_limit_of_a_file_system_is_where_it_refuses_more() {
        let mut file = tempfile::tempfile_in(".").unwrap();
        file.write_all(b"before").unwrap();
        let limit = FileLimit::of(&file);
        assert_eq!(file.stream_position().unwrap(), 6);
        assert!(limit.bytes > 1 << 30, "{limit:?}");
        if limit.bytes < 1 << 62 {
            file.set_len(limit.bytes).unwrap();
            let refused = file.set_len(limit.bytes + 1).unwrap_err();
            assert!(is_full(&refused), "{refused}");
        }
    }

    #[test]
    fn no_room_is_told_from_other_errors() {
        for (error, expected) in [
            (libc::ENOSPC, true),
            (libc::EDQUOT, true),
            (libc::EFBIG, true),
            (libc::EIO, false),
            (libc::EROFS, false),
            (libc::EACCES, false),
        ] {
            assert_eq!(is_full(&io::Error::from_raw_os_error(error)), expected, "{error}");
        }
    }
}
