//! The session as screens and other programs see it, and what they may request of it.
//!
//! Invariant: an episode of a session is identified by the name of its file, within the folder of the session.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::time::Stamp;
use serde::{Deserialize, Deserializer, Serialize, de};
use tokio::sync::oneshot;

use super::{Grade, Sensors, Verdict};

/// What a screen, a pedal or another program may request of the session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum SessionRequest {
    /// Begin an episode, or end the one in progress; during a countdown or a reset, begin at once.
    Toggle,
    /// Begin an episode; during a countdown or a reset, at once.
    Start,
    /// End the episode in progress, and begin no other by itself.
    Stop,
    /// End the episode in progress and begin the next.
    Next,
    /// Discard the episode in progress, or the last one, and record it again.
    Redo,
    /// Move an episode to the trash.
    Discard {
        /// The name of its file; `None`: the episode in progress, or the last one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        episode: Option<String>,
    },
    /// Take the episode discarded last back from the trash.
    Undo,
    /// Mark this moment of the episode in progress.
    Mark {
        /// What the moment is, if anything is to be recorded about it.
        #[serde(default)]
        text: String,
    },
    /// Label an episode.
    Label {
        /// As of a discard.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        episode: Option<String>,
        /// The label.
        label: Label,
        /// Why.
        #[serde(default)]
        reason: String,
    },
    /// Attach a note to an episode; an empty one removes it.
    Note {
        /// As of a discard.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        episode: Option<String>,
        /// The note.
        text: String,
    },
    /// Change what the next episodes are of. Absent fields stay as they are.
    Plan {
        /// The task.
        #[serde(default)]
        task: Option<String>,
        /// Tags to set; one with an empty value is removed.
        #[serde(default)]
        tags: Vec<(String, String)>,
        /// How many episodes are wanted; 0 removes the goal.
        #[serde(default)]
        goal: Option<u32>,
        /// Modules to mount, each in place of the one in its slot; `none` dismounts those that were declared.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        modules: Vec<String>,
    },
    /// End the session: its file is closed, and its trash is emptied.
    EndSession,
    /// Answer with a [`SessionStatus`] as JSON.
    Show,
}

/// Passes a request to the session on; the answer is what was done, or why it was refused.
pub type Asker = Arc<dyn Fn(SessionRequest, oneshot::Sender<Result<String, String>>) + Send + Sync>;

/// A press that asks for one of the requests that [count once](SessionRequest::counts_once), so soon after the last one,
/// is the repeat of a held key, which few terminals distinguish, or a hand that trembles.
pub const PRESS_AGAIN: Duration = Duration::from_millis(400);

impl SessionRequest {
    /// Whether made twice it does something else than made once: of presses within [`PRESS_AGAIN`] only the first counts.
    pub const fn counts_once(&self) -> bool {
        matches!(self, Self::Toggle | Self::Next | Self::Redo | Self::Discard { .. })
    }

    /// Whether an episode begins or ends by it.
    pub const fn is_about_recording(&self) -> bool {
        matches!(
            self,
            Self::Toggle | Self::Start | Self::Stop | Self::Next | Self::Redo | Self::Discard { episode: None }
        )
    }
}

/// Whether the demonstration in an episode succeeded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Label {
    /// It did.
    Success,
    /// It did not.
    Failure,
}

impl Label {
    /// The word for it, as in JSON.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Success => "success",
            Self::Failure => "failure",
        }
    }
}

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// A marked moment of an episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mark {
    /// Seconds since the beginning of the episode.
    #[serde(deserialize_with = "seconds")]
    pub at: f64,
    /// What it is; empty if nothing was given.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub text: String,
}

/// What people noted about an episode.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Notes {
    /// Whether the demonstration succeeded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<Label>,
    /// Why it has this label.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub label_reason: String,
    /// A note.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub note: String,
    /// Marked moments, by time.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub marks: Vec<Mark>,
}

impl Notes {
    /// Nothing was noted.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Takes over a change.
    pub fn apply(&mut self, change: &NotesChange) {
        match change {
            NotesChange::Label(label, reason) => {
                self.label = *label;
                self.label_reason.clone_from(reason);
            }
            NotesChange::Note(text) => self.note.clone_from(text),
            NotesChange::Mark(mark) if self.marks.contains(mark) => {}
            NotesChange::Mark(mark) => {
                self.marks.push(mark.clone());
                self.marks.sort_by(|a, b| a.at.total_cmp(&b.at));
            }
        }
    }

    /// What makes nothing to this.
    pub fn into_changes(self) -> Vec<NotesChange> {
        let label = self.label.map(|label| NotesChange::Label(Some(label), self.label_reason));
        let note = (!self.note.is_empty()).then_some(NotesChange::Note(self.note));
        label.into_iter().chain(note).chain(self.marks.into_iter().map(NotesChange::Mark)).collect()
    }
}

/// One change of what is noted about an episode.
#[derive(Debug, Clone, PartialEq)]
pub enum NotesChange {
    /// A label with its reason, or none any more.
    Label(Option<Label>, String),
    /// A note; an empty one removes it.
    Note(String),
    /// One more marked moment.
    Mark(Mark),
}

