//! The last episode, if it is too short to be used: what may be dropped.
//!
//! Invariant: only the file that was there when the episode ended is ever removed: one that was changed since, or
//! another of the same name, stays.

use std::fs::{File, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::episode::EpisodeReport;
use super::verdict::is_short;
use crate::folder::{Folder, Links, Missing};
use crate::status::ShortEpisode;

/// See the module's comment.
pub(super) struct Short {
    path: PathBuf,
    seconds: f64,
    folder: Folder,
    /// Kept open: no other file gets its inode number.
    file: File,
    /// As the recorder left it.
    left: Metadata,
}

impl Short {
    /// The episode, if it is finished and short.
    pub(super) fn of(report: &EpisodeReport) -> Option<Self> {
        if !is_short(report.seconds) {
            return None;
        }
        let path = report.file.clone();
        // What cannot be opened again is not offered: nothing is lost but a convenience.
        let folder = Folder::open(path.parent()?, Links::Own, Missing::Refused).ok()?;
        let file = folder.open_file(path.file_name()?).ok()?;
        let left = file.metadata().ok()?;
        Some(Self { path, seconds: report.seconds, folder, file, left })
    }

    /// For the screen.
    pub(super) fn offer(&self) -> ShortEpisode {
        ShortEpisode { file: self.path.clone(), length: Duration::from_secs_f64(self.seconds.max(0.0)) }
    }

    /// Is this its file?
    pub(super) fn is(&self, file: &Path) -> bool {
        self.path == file
    }

    /// Removes the file; returns the length of the episode in seconds.
    ///
    /// # Errors
    /// When the file was changed, replaced or removed since the episode ended, or cannot be removed.
    pub(super) fn remove(self) -> io::Result<f64> {
        let name = self.path.file_name().unwrap_or_default();
        let now = self.folder.open_file(name)?.metadata()?;
        if as_written(&now) != as_written(&self.left) {
            return Err(io::Error::other("changed since the episode ended; remove it by hand"));
        }
        self.folder.remove(name)?;
        drop(self.file);
        Ok(self.seconds)
    }
}

/// What differs between two files, and between a file before and after it was written to.
fn as_written(file: &Metadata) -> (u64, u64, u64, i64, i64) {
    (file.dev(), file.ino(), file.len(), file.mtime(), file.mtime_nsec())
}
