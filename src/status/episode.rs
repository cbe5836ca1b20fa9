//! The episode in progress, as those are told of it who do something about it themselves: devices that
//! record on their own, and the programs of a user; and the last one, if it may be dropped.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;
use tokio::sync::{SetOnce, watch};

use crate::text;

/// An episode in progress.
#[derive(Debug)]
pub struct Episode {
    /// The file it is to be once it is finished, an absolute path.
    pub file: PathBuf,
    /// The file that it has become.
    ended: SetOnce<PathBuf>,
}

/// The last episode, while it may be dropped because it is too short to be used.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ShortEpisode {
    /// Its file.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// Its length.
    pub length: Duration,
}

/// The episode in progress, if there is one, whenever that changes.
pub type EpisodeWatch = watch::Receiver<Option<Arc<Episode>>>;

impl Episode {
    /// The episode that will be `file`.
    #[must_use]
    pub fn new(file: &Path) -> Self {
        Self { file: absolute(file), ended: SetOnce::new() }
    }

    /// It has become `file`, which may have another name than it was to get. Only the first call counts.
    pub fn end(&self, file: &Path) {
        let _ = self.ended.set(absolute(file));
    }

    /// Waits until it has ended, whether it is whole or not; returns its file. Cancel-safe.
    pub async fn ended(&self) -> &Path {
        self.ended.wait().await
    }

    /// What it is called: the name of its file without `.mcap`, or `.mcap.partial`.
    #[must_use]
    pub fn id(&self) -> String {
        let stem = Path::new(self.file.file_stem().unwrap_or_default());
        let is_whole = stem.extension().is_none_or(|extension| extension != "mcap");
        let name = if is_whole { stem.as_os_str() } else { stem.file_stem().unwrap_or_default() };
        name.to_string_lossy().into_owned()
    }

    /// The folder of its file.
    #[must_use]
    pub fn folder(&self) -> &Path {
        self.file.parent().unwrap_or(Path::new("/"))
    }
}

/// Without a working folder there is nothing better than the path as it was given.
fn absolute(file: &Path) -> PathBuf {
    std::path::absolute(file).unwrap_or_else(|_| file.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_is_named_by_its_file() {
        let episode = Episode::new(Path::new("out/2026-11-21_place-block_001.mcap"));
        assert!(episode.file.is_absolute());
        assert_eq!(episode.id(), "2026-11-21_place-block_001");
        assert_eq!(Episode::new(Path::new("a.b_001.mcap.partial")).id(), "a.b_001");
        assert!(episode.folder().ends_with("out"));
    }
}
