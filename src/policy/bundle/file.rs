//! The contents of `policy.json` as serde reads them: objects that differ between the file and `spec`, and values with
//! a smaller range than their types.

use std::ops::Range;
use std::time::Duration;

use rapid_core::text;
use serde::Deserialize;
use serde::de::{Deserializer, Error, IgnoredAny, IntoDeserializer};
use serde_json::{Map, Value};

use super::spec::{ActionRotation, ColorOrder, Operation, VectorOperation, VectorRotation, WhenAbsent};

/// Maximum number of actions in a chunk, and of values in an action.
const MAX_ACTION: i64 = 1024;
/// Longest side of a picture, pixels.
type Side = Whole<1, 8192>;
/// Longest time for which samples of an absent modality are held, ms.
const LONGEST_HOLD_MS: i64 = 600_000;
/// Most ticks between two steps of an observation.
const MAX_DOWN_SAMPLE: i64 = 64;
/// Most steps of a history.
const MAX_HISTORY: i64 = 64;
/// Maximum length of a vector.
const MAX_VALUES: i64 = 4096;

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

/// A whole number from `MIN` to `MAX`.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(try_from = "i64")]
pub(super) struct Whole<const MIN: i64, const MAX: i64>(usize);

impl<const MIN: i64, const MAX: i64> Whole<MIN, MAX> {
    pub(super) const fn get(self) -> usize {
        self.0
    }
}

impl<const MIN: i64, const MAX: i64> TryFrom<i64> for Whole<MIN, MAX> {
    type Error = String;

    fn try_from(number: i64) -> Result<Self, String> {
        let found = usize::try_from(number).ok().filter(|_| (MIN..=MAX).contains(&number));
        found.map(Self).ok_or_else(|| match MAX - MIN {
            0 => format!("{number} is not supported, only {MIN} is"),
            _ => format!("{number} is not between {MIN} and {MAX}"),
        })
    }
}

/// A number that fits into an f32.
#[derive(Deserialize)]
#[serde(try_from = "f64")]
struct Float(f32);

impl TryFrom<f64> for Float {
    type Error = String;

    #[expect(clippy::cast_possible_truncation, reason = "what becomes infinite is refused")]
    fn try_from(number: f64) -> Result<Self, String> {
        let float = number as f32;
        float
            .is_finite()
            .then_some(Self(float))
            .ok_or_else(|| format!("{number:e} is beyond the range of a 32-bit float"))
    }
}

/// Printable, non-empty text.
#[derive(Deserialize)]
#[serde(try_from = "String")]
struct Name(String);

impl TryFrom<String> for Name {
    type Error = &'static str;

    fn try_from(name: String) -> Result<Self, Self::Error> {
        match name.as_str() {
            "" => Err("is empty"),
            shown if text::plain(shown) != shown => Err("contains control characters"),
            _ => Ok(Self(name)),
        }
    }
}

pub(super) fn name<'de, D: Deserializer<'de>>(value: D) -> Result<String, D::Error> {
    Name::deserialize(value).map(|name| name.0)
}

fn names<'de, D: Deserializer<'de>>(value: D) -> Result<Vec<String>, D::Error> {
    Vec::<Name>::deserialize(value).map(|names| names.into_iter().map(|name| name.0).collect())
}

pub(super) fn numbers<'de, D: Deserializer<'de>>(value: D) -> Result<Vec<f32>, D::Error> {
    Vec::<Float>::deserialize(value).map(|numbers| numbers.into_iter().map(|number| number.0).collect())
}

/// `[height, width]` or null.
fn size<'de, D: Deserializer<'de>>(value: D) -> Result<Option<[usize; 2]>, D::Error> {
    Option::<[Side; 2]>::deserialize(value).map(|size| size.map(|sides| sides.map(Whole::get)))
}

/// `[begin, end]`, end not included, not empty.
fn slice<'de, D: Deserializer<'de>>(value: D) -> Result<Range<usize>, D::Error> {
    let [begin, end] = <[Whole<0, MAX_VALUES>; 2]>::deserialize(value)?.map(Whole::get);
    if begin < end { Ok(begin..end) } else { Err(D::Error::custom(format!("[{begin}, {end}] is empty"))) }
}

fn some_slice<'de, D: Deserializer<'de>>(value: D) -> Result<Option<Range<usize>>, D::Error> {
    slice(value).map(Some)
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

pub(super) fn whole<'de, D: Deserializer<'de>, const MIN: i64, const MAX: i64>(value: D) -> Result<usize, D::Error> {
    Whole::<MIN, MAX>::deserialize(value).map(Whole::get)
}

/// A variant of an enum without values, by its name; serde alone would also accept `{name: null}`.
pub(super) fn word<'de, D: Deserializer<'de>, T: Deserialize<'de>>(value: D) -> Result<T, D::Error> {
    T::deserialize(String::deserialize(value)?.into_deserializer())
}

/// The same, or null. Without such a function serde would let a key of type `Option` be omitted.
fn word_or_null<'de, D: Deserializer<'de>, T: Deserialize<'de>>(value: D) -> Result<Option<T>, D::Error> {
    let given = Option::<String>::deserialize(value)?;
    given.map(|given| T::deserialize(given.into_deserializer())).transpose()
}

pub(super) fn file_name<'de, D: Deserializer<'de>>(value: D) -> Result<String, D::Error> {
    let file = name(value)?;
    if file.contains(['/', '\\']) || file.starts_with('.') {
        return Err(D::Error::custom(format!("\"{file}\" is not a plain file name")));
    }
    Ok(file)
}

pub(super) fn sha256<'de, D: Deserializer<'de>>(value: D) -> Result<String, D::Error> {
    let sha256 = name(value)?;
    if sha256.len() != 64 || !sha256.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return Err(D::Error::custom(format!("\"{sha256}\" is not a SHA-256")));
    }
    Ok(sha256.to_ascii_lowercase())
}

/// For a variant without keys of its own: no key is allowed.
pub(super) fn no_keys<'de, D: Deserializer<'de>>(value: D) -> Result<(), D::Error> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Empty {}
    Empty::deserialize(value).map(|Empty {}| ())
}
