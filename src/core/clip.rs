//! What a device that records by itself does about the episode in progress.

use serde::{Deserialize, Serialize};

/// What its own recording does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClipState {
    /// It is to record the episode in progress from now on.
    Asked,
    /// It reports that it records.
    Recording,
    /// It did not begin; it is asked again.
    Refused,
    /// It stopped without being asked to.
    Stopped,
}

impl ClipState {
    /// The word for it.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Asked => "asked",
            Self::Recording => "recording",
            Self::Refused => "refused",
            Self::Stopped => "stopped",
        }
    }
}

/// A change of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ClipNotice {
    /// What it does now.
    pub state: ClipState,
    /// Why, for people; may be empty.
    pub text: String,
}
