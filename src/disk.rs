//! The room on a disk, and what of it is kept free.

use std::fs::File;
use std::io;

use rustix::fs::fstatvfs;

/// The reserve unless the registry says another: this, or [`SHARE`] of a smaller disk.
const RESERVE: u64 = 1 << 30;
/// Part of a disk, as its divisor.
const SHARE: u64 = 20;

/// A disk, in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Disk {
    /// What an ordinary user may still write.
    pub free: u64,
    /// Its size; 0 where the file system does not say.
    pub size: u64,
}

impl Disk {
    /// The disk that holds `file`.
    ///
    /// # Errors
    /// When the file system does not answer.
    pub fn of(file: &File) -> io::Result<Self> {
        let said = fstatvfs(file)?;
        Ok(Self {
            free: said.f_bavail.saturating_mul(said.f_frsize),
            size: said.f_blocks.saturating_mul(said.f_frsize),
        })
    }

    /// Would `bytes` more leave so little that an episode being recorded is warned of, or closed?
    /// `reserve` is the registry's `disk_reserve`.
    #[must_use]
    pub fn lacks_room_beside_an_episode(self, bytes: u64, reserve: Option<u64>) -> bool {
        self.free < self.reserve(reserve).saturating_mul(2).saturating_add(bytes)
    }

    /// What is kept free, bytes: what the registry says (`wanted`), else 1 GiB, or a twentieth of a smaller disk.
    #[must_use]
    pub fn reserve(self, wanted: Option<u64>) -> u64 {
        wanted.unwrap_or_else(|| RESERVE.min(self.size / SHARE))
    }
}