impl NotesChange {
    /// What somebody wrote.
    pub fn text(&self) -> &str {
        match self {
            Self::Label(_, text) | Self::Note(text) | Self::Mark(Mark { text, .. }) => text,
        }
    }
}

/// Longest time within an episode, or length of one, in seconds: some 30 years. A longer one is a mistake.
pub const LONGEST: f64 = 1e9;

/// A time in seconds that a computation can rely on.
fn seconds<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let seconds = f64::deserialize(deserializer)?;
    let wrong = || de::Error::custom(format!("{seconds} is no time in seconds: write a number from 0 to {LONGEST}"));
    (0.0..=LONGEST).contains(&seconds).then_some(seconds).ok_or_else(wrong)
}

fn some_seconds<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    struct Seconds;
    impl<'de> de::Visitor<'de> for Seconds {
        type Value = Option<f64>;
        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a time in seconds")
        }
        fn visit_none<E>(self) -> Result<Self::Value, E> {
            Ok(None)
        }
        fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
            seconds(deserializer).map(Some)
        }
    }
    deserializer.deserialize_option(Seconds)
}

/// One episode of a session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeEntry {
    /// Name of its file.
    pub file: String,
    /// What it is of; empty if that is not known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub task: String,
    /// When it began, RFC 3339, UTC.
    pub begun: String,
    /// Its length in seconds; absent while it is recorded, and if `rapid` was killed then.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "some_seconds")]
    pub seconds: Option<f64>,
    /// Its verdict; absent likewise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verdict: Option<Grade>,
    /// Why it is not GOOD.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub reasons: Vec<String>,
    /// Whether the demonstration succeeded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<Label>,
    /// Why it has this label.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub label_reason: String,
    /// A note.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub note: String,
    /// It is in the trash.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub discarded: bool,
    /// Marked moments.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub marks: Vec<Mark>,
    /// Which sensors took part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensors: Option<Sensors>,
}

impl EpisodeEntry {
    /// An episode that has begun, and of which nothing else is known.
    pub const fn begin(file: String, begun: String) -> Self {
        Self {
            file,
            task: String::new(),
            begun,
            seconds: None,
            verdict: None,
            reasons: Vec::new(),
            label: None,
            label_reason: String::new(),
            note: String::new(),
            discarded: false,
            marks: Vec::new(),
            sensors: None,
        }
    }

    /// Its file is closed: its length in seconds, rounded to milliseconds, and its verdict.
    pub fn close(&mut self, seconds: f64, verdict: &Verdict) {
        self.seconds = Some((seconds * 1000.0).round() / 1000.0);
        self.verdict = Some(verdict.grade);
        self.reasons.clone_from(&verdict.reasons);
        self.sensors.clone_from(&verdict.sensors);
    }

    /// What people noted about it.
    pub fn notes(&self) -> Notes {
        let Self { label, label_reason, note, marks, .. } = self;
        Notes { label: *label, label_reason: label_reason.clone(), note: note.clone(), marks: marks.clone() }
    }

    /// Takes over what people noted about it.
    pub fn set_notes(&mut self, notes: Notes) {
        let Notes { label, label_reason, note, marks } = notes;
        (self.label, self.label_reason, self.note, self.marks) = (label, label_reason, note, marks);
    }

    /// Whether it counts for the goal: it is closed and kept, and not BAD.
    pub fn counts(&self) -> bool {
        !self.discarded && self.verdict.is_some_and(|grade| grade != Grade::Bad)
    }
}

/// What the session does at the moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(tag = "phase", rename_all = "snake_case")]
pub enum Phase {
    /// It waits for a request.
    #[default]
    Idle,
    /// An episode begins at `until`.
    Countdown {
        /// When.
        until: Stamp,
    },
    /// An episode is being recorded.
    Recording,
    /// The last samples of an episode are being written.
    Ending,
    /// The scene is being reset; the next episode follows at `until`.
    Reset {
        /// When.
        until: Stamp,
    },
}

/// An answer to a request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Answered {
    /// When.
    pub at: Stamp,
    /// What was done, or why the request was refused.
    pub text: String,
    /// It was refused.
    pub refused: bool,
}

/// A session, for a screen.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SessionStatus {
    /// Where its episodes are written.
    #[serde(serialize_with = "rapid_core::text::lossy")]
    pub folder: PathBuf,
    /// The task of the next episode.
    pub task: String,
    /// Its tags.
    pub tags: Vec<(String, String)>,
    /// How many episodes are wanted.
    pub goal: Option<u32>,
    /// What it does at the moment.
    pub phase: Phase,
    /// How many episodes count for the goal.
    pub counted: usize,
    /// Episodes that are kept, by verdict: GOOD, SUSPECT, BAD.
    pub verdicts: [usize; 3],
    /// Episodes in the trash.
    pub discarded: usize,
    /// The newest episodes, oldest first.
    pub episodes: Vec<EpisodeEntry>,
    /// The last answer to a request.
    pub answer: Option<Answered>,
}

impl SessionStatus {
    /// `12 of 50`, or `12` without a goal.
    pub fn progress(&self) -> String {
        match self.goal {
            Some(goal) => format!("{} of {goal}", self.counted),
            None => self.counted.to_string(),
        }
    }
}
