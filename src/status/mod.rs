//! Status: the only words between the stages and a screen.
//!
//! Stages report on the [`board`]; a screen takes a [`Snapshot`] from it and sends [`Command`]s.
//!
//! Invariant: a screen holds no handle into a stage.

pub mod board;
mod episode;
mod event;
#[cfg(test)]
pub(crate) mod literal;
mod policy;
pub mod rates;
mod stop;
mod verdict;

use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;

use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::sample::Epoch;
use crate::text;
use crate::time::Stamp;

pub use board::{Board, EpisodeEnd};
pub use episode::{Episode, EpisodeWatch, ShortEpisode};
pub use event::{Event, Provenance, What};
pub use policy::{Chunk, ObservedSamples, PolicyStatus};
pub use stop::StopStatus;
pub use verdict::{Grade, Sensors, Verdict};

/// What the device of a modality is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SlotState {
    /// Not attached.
    #[default]
    Absent,
    /// Attached; its first sample has not come.
    Opening,
    /// Samples arrive.
    Streaming,
    /// Attached and started, but samples have stopped. The mask bit stays.
    Stalled,
    /// Attached; waits before it is started or started again.
    Backoff,
    /// Attached; given up until it is replugged or restarted by hand.
    Failed,
}

impl SlotState {
    /// The word for it, as in JSON.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Absent => "absent",
            Self::Opening => "opening",
            Self::Streaming => "streaming",
            Self::Stalled => "stalled",
            Self::Backoff => "backoff",
            Self::Failed => "failed",
        }
    }
}

/// One row of the device table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeviceStatus {
    /// Name of the modality.
    pub name: String,
    /// Its bit.
    pub id: ModalityId,
    /// Topic.
    pub topic: String,
    /// State of the slot.
    pub state: SlotState,
    /// Incarnation.
    pub epoch: Epoch,
    /// Node in use and agreed format, or the reason of the state.
    pub detail: String,
    /// Samples since start.
    pub samples: u64,
    /// Samples lost between device and bus, as the device or kernel counts them.
    pub gaps: u64,
    /// Payload bytes since start.
    pub bytes: u64,
    /// Capture time of the newest sample.
    pub newest: Option<Stamp>,
}

/// The recording in progress.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingStatus {
    /// The file being written.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// Since the episode began.
    pub elapsed: Duration,
    /// Messages written.
    pub messages: u64,
    /// Payload bytes written.
    pub bytes: u64,
    /// Samples the recorder lost because its queue overflowed.
    pub dropped: u64,
    /// While the disk is nearly full: how long until the episode is closed for want of room.
    pub room: Option<Duration>,
}

/// A line of the log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LogLine {
    /// Wall time, ns since 1970.
    pub wall_ns: u64,
    /// Severity.
    pub level: Level,
    /// Text, without control characters.
    pub text: String,
}

/// Severity of a log line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// Details.
    Debug,
    /// A state change a user cares about.
    Info,
    /// Something is not as it should be, and goes on.
    Warn,
    /// Something ended that should not have.
    Error,
}

impl Level {
    /// The word for it, as in JSON.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Debug => "debug",
            Self::Info => "info",
            Self::Warn => "warn",
            Self::Error => "error",
        }
    }
}

/// Everything a screen may show, copied at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Snapshot {
    /// Name of the rig.
    pub rig: String,
    /// When this was taken.
    pub taken: Stamp,
    /// Since `rapid` started.
    pub uptime: Duration,
    /// The mask as published.
    pub mask: PhysicalMask,
    /// Publications of the mask so far.
    pub mask_sequence: u64,
    /// One a modality, ascending by bit.
    pub devices: Vec<DeviceStatus>,
    /// Emergency stops and enabling switches, in the order of the registry.
    pub stops: Vec<StopStatus>,
    /// The recording in progress.
    pub recording: Option<RecordingStatus>,
    /// The policy at the controls, if one is.
    pub policy: Option<PolicyStatus>,
    /// The last file finished.
    #[serde(serialize_with = "text::lossy_option")]
    pub last_episode: Option<PathBuf>,
    /// The verdict on it.
    pub last_verdict: Option<Verdict>,
    /// The last episode, while it may be dropped because it is too short to be used.
    pub short_episode: Option<ShortEpisode>,
    /// The newest log lines, oldest first.
    pub log: Vec<LogLine>,
}

/// What a screen may ask for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Command {
    /// Begin an episode, or end the one in progress.
    ToggleRecording,
    /// Remove this file: the last episode, if it is too short to be used and none has begun since.
    DropEpisode(PathBuf),
    /// Start a failed device again.
    Restart(ModalityId),
    /// End the program.
    Quit,
}
