//! A first look through an episode: what a comparison must know before it reads the samples.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use crate::action::ACTION_TOPIC;
use crate::driver::DriverError;
use crate::driver::replay::tape::{Content, Tape};
use crate::mask::PhysicalMask;
use crate::sample::Encoding;

/// What of a sample's number a recorded message holds.
pub(super) const SEQUENCE_BITS: u64 = 0xffff_ffff;

/// See the module's comment.
#[derive(Debug, Default)]
pub(super) struct Survey {
    /// Text of the registry it was recorded with.
    pub(super) registry: Option<String>,
    /// When it began, wall time.
    pub(super) begin_ns: u64,
    /// The same on the monotonic clock of the events.
    pub(super) begin_monotonic_ns: Option<u64>,
    /// Name and hash of the policy that recorded it.
    pub(super) policy: Option<(String, String)>,
    /// Its chunks, in the order of the file.
    pub(super) chunks: Vec<RecordedChunk>,
    /// Chunks that cannot be read.
    pub(super) unreadable: u64,
    /// The actions, in the order of the file.
    pub(super) actions: Vec<RecordedAction>,
    /// Of each topic the numbers of its samples, ascending.
    pub(super) samples: BTreeMap<String, Vec<u32>>,
    /// What of the file could not be read.
    pub(super) damage: Option<String>,
}

/// A chunk as its event has it.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct RecordedChunk {
    /// Tick of its observation on the control grid.
    pub(super) tick: u64,
    /// When that was.
    pub(super) observed_ns: u64,
    /// What was present.
    mask: String,
    /// Of the noise.
    pub(super) seed: u64,
    /// The samples of each observation.
    pub(super) samples: Vec<RecordedSamples>,
    /// What is no number is null.
    pub(super) actions: Vec<Option<f32>>,
}

impl RecordedChunk {
    /// What was present.
    pub(super) fn mask(&self) -> Option<PhysicalMask> {
        u64::from_str_radix(self.mask.strip_prefix("0x")?, 16).ok().map(PhysicalMask)
    }
}

/// Which samples an observation was made of.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct RecordedSamples {
    pub(super) modality: String,
    pub(super) seqs: Vec<u64>,
}

/// An action as it was published.
#[derive(Debug, Clone)]
pub(super) struct RecordedAction {
    /// Its number, which of a policy's action is that of the tick.
    pub(super) sequence: u32,
    /// The tick it is the action of, wall time.
    pub(super) at_ns: u64,
    pub(super) values: Vec<f64>,
}

#[derive(Deserialize)]
struct PolicyEvent {
    policy: String,
    hash: String,
}

impl Survey {
    /// Reads the whole file.
    pub(super) fn read(file: &Path) -> Result<Self, DriverError> {
        let mut tape = Tape::open(file)?;
        let mut survey = Self::default();
        let mut first = None;
        while let Some(taped) = tape.next_message()? {
            match taped.content {
                Content::Sample { encoding: Encoding::F64, bytes, .. } if taped.topic == ACTION_TOPIC => {
                    let values = bytes.as_chunks().0.iter().map(|number| f64::from_le_bytes(*number)).collect();
                    let (sequence, at_ns) = (taped.sequence, taped.log_time);
                    survey.actions.push(RecordedAction { sequence, at_ns, values });
                }
                Content::Sample { .. } => {
                    first = first.or(Some(taped.log_time));
                    match survey.samples.get_mut(taped.topic) {
                        Some(numbers) => numbers.push(taped.sequence),
                        None => drop(survey.samples.insert(taped.topic.to_owned(), vec![taped.sequence])),
                    }
                }
                Content::Event { kind: "chunk", json } => match serde_json::from_str(json) {
                    Ok(chunk) => survey.chunks.push(chunk),
                    Err(_) => survey.unreadable += 1,
                },
                Content::Event { kind: "policy", json } => {
                    if let Ok(PolicyEvent { policy, hash }) = serde_json::from_str(json) {
                        survey.policy.get_or_insert((policy, hash));
                    }
                }
                Content::Event { .. } | Content::Mask(_) => {}
            }
        }
        for numbers in survey.samples.values_mut() {
            numbers.sort_unstable();
        }
        let number = |key| tape.about(key).and_then(|text| text.parse().ok());
        survey.registry = tape.about("registry").map(str::to_owned);
        survey.begin_ns = number("begin_wall_ns").or(first).unwrap_or_default();
        survey.begin_monotonic_ns = number("begin_monotonic_ns");
        survey.damage = tape.damage();
        Ok(survey)
    }

    /// Did a policy record it?
    pub(super) fn is_of_a_policy(&self) -> bool {
        !self.chunks.is_empty() || self.unreadable > 0
    }

    /// Is sample `number` of `topic` in the file?
    pub(super) fn holds(&self, topic: &str, number: u64) -> bool {
        let sequence = u32::try_from(number & SEQUENCE_BITS).unwrap_or_default();
        self.samples.get(topic).is_some_and(|numbers| numbers.binary_search(&sequence).is_ok())
    }
}
