//! Why a dataset cannot be read or written.

use std::io;
use std::path::PathBuf;

use parquet::errors::ParquetError;
use rapid_system::folder::FolderError;

use super::ffmpeg::FfmpegError;
use super::picture::Pictures;
use super::rows::Refusal;

/// Why a dataset cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum SetError {
    /// A folder.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A file.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// A table.
    #[error("{}: {source}", path.display())]
    Parquet {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: ParquetError,
    },
    /// A video.
    #[error(transparent)]
    Ffmpeg(FfmpegError),
    /// The dataset has its pictures otherwise.
    #[error("{}: its pictures are {of_set}, and --pictures is {requested}: leave it out, or name another --out", folder.display())]
    Pictures {
        /// The dataset.
        folder: PathBuf,
        /// How it has them.
        of_set: Pictures,
        /// What was asked for.
        requested: Pictures,
    },
    /// A file that this program did not write.
    #[error("{}: {problem}; --out takes a new folder, or a dataset that `rapid export` made", path.display())]
    Foreign {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// Another program writes to it.
    #[error("{}: another `rapid export` writes to this dataset: wait for its end", .0.display())]
    Busy(PathBuf),
    /// The episode.
    #[error(transparent)]
    Refused(#[from] Refusal),
}

impl From<FfmpegError> for SetError {
    fn from(error: FfmpegError) -> Self {
        match error {
            FfmpegError::Interrupted => Self::Refused(Refusal::Interrupted),
            error => Self::Ffmpeg(error),
        }
    }
}
