//! The contents of `policy.json`, checked.
//!
//! Invariant: every number is finite and within the range its comment states; every length agrees
//! with every other.

use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

use rapid_registry::Diagnostic;
use rapid_status::EventKind;
use serde::{Deserialize, Serialize};

use super::values;

/// A checked bundle.
#[derive(Debug, Clone, PartialEq)]
pub struct Bundle {
    /// The folder it was read from; for the bundle inside the program, a label.
    pub folder: PathBuf,
    /// It is the bundle included in the program.
    pub inside: bool,
    /// SHA-256 over the bytes of `policy.json` and the hashes of both graphs as stated in it, encoder first; lower-case
    /// hexadecimal. Identifies in a recording the policy that ran.
    pub hash: String,
    /// `name` given in the bundle.
    pub name: String,
    /// `mask_aware`: trained with modalities left out, so that it can run without one. A policy that was not gains
    /// nothing from zeros in place of a missing modality.
    pub mask_aware: bool,
    /// `n_obs_steps`, To: observations from which a chunk is computed, `1..=64`. Step i of To is tick
    /// k - (To - 1 - i) * N of the control grid, N the `down_sample_steps` of the observation. An observation with a
    /// history has another number of steps: see [`Self::steps_of`].
    pub n_obs_steps: usize,
    /// `horizon`, Tp: actions in a chunk, `1..=1024`.
    pub horizon: usize,
    /// `n_action_steps`: actions executed before the next chunk is requested, `1..=horizon - action_start`.
    pub n_action_steps: usize,
    /// `action_start`: the index in a chunk of the action of the tick of its last observation, below
    /// `horizon`. To - 1 in the original diffusion policy and in `LeRobot`, 0 in UMI.
    pub action_start: usize,
    /// `control_hz`: ticks of the control grid per second, `0.1..=1000`.
    pub control_hz: f64,
    /// `max_observation_age_ms`: no chunk is computed from an observation older than this.
    pub max_observation_age: Duration,
    /// `observations`: at least one, keys unique, in the order of the file.
    pub observations: Vec<ObservationSpec>,
    /// `mask`: the encoder's mask input. `None` only if the bundle is not mask-aware.
    pub mask: Option<MaskSpec>,
    /// `action`.
    pub action: BundleAction,
    /// `scheduler`.
    pub scheduler: SchedulerSpec,
    /// `graphs.encoder`.
    pub encoder: GraphFile,
    /// `graphs.denoiser`.
    pub denoiser: GraphFile,
    /// `training`: the origin of the bundle, in free form.
    pub training: serde_json::Value,
}

impl Bundle {
    /// With the last samples of every modality that it does not require held for `time`, if given, while that is absent.
    /// A history has nothing held in it.
    #[must_use]
    pub fn holding_last(mut self, time: Option<Duration>) -> Self {
        let Some(time) = time else { return self };
        let may_hold = |observation: &&mut ObservationSpec| !observation.required && observation.history.is_none();
        for observation in self.observations.iter_mut().filter(may_hold) {
            observation.when_absent = WhenAbsent::HoldLast(time);
        }
        self
    }

    /// The number of steps of one of its observations.
    pub fn steps_of(&self, observation: &ObservationSpec) -> usize {
        observation.history.as_ref().map_or(self.n_obs_steps, |history| history.steps)
    }

    /// The modalities whose last samples are held while they are absent, and for how long.
    pub fn held(&self) -> impl Iterator<Item = (&str, Duration)> {
        self.observations.iter().filter_map(|observation| match observation.when_absent {
            WhenAbsent::HoldLast(time) => Some((observation.modality.as_str(), time)),
            WhenAbsent::Zero => None,
        })
    }

    /// The first and the last seed of the demonstrations that it was trained on, as far as `training` has them
    /// (`episode_seeds`). Some between them may not have been used.
    pub fn training_seeds(&self) -> Option<[u64; 2]> {
        let seeds = self.training.get("episode_seeds")?.as_array()?;
        let [begin, end] = seeds.as_slice() else { return None };
        Some([begin.as_u64()?, end.as_u64()?])
    }

    /// The event that announces its start, on the onnxruntime named `library`.
    pub fn begins(&self, library: String, dry_run: bool) -> EventKind {
        EventKind::Policy {
            policy: self.name.clone(),
            folder: self.folder.clone(),
            hash: self.hash.clone(),
            library,
            hz: self.control_hz,
            dry_run,
        }
    }
}

