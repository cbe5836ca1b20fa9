//! What a policy does, in words that stages and screens share.

use serde::Serialize;

use crate::mask::PhysicalMask;

/// The policy at the controls, for a screen.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PolicyStatus {
    /// What its bundle calls itself.
    pub name: String,
    /// Nothing moves: its actions are shown and recorded, and not carried out.
    pub dry_run: bool,
    /// The mask it saw last.
    pub mask: PhysicalMask,
    /// From the observation to the chunk, ms, of the newest chunk.
    pub latency_ms: Option<f64>,
    /// Ticks since the observation that the action follows from.
    pub chunk_age: Option<u64>,
    /// The newest action: name, value and unit of each axis.
    pub action: Vec<(String, f64, String)>,
    /// Why nothing is done, if nothing is.
    pub hold: Option<String>,
    /// Ticks with an action.
    pub actions: u64,
    /// Ticks without.
    pub held: u64,
    /// Chunks that were used.
    pub chunks: u64,
    /// Answers that were not used or never came.
    pub unused: u64,
}

/// The samples of one modality that a chunk was computed from: with the seed of its noise, enough to compute
/// it again from the recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ObservedSamples {
    /// The modality.
    pub modality: String,
    /// Numbers of its samples, the oldest step first; none where it was absent.
    pub seqs: Vec<u64>,
}

/// A chunk of actions, from what it was computed, and how long that took.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Chunk {
    /// Tick of its observation on the control grid.
    pub tick: u64,
    /// When that was, `CLOCK_MONOTONIC` ns.
    pub observed_ns: u64,
    /// What was present, `0x05`.
    pub mask: String,
    /// Of the noise.
    pub seed: u64,
    /// From the tick to the answer, ms.
    pub latency_ms: f64,
    /// Its actions were fit to be used.
    pub used: bool,
    /// Its actions whose time had passed when it came.
    pub skipped: u64,
    /// The samples.
    pub samples: Vec<ObservedSamples>,
    /// The actions, one after the other, as the policy gave them.
    pub actions: Vec<f32>,
}
