//! The free space on a disk, and the reserve that is kept free.

use std::fs::File;
use std::io;

use rustix::fs::fstatvfs;

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