/// One of `observations`.
#[derive(Debug, Clone, PartialEq)]
pub struct ObservationSpec {
    /// `key`: the name of the encoder's input.
    pub key: String,
    /// `modality`: the name of the entry in `devices.toml`.
    pub modality: String,
    /// `required`: without this modality the policy does not start, and holds when it disappears.
    pub required: bool,
    /// `when_absent`: what stands in for it while its modality is absent.
    pub when_absent: WhenAbsent,
    /// `down_sample_steps`, N: ticks of the control grid between two of its steps, `1..=64`.
    pub down_sample_steps: usize,
    /// `history`: of pictures only. Then it is neither required nor held, and its span, from its first step to its last,
    /// is at most 600 ticks.
    pub history: Option<HistorySpec>,
    /// `kind` and its settings.
    pub input: ObservationInput,
    /// `normalization`, one entry per channel of a picture or per value of a vector.
    pub normalization: Normalization,
}

/// Most ticks from the first to the last step of a history. As many samples of its modality are kept.
pub(super) const MAX_SPAN: usize = 600;

/// `history`: an observation with steps of its own number, each with or without a sample. Nothing stands in for one
/// that has none, and it is given whether or not its modality is present now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HistorySpec {
    /// `steps`, S: `2..=64`.
    pub steps: usize,
    /// `valid`: the name of the encoder's input f32 `[B, S]`, 1 for a step with a sample and 0 for one without. No other
    /// input has it.
    pub valid: String,
}

/// What stands in for an observation whose modality is absent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum WhenAbsent {
    /// Zeros, and 0 in the mask (the paper's rule).
    #[default]
    Zero,
    /// For this long the last samples before it left, and 1 in the mask; then zeros.
    HoldLast(Duration),
}

/// The kind of samples in an observation, and their processing.
#[derive(Debug, Clone, PartialEq)]
pub enum ObservationInput {
    /// `"image"`: f32 `[B, To, 3, height, width]`.
    Image(ImageSpec),
    /// `"vector"`: f32 `[B, To, len]`.
    Vector(VectorSpec),
}

/// The conversion of a picture to an observation: decoded to 8 bits in the order of `color`, divided by 255, resized,
/// cropped, `operation`, normalised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSpec {
    /// `shape`: pixels after all these steps, `1..=8192`. There are always 3 channels.
    pub height: usize,
    /// See `height`.
    pub width: usize,
    /// `color`.
    pub color: ColorOrder,
    /// `resize`: [height, width] to resize to, bilinear with half-pixel centres and no antialiasing.
    /// `None` leaves the device's size.
    pub resize: Option<[usize; 2]>,
    /// `crop`: [height, width] of the centre to keep, after the resize. `None` keeps all.
    pub crop: Option<[usize; 2]>,
    /// `operation`.
    pub operation: Option<Operation>,
}

/// The conversion of a sample's numbers to an observation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VectorSpec {
    /// `shape`: the number of values, `1..=4096`.
    pub len: usize,
    /// `slice`: which numbers of the sample are used, `len` of them. `None` uses all, and the sample has `len`.
    pub slice: Option<Range<usize>>,
    /// `rotation`: `None` uses them as they are. Otherwise `slice` has the 4 values of a quaternion, and `len` is 6.
    pub rotation: Option<VectorRotation>,
    /// `operation`, before the rotation.
    pub operation: Option<VectorOperation>,
}

/// Which sample the numbers of a vector are of, where it is not that of the step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VectorOperation {
    /// The first one of that modality in the run or episode, kept across unplugs: where a movement began.
    FirstOfRun,
}

/// What a vector is made of that is a rotation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VectorRotation {
    /// The first two rows of its matrix.
    #[serde(rename = "rotation_6d")]
    Rotation6d,
}

/// Order of the channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorOrder {
    /// Red first.
    Rgb,
    /// Blue first, as `OpenCV` loads pictures.
    Bgr,
}

/// An operation on a picture before it is normalised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Operation {
    /// `(v - ref) / 2 + 0.5`, with v and ref in 0..1; ref is the first picture of that modality in
    /// the run or episode, kept across unplugs.
    DiffToReference,
}

