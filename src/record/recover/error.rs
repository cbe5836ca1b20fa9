//! Why a repair was not made.

use std::io;
use std::path::PathBuf;

use crate::episode_format::OpenError;

/// Why a file was not repaired. It is as it was.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// The system refuses.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// It is a folder, a pipe, a device or a link.
    #[error("{}: not a file; name an episode itself, a file that ends in .mcap or .mcap.partial", .0.display())]
    NotFile(PathBuf),
    /// It is being written, or repaired, at this moment.
    #[error("{}: another rapid is writing or repairing it; end that first", .0.display())]
    Busy(PathBuf),
    /// Whether it is being written cannot be known.
    #[error("{}: its file system knows no locks, so it may still be written; copy it to another disk and repair it there", .0.display())]
    NoLock(PathBuf),
    /// A finished file that is no MCAP file.
    #[error("{}: not an MCAP file", .0.display())]
    NotMcap(PathBuf),
    /// A finished file in which nothing can be read.
    #[error("{}: no message in it can be read", .0.display())]
    Nothing(PathBuf),
    /// The user ended it.
    #[error("{}: interrupted; it is as it was", .0.display())]
    Interrupted(PathBuf),
}

impl From<OpenError> for RecoverError {
    fn from(error: OpenError) -> Self {
        match error {
            OpenError::Io { path, source } => Self::Io { path, source },
            OpenError::NotFile(path) => Self::NotFile(path),
        }
    }
}

impl RecoverError {
    /// Was something named that cannot be meant?
    #[must_use]
    pub fn is_bad_argument(&self) -> bool {
        match self {
            Self::NotFile(_) | Self::NotMcap(_) => true,
            Self::Io { source, .. } => source.kind() == io::ErrorKind::NotFound,
            _ => false,
        }
    }
}
