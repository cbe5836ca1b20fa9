//! What must outlive a connection to a camera, and the run: that its shutter is ours, for which episode, and which
//! clips are still to be fetched.
//!
//! `gopro/SERIAL.json` in the state directory, SERIAL being the camera's serial number; without one the name of its
//! entry. Of a clip only the path of its note is kept: whoever moves or removes an episode with its note is not sent
//! the clip.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::answer::Name;
use crate::folder::{Folder, Links, Missing, Sync, read_text};

/// Some thousands of notes.
const LARGEST: u64 = 1 << 20;

/// The shutter that was started for an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Shutter {
    /// The file that the episode will be.
    pub(super) episode: PathBuf,
    pub(super) before: Before,
}

/// The newest clip on the card before the shutter was started: the one that it made is another.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Before {
    /// There was none.
    Nothing,
    Clip(Name),
    /// It was not known, and why: no clip can be told to be the episode's.
    Unknown(String),
}

/// See the module's comment.
#[derive(Debug, Default)]
pub(super) struct Books {
    /// `None` where there is no folder for it.
    file: Option<PathBuf>,
    pages: Pages,
    is_said: bool,
}

#[derive(Debug, Default, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
struct Pages {
    shutter: Option<Shutter>,
    notes: Vec<PathBuf>,
}

impl Books {
    /// Those of the camera of this name, a plain one, below the state directory.
    pub(super) async fn open(state: Option<&Path>, name: &str) -> Self {
        let Some(file) = state.map(|state| state.join("gopro").join(format!("{name}.json"))) else {
            return Self::default();
        };
        let path = file.clone();
        let pages = tokio::task::spawn_blocking(move || {
            let text = read_text(&path, LARGEST).ok()?;
            let read = serde_json::from_str(&text);
            read.inspect_err(|error| tracing::warn!(%error, "{} is not ours and is written anew", path.display())).ok()
        });
        Self { file: Some(file), pages: pages.await.ok().flatten().unwrap_or_default(), is_said: false }
    }

    pub(super) const fn shutter(&self) -> Option<&Shutter> {
        self.pages.shutter.as_ref()
    }

    pub(super) async fn set_shutter(&mut self, shutter: Option<Shutter>) {
        if self.pages.shutter != shutter {
            self.pages.shutter = shutter;
            self.save().await;
        }
    }

    /// Notes of the clips that are still to be fetched.
    pub(super) fn notes(&self) -> &[PathBuf] {
        &self.pages.notes
    }

    pub(super) async fn remember(&mut self, note: PathBuf) {
        if !self.pages.notes.contains(&note) {
            self.pages.notes.push(note);
            self.save().await;
        }
    }

    pub(super) async fn forget(&mut self, note: &Path) {
        let before = self.pages.notes.len();
        self.pages.notes.retain(|kept| kept != note);
        if self.pages.notes.len() != before {
            self.save().await;
        }
    }

    /// Is it on the disk, so that another run goes on with it?
    pub(super) const fn are_kept(&self) -> bool {
        self.file.is_some() && !self.is_said
    }

    async fn save(&mut self) {
        let Some(file) = self.file.clone() else { return };
        let pages = self.pages.clone();
        let write = move || {
            let text = serde_json::to_vec_pretty(&pages)?;
            let folder = file.parent().unwrap_or(Path::new("."));
            let folder = Folder::open(folder, Links::Own, Missing::All)?;
            let name = file.file_name().unwrap_or_default();
            if pages == Pages::default() {
                let _ = folder.remove(name);
                return Ok(());
            }
            // Whoever loses the power loses the camera, too.
            folder.replace(name, &text, 0o600, Sync::Skip)
        };
        let saved = tokio::task::spawn_blocking(write).await.unwrap_or_else(|error| Err(std::io::Error::other(error)));
        if let (Err(error), false) = (&saved, self.is_said) {
            tracing::warn!(%error, "what the camera still has for us is known to this run alone");
        }
        self.is_said = saved.is_err();
    }
}
