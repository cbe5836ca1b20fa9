//! Dropping the last episode because it is too short to be used: asked for with one key, confirmed with another.
//!
//! Invariant: what is dropped is the file the question named, and only while that is still offered. Keys that come
//! at once, as pasted text does on a terminal that does not mark it, confirm nothing.

use std::path::PathBuf;
use std::time::Duration;

use super::{Effect, Model, NOTICE_SHOWN};
use crate::status::{Command, Snapshot};
use crate::time::Stamp;

/// Least time between question and confirmation: a person does not read faster, and pasted text arrives at once.
const LEAST: Duration = Duration::from_millis(150);

/// The question that was put to the user.
#[derive(Debug)]
pub(super) struct Asked {
    file: PathBuf,
    at: Stamp,
}

impl Asked {
    /// Is a confirmation by now one of this question?
    fn holds(&self, now: &Snapshot) -> bool {
        let waited = now.taken.since(self.at);
        (LEAST..=NOTICE_SHOWN).contains(&waited)
            && now.short_episode.as_ref().is_some_and(|short| short.file == self.file)
    }
}

impl Model {
    pub(super) fn ask_to_drop(&mut self) {
        let Some(short) = &self.latest.short_episode else {
            return self.say("nothing to drop: the last episode is not a short one");
        };
        let file = short.file.clone();
        let text = format!("y removes {} for good, any other key keeps it", name(&file));
        self.dropping = Some(Asked { file, at: self.latest.taken });
        self.say(&text);
    }

    pub(super) fn drop_episode(&mut self, asked: Option<Asked>) -> Effect {
        let Some(asked) = asked else { return Effect::None };
        if !asked.holds(&self.latest) {
            self.say("nothing dropped");
            return Effect::None;
        }
        let text = format!("dropping {}", name(&asked.file));
        self.say(&text);
        Effect::Send(Command::DropEpisode(asked.file))
    }
}

fn name(file: &std::path::Path) -> String {
    file.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
