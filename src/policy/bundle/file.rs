//! The contents of `policy.json` as serde reads them, where its objects differ from those of `spec`.

use std::ops::Range;
use std::time::Duration;

use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny};
use serde_json::{Map, Value};

use super::spec::{ActionRotation, ColorOrder, Operation, VectorOperation, VectorRotation, WhenAbsent};
use super::values::{MAX_VALUES, Side, Whole, name, names, numbers, size, slice, some_slice, word, word_or_null};

/// Maximum number of actions in a chunk, and of values in an action.
const MAX_ACTION: i64 = 1024;
/// Longest time for which samples of an absent modality are held, ms.
const LONGEST_HOLD_MS: i64 = 600_000;
/// Most ticks between two steps of an observation.
const MAX_DOWN_SAMPLE: i64 = 64;
/// Most steps of a history.
const MAX_HISTORY: i64 = 64;

/// The file without its nested objects, which are read separately.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Head {
    #[serde(rename = "format")]
    _format: IgnoredAny,
    #[serde(deserialize_with = "name")]
    pub(super) name: String,
    pub(super) mask_aware: bool,
    pub(super) n_obs_steps: Whole<1, 64>,
    pub(super) horizon: Whole<1, MAX_ACTION>,
    pub(super) n_action_steps: Whole<1, MAX_ACTION>,
    pub(super) action_start: Whole<0, { MAX_ACTION - 1 }>,
    pub(super) control_hz: f64,
    pub(super) max_observation_age_ms: Whole<1, 60_000>,
    #[serde(rename = "observations")]
    _observations: Vec<IgnoredAny>,
    #[serde(rename = "mask")]
    _mask: IgnoredAny,
    #[serde(rename = "action")]
    _action: IgnoredAny,
    #[serde(rename = "scheduler")]
    _scheduler: IgnoredAny,
    #[serde(rename = "graphs")]
    _graphs: IgnoredAny,
    pub(super) training: Map<String, Value>,
}

/// One of `observations`, selected by its `kind`.
#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum ObservationFile {
    Image(ImageFile),
    Vector(VectorFile),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ImageFile {
    #[serde(deserialize_with = "name")]
    pub(super) key: String,
    #[serde(deserialize_with = "name")]
    pub(super) modality: String,
    pub(super) required: bool,
    pub(super) shape: [Side; 3],
    #[serde(deserialize_with = "word")]
    pub(super) color: ColorOrder,
    #[serde(deserialize_with = "size")]
    pub(super) resize: Option<[usize; 2]>,
    #[serde(deserialize_with = "size")]
    pub(super) crop: Option<[usize; 2]>,
    #[serde(deserialize_with = "word_or_null")]
    pub(super) operation: Option<Operation>,
    pub(super) normalization: Value,
    #[serde(default, deserialize_with = "when_absent")]
    pub(super) when_absent: Option<WhenAbsent>,
    #[serde(default)]
    pub(super) down_sample_steps: Option<Whole<1, MAX_DOWN_SAMPLE>>,
    #[serde(default)]
    pub(super) history: Option<Value>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct HistoryFile {
    pub(super) steps: Whole<2, MAX_HISTORY>,
    #[serde(deserialize_with = "name")]
    pub(super) valid: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct VectorFile {
    #[serde(deserialize_with = "name")]
    pub(super) key: String,
    #[serde(deserialize_with = "name")]
    pub(super) modality: String,
    pub(super) required: bool,
    pub(super) shape: [Whole<1, MAX_VALUES>; 1],
    #[serde(default, deserialize_with = "some_slice")]
    pub(super) slice: Option<Range<usize>>,
    pub(super) normalization: Value,
    #[serde(default, deserialize_with = "when_absent")]
    pub(super) when_absent: Option<WhenAbsent>,
    #[serde(default)]
    pub(super) down_sample_steps: Option<Whole<1, MAX_DOWN_SAMPLE>>,
    /// Null: values are used unchanged.
    #[serde(default, deserialize_with = "word_or_null")]
    pub(super) rotation: Option<VectorRotation>,
    /// Null: those of each step.
    #[serde(default, deserialize_with = "word_or_null")]
    pub(super) operation: Option<VectorOperation>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MaskFile {
    #[serde(deserialize_with = "name")]
    pub(super) input: String,
    #[serde(deserialize_with = "names")]
    pub(super) order: Vec<String>,
    #[serde(rename = "absent", deserialize_with = "word")]
    _absent: Absent,
}

/// The embedding of an absent modality.
#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum Absent {
    ZeroEmbedding,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ActionFile {
    #[serde(deserialize_with = "name")]
    pub(super) actuator: String,
    pub(super) shape: [Whole<1, MAX_ACTION>; 1],
    #[serde(deserialize_with = "names")]
    pub(super) names: Vec<String>,
    #[serde(deserialize_with = "names")]
    pub(super) units: Vec<String>,
    #[serde(deserialize_with = "word")]
    pub(super) representation: RepresentationWord,
    /// Null: values are used unchanged.
    #[serde(default, deserialize_with = "word_or_null")]
    pub(super) rotation: Option<ActionRotation>,
    #[serde(default)]
    pub(super) base: Option<Value>,
    pub(super) limits: Value,
    pub(super) normalization: Vec<Value>,
}

/// `representation`, without the base.
#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum RepresentationWord {
    Absolute,
    Relative,
    Delta,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BaseFile {
    #[serde(deserialize_with = "name")]
    pub(super) modality: String,
    #[serde(deserialize_with = "slice")]
    pub(super) position: Range<usize>,
    #[serde(default, deserialize_with = "some_slice")]
    pub(super) rotation: Option<Range<usize>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Limits {
    #[serde(deserialize_with = "numbers")]
    pub(super) min: Vec<f32>,
    #[serde(deserialize_with = "numbers")]
    pub(super) max: Vec<f32>,
}

/// The `slice` of an action's normalisation, which is read separately.
#[derive(Deserialize)]
pub(super) struct Sliced {
    #[serde(deserialize_with = "slice")]
    pub(super) slice: Range<usize>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Graphs {
    pub(super) encoder: Value,
    pub(super) denoiser: Value,
}

/// `None` only if the key is left out.
fn when_absent<'de, D: Deserializer<'de>>(value: D) -> Result<Option<WhenAbsent>, D::Error> {
    #[derive(Deserialize)]
    #[serde(rename_all = "snake_case")]
    enum Written {
        Zero,
        HoldLastMs(Whole<1, LONGEST_HOLD_MS>),
    }
    Ok(Some(match Written::deserialize(value)? {
        Written::Zero => WhenAbsent::Zero,
        Written::HoldLastMs(ms) => WhenAbsent::HoldLast(Duration::from_millis(ms.get() as u64)),
    }))
}
