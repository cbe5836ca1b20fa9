//! What the receding horizon tells: what to do, why nothing is done, and what has happened.

use serde::Serialize;

/// Why no action is executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum HoldReason {
    /// A modality without which the policy must not run is not there.
    RequiredMissing,
    /// A modality is not there, and the policy was not trained to do without.
    NotMaskAware,
    /// None of the pictures that the policy observes is there.
    NoPicture,
    /// What the sensors last saw is older than the bundle allows.
    ObservationOld,
    /// The policy is computing, and no action is left of its last chunk.
    Waiting,
    /// The policy's last answer could not be used.
    Unusable,
}

impl HoldReason {
    pub(super) const fn is_missing(self) -> bool {
        matches!(self, Self::RequiredMissing | Self::NotMaskAware | Self::NoPicture)
    }
}

impl std::fmt::Display for HoldReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::RequiredMissing => "a modality that the policy requires is missing",
            Self::NotMaskAware => "a modality is missing, and the policy was not trained to do without",
            Self::NoPicture => "no picture that the policy observes is there",
            Self::ObservationOld => "the observation is too old",
            Self::Waiting => "the next actions are still being computed",
            Self::Unusable => "the policy's last answer could not be used",
        })
    }
}

/// What to do at a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step<'a> {
    /// The values to execute, within the limits; none means hold.
    pub action: Option<&'a [f32]>,
    /// Why there are none.
    pub hold: Option<HoldReason>,
    /// Does a hold begin here, or its reason change? Say it once.
    pub hold_is_news: bool,
    /// The modality whose absence is the reason.
    pub missing: Option<&'a str>,
    /// The index of the action in its chunk.
    pub index: Option<usize>,
    /// Ticks since the observation the action follows from.
    pub chunk_age_ticks: Option<u64>,
    /// Was this the first action of its chunk that went beyond the limits? Say it once.
    pub clamped_is_news: bool,
}

/// Why a chunk is not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum Refused {
    /// No such observation is with the policy.
    #[error("actions for an observation that was not asked about")]
    Unasked,
    /// Not `horizon` actions.
    #[error("a chunk of the wrong length")]
    Length,
    /// NaN or infinity.
    #[error("a chunk with values that are no finite numbers")]
    NotFinite,
    /// Its observation was made before the last hold began.
    #[error("actions that were decided before the policy had to hold")]
    BeforeHold,
    /// None of its actions is left.
    #[error("actions so late that the time for all of them has passed")]
    Expired,
}

/// What has happened so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Counts {
    /// Ticks with an action.
    pub actions: u64,
    /// Ticks without.
    pub held_ticks: u64,
    /// Holds that began, the one at the start among them.
    pub holds: u64,
    /// Observations sent to the policy.
    pub requests: u64,
    /// Chunks that were used.
    pub chunks: u64,
    /// Those of them that came more than one tick after their observation.
    pub late_chunks: u64,
    /// Their actions that were skipped for it.
    pub skipped_actions: u64,
    /// Chunks of which no action was left.
    pub expired_chunks: u64,
    /// Chunks with NaN or infinity.
    pub not_finite_chunks: u64,
    /// Chunks of the wrong length.
    pub wrong_length_chunks: u64,
    /// Chunks for an observation nobody asked about.
    pub unasked_chunks: u64,
    /// Chunks of before a hold.
    pub before_hold_chunks: u64,
    /// Observations the policy had no answer to.
    pub failed_requests: u64,
    /// Executed actions with a value at a limit because it lay beyond.
    pub clamped_actions: u64,
    /// Ticks at which an observation was due but too old.
    pub old_observations: u64,
}
