//! Recording: one episode, one MCAP file, with the mask and the frame index beside every sample.
//!
//! `recorder` starts the `writer` thread, which owns the file: it takes what the bus hands over
//! ([`Source`]), `open_episode` decides what belongs to the episode and which frame it belongs to,
//! `file` writes it. `inspect` reads such a file back.
//!
//! Invariant: only the `writer` thread touches the file of an episode in a run, and only the caller that starts or
//! stops it waits for it. On a virtual clock there is no thread: `stepped` writes when it is called.
//! Invariant: a file whose name does not end in `.partial` is finished; no existing file is ever replaced.
//! Invariant: losses are counted and reported.

mod announce;
mod episode_path;
mod file;
mod hole;
pub mod inspect;
mod mask_history;
mod metadata;
mod open_episode;
mod provenance;
mod publishers;
mod quality;
mod recorder;
mod sources;
mod space;
pub mod stepped;
mod streams;
mod tampering;
#[cfg(test)]
pub(crate) mod tests;
mod verdict;
mod writeback;

use std::path::PathBuf;

pub use crate::chunk_writer::Sink;
pub use episode_path::{EpisodeRequest, open_folder};
pub use quality::{Quality, Spread};
pub use recorder::{Recorder, RecorderAddition, RecorderConfig, Source};
pub use space::Asker;

use rapid_core::text;
use rapid_system::disk::FileLimit;

/// Why an episode cannot be recorded.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// Neither the folder to write to nor its parent exists.
    #[error("{}: no such folder, and none above it to make it in: create it or choose another with --out", .0.display())]
    NoFolder(PathBuf),
    /// The path is not a folder.
    #[error("{}: not a folder; choose another with --out", .0.display())]
    NotAFolder(PathBuf),
    /// The folder or a file in it cannot be used.
    #[error("{}: {source}", path.display())]
    Io {
        /// Folder or file.
        path: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
    /// The folder lies behind another user's link, or cannot be entered.
    #[error("{0}, or choose another with --out")]
    Folder(rapid_system::folder::FolderError),
    /// The folder was moved while a session is collected in it.
    #[error(
        "{}: this folder was moved to {} during the session: move it back, or end this run and begin another with --out {}",
        from.display(), to.display(), to.display()
    )]
    Moved {
        /// Its path.
        from: PathBuf,
        /// Where it is now.
        to: PathBuf,
    },
    /// There is not enough disk space for an episode.
    #[error(
        "{}: the disk is full: {} free, and an episode needs more than {}, which are kept free (disk_reserve under \
         [rig] in devices.toml): remove or move recordings, choose another folder with --out, or lower disk_reserve",
        folder.display(), text::size(*free), text::size(*reserve)
    )]
    NoRoom {
        /// The folder.
        folder: PathBuf,
        /// Free space on its disk, bytes.
        free: u64,
        /// Space to be left free, bytes.
        reserve: u64,
    },
    /// Files may not be as large as an episode becomes.
    #[error("{}: too small for an episode: {limit}", folder.display())]
    FileLimit {
        /// The folder.
        folder: PathBuf,
        /// How large a file may become in it.
        limit: FileLimit,
    },
    /// There is an episode in progress.
    #[error("already recording {}", .0.display())]
    Busy(PathBuf),
    /// There is no episode in progress.
    #[error("not recording")]
    Idle,
    /// The `writer` thread has ended.
    #[error("the writer thread has ended; the log gives the reason")]
    Ended,
}