/// How numbers are mapped to the range a network was trained on, one entry per dimension.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Normalization {
    /// `(v - min) / (max - min) * 2 - 1`.
    MinMax {
        /// Smallest values.
        #[serde(deserialize_with = "values::numbers")]
        min: Vec<f32>,
        /// Largest values, each above the smallest.
        #[serde(deserialize_with = "values::numbers")]
        max: Vec<f32>,
    },
    /// `(v - mean) / (std + eps)`.
    MeanStd {
        /// Means.
        #[serde(deserialize_with = "values::numbers")]
        mean: Vec<f32>,
        /// Standard deviations, at least 0; with `eps` added above 0.
        #[serde(deserialize_with = "values::numbers")]
        std: Vec<f32>,
        /// At least 0; 0 if the file gives none.
        #[serde(default)]
        eps: f32,
    },
    /// `v`.
    #[serde(deserialize_with = "values::no_keys")]
    Identity,
}

/// `mask`: the encoder's mask input, f32 `[B, M]`, 1.0 for a present modality. The encoder itself handles absent
/// modalities: it replaces their embeddings by zeros.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MaskSpec {
    /// `input`: the name of the encoder's input.
    pub input: String,
    /// `order`: the modality of each element, each once and each belonging to an observation.
    pub order: Vec<String>,
}

/// `action`: the meaning of the denoiser's output after denormalisation, and what is executed.
///
/// The network's output for an action has Da values: with a pose its position (3), its rotation (0, 4 or 6) and the rest,
/// such as a gripper's opening. What is executed is absolute: position, quaternion `x y z w` if there is a rotation, the
/// rest as it is.
#[derive(Debug, Clone, PartialEq)]
pub struct BundleAction {
    /// `actuator`: the name of the actuator's entry in `devices.toml`.
    pub actuator: String,
    /// `representation`: what the poses of the output are relative to.
    pub representation: Representation,
    /// `rotation`: how the output has the rotation of a pose. `None`: it has none.
    pub rotation: Option<ActionRotation>,
    /// `names` of the executed values.
    pub names: Vec<String>,
    /// `units` of the executed values, one for each.
    pub units: Vec<String>,
    /// `limits.min`: no value below is executed, one for each.
    pub min: Vec<f32>,
    /// `limits.max`: no value above is executed, one for each, none below its `min`.
    pub max: Vec<f32>,
    /// `normalization` of the output: ascending slices that cover every value exactly once.
    pub normalization: Vec<SliceNormalization>,
}

impl BundleAction {
    /// Number of values of an executed action.
    pub fn len(&self) -> usize {
        self.names.len()
    }

    /// Never true for a checked bundle.
    pub fn is_empty(&self) -> bool {
        self.names.is_empty()
    }

    /// Number of values of an action in the network's output, Da. `shape` is `[Da]`, `1..=1024`.
    pub fn outputs(&self) -> usize {
        self.len() + self.rotation.map_or(0, ActionRotation::numbers) - self.rotation.map_or(0, |_| QUATERNION)
    }
}

/// Values of a position.
pub(crate) const POSITION: usize = 3;
/// Values of a quaternion.
pub(crate) const QUATERNION: usize = 4;

/// What the poses of the network's output are relative to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Representation {
    /// Nothing: they are targets. Without a rotation an action need not be a pose.
    Absolute,
    /// The pose at the tick of the newest observation, T0: the target is T0 A. Without a rotation it is p0 + d.
    Relative(BasePose),
    /// The target before: p + d, and D R. Of the action of the newest observation's tick that is T0.
    Delta(BasePose),
}

impl Representation {
    /// Where T0 is; `None` if the output is absolute.
    pub const fn base(&self) -> Option<&BasePose> {
        match self {
            Self::Absolute => None,
            Self::Relative(base) | Self::Delta(base) => Some(base),
        }
    }

    /// Its name in the file.
    pub const fn word(&self) -> &'static str {
        match self {
            Self::Absolute => "absolute",
            Self::Relative(_) => "relative",
            Self::Delta(_) => "delta",
        }
    }
}

/// How the network's output has a rotation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionRotation {
    /// The first two rows of its matrix: 6 values.
    #[serde(rename = "rotation_6d")]
    Rotation6d,
    /// `x y z w`: 4 values.
    Quaternion,
}

impl ActionRotation {
    /// Number of its values.
    pub const fn numbers(self) -> usize {
        match self {
            Self::Rotation6d => 6,
            Self::Quaternion => QUATERNION,
        }
    }

    /// Its name in the file.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Rotation6d => "rotation_6d",
            Self::Quaternion => "quaternion",
        }
    }
}

/// `action.base`: where the pose T0 is that actions are relative to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BasePose {
    /// `modality`: whose samples have it. A required vector observation has this modality.
    pub modality: String,
    /// The index of the first such observation.
    pub observation: usize,
    /// `position`: which numbers of a sample are x, y and z, 3 of them.
    pub position: Range<usize>,
    /// `rotation`: which are its quaternion `x y z w`, 4 of them; `None` if the action has no rotation.
    pub rotation: Option<Range<usize>>,
}

/// The normalisation of some values of an action.
#[derive(Debug, Clone, PartialEq)]
pub struct SliceNormalization {
    /// `slice`: which values.
    pub slice: Range<usize>,
    /// `mode` and its arrays, as long as the slice.
    pub normalization: Normalization,
}

/// `scheduler`: the diffusion process with which the denoiser was trained, in the terms of the `diffusers` library, and
/// how it is reversed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SchedulerSpec {
    /// `type`.
    #[serde(rename = "type", deserialize_with = "values::word")]
    pub kind: SchedulerKind,
    /// Steps of the forward process, `1..=10000`.
    #[serde(deserialize_with = "values::whole::<_, 1, 10_000>")]
    pub num_train_timesteps: usize,
    /// How the noise grows.
    #[serde(deserialize_with = "values::word")]
    pub beta_schedule: BetaSchedule,
    /// First beta, `1e-6..=0.999`; not used by `squaredcos_cap_v2`.
    pub beta_start: f64,
    /// Last beta, in the same range and not below the first; not used by `squaredcos_cap_v2`.
    pub beta_end: f64,
    /// What the denoiser predicts.
    #[serde(deserialize_with = "values::word")]
    pub prediction_type: PredictionType,
    /// Whether the predicted clean sample is clipped.
    pub clip_sample: bool,
    /// Clipped to plus and minus this, above 0.
    pub clip_sample_range: f32,
    /// DDIM: whether the last step's alpha is 1 rather than that of timestep 0.
    pub set_alpha_to_one: bool,
    /// Added to every timestep with `leading` spacing.
    #[serde(deserialize_with = "values::whole::<_, 0, 10_000>")]
    pub steps_offset: usize,
    /// How the timesteps are spaced.
    #[serde(deserialize_with = "values::word")]
    pub timestep_spacing: TimestepSpacing,
    /// Number of denoising steps, `1..=num_train_timesteps`.
    #[serde(deserialize_with = "values::whole::<_, 1, 10_000>")]
    pub num_inference_steps: usize,
}

/// How a sample is computed from one timestep to the previous one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum SchedulerKind {
    /// Deterministic (Song et al., "Denoising Diffusion Implicit Models", eta = 0).
    #[serde(rename = "DDIM")]
    Ddim,
    /// With fresh noise at each step (Ho et al., "Denoising Diffusion Probabilistic Models"), of the
    /// variance `diffusers` calls `fixed_small`.
    #[serde(rename = "DDPM")]
    Ddpm,
}

/// How the noise of the forward process grows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BetaSchedule {
    /// Cosine (Nichol and Dhariwal), betas capped at 0.999.
    #[serde(rename = "squaredcos_cap_v2")]
    SquaredcosCapV2,
    /// Betas evenly spaced.
    Linear,
    /// Their square roots evenly spaced.
    ScaledLinear,
}

/// What a denoiser predicts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PredictionType {
    /// The noise.
    Epsilon,
    /// The clean sample.
    Sample,
    /// The velocity (Salimans and Ho).
    VPrediction,
}

/// Spacing of the timesteps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimestepSpacing {
    /// From 0 upwards in strides of the integer T / n.
    Leading,
    /// From the last downwards in strides of T / n.
    Trailing,
    /// From the first to the last.
    Linspace,
}

/// One of `graphs`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GraphFile {
    /// `file`: its name in the bundle's folder.
    #[serde(deserialize_with = "values::file_name")]
    pub file: String,
    /// `sha256` of its bytes, lower-case hexadecimal.
    #[serde(deserialize_with = "values::sha256")]
    pub sha256: String,
}

/// All errors of a bundle. Never empty.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}", self.diagnostics.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
pub struct BundleErrors {
    /// The problems; the `entry` of each is the key in `policy.json`: `action.limits.min[2]`.
    pub diagnostics: Vec<Diagnostic>,
}
