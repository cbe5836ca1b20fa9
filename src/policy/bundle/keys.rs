//! The keys of `policy.json`, what to write at each, and the words that may stand there.

use super::read::Key;
use super::spec::{BetaSchedule, ColorOrder, Operation, PredictionType, SchedulerKind, TimestepSpacing};

pub(super) const ROOT: &[Key] = &[
    ("format", "\"rapid-policy/1\""),
    ("name", "what the bundle calls itself, as text"),
    ("mask_aware", "true if it was trained with modalities left out, else false"),
    ("n_obs_steps", "how many observations a chunk is computed from, 1 to 64"),
    ("horizon", "how many actions a chunk has, 1 to 1024"),
    ("n_action_steps", "how many of them are executed before the next chunk, 1 to horizon - action_start"),
    (
        "action_start",
        "the index in a chunk of the action of the last observation's tick: n_obs_steps - 1 (LeRobot) or 0 (UMI)",
    ),
    ("control_hz", "actions a second, 0.1 to 1000"),
    ("max_observation_age_ms", "how old an observation may be, 1 to 60000 ms"),
    ("observations", "a list of what the policy observes, at least one"),
    ("mask", "{\"input\": .., \"order\": [..], \"absent\": \"zero_embedding\"}, or null if it has no mask input"),
    ("action", "an object that says what the policy moves"),
    ("scheduler", "an object that says how the noise is taken out"),
    ("graphs", "{\"encoder\": {\"file\": .., \"sha256\": ..}, \"denoiser\": {..}}"),
    ("training", "an object with whatever is worth knowing about the training; it may be {}"),
];

pub(super) const IMAGE: &[Key] = &[
    ("key", "the name of the encoder's input, as text"),
    ("kind", "\"image\" or \"vector\""),
    ("modality", "the name of the device in devices.toml"),
    ("required", "true if the policy must not run without it, else false"),
    ("shape", "[3, height, width] after resize and crop, sides from 1 to 8192"),
    ("color", "\"rgb\" or \"bgr\""),
    ("resize", "[height, width] that pictures are resized to, or null"),
    ("crop", "[height, width] of the middle that is kept after the resize, or null"),
    ("operation", "\"diff_to_reference\" or null"),
    ("normalization", NORMALIZATION_HELP),
    ("down_sample_steps", "1"),
];

pub(super) const VECTOR: &[Key] = &[
    ("key", "the name of the encoder's input, as text"),
    ("kind", "\"image\" or \"vector\""),
    ("modality", "the name of the device in devices.toml"),
    ("required", "true if the policy must not run without it, else false"),
    ("shape", "[how many numbers, 1 to 4096]"),
    ("slice", "[begin, end] of the sample's numbers, end not included; leave it out for all of them"),
    ("normalization", NORMALIZATION_HELP),
    ("down_sample_steps", "1"),
    ("rotation", "nothing: leave it out"),
];

const NORMALIZATION_HELP: &str =
    "{\"mode\": \"min_max\", \"min\": [..], \"max\": [..]}, or mode \"mean_std\" or \"identity\"";

/// The keys of a normalisation, and of one that says which values of an action it is about.
#[derive(Debug, Clone, Copy)]
pub(super) struct ModeKeys {
    pub(super) alone: &'static [Key],
    pub(super) sliced: &'static [Key],
}

const MODE: Key = ("mode", "\"min_max\", \"mean_std\" or \"identity\"");
const MIN: Key = ("min", "the smallest values, one number per dimension");
const MAX: Key = ("max", "the largest values, one number per dimension, each above its min");
const MEAN: Key = ("mean", "the means, one number per dimension");
const STD: Key = ("std", "the standard deviations, one number per dimension, none below 0, with eps above 0");
const EPS: Key = ("eps", "what is added to each std, from 0 to 1; leave it out for 0");
const SLICE: Key = ("slice", "[begin, end] of the action's values, end not included");

pub(super) const MIN_MAX: ModeKeys = ModeKeys { alone: &[MODE, MIN, MAX], sliced: &[SLICE, MODE, MIN, MAX] };
pub(super) const MEAN_STD: ModeKeys =
    ModeKeys { alone: &[MODE, MEAN, STD, EPS], sliced: &[SLICE, MODE, MEAN, STD, EPS] };
pub(super) const IDENTITY: ModeKeys = ModeKeys { alone: &[MODE], sliced: &[SLICE, MODE] };
/// Where the mode is not known.
pub(super) const ANY_MODE: ModeKeys =
    ModeKeys { alone: &[MODE, MIN, MAX, MEAN, STD, EPS], sliced: &[SLICE, MODE, MIN, MAX, MEAN, STD, EPS] };

pub(super) const MASK: &[Key] = &[
    ("input", "the name of the encoder's mask input"),
    ("order", "the modality of each element of the mask, each once"),
    ("absent", "\"zero_embedding\""),
];

pub(super) const ACTION: &[Key] = &[
    ("actuator", "the name of the device in devices.toml that is moved"),
    ("shape", "[how many values, 1 to 1024]"),
    ("names", "a name for each value of an action"),
    ("units", "the unit of each value of an action, \"1\" for none"),
    ("representation", "\"absolute\""),
    ("limits", "{\"min\": [..], \"max\": [..]}, beyond which no action goes"),
    ("normalization", "a list of {\"slice\": [begin, end], \"mode\": ..} that cover every value once"),
    ("rotation", "nothing: leave it out"),
];

pub(super) const LIMITS: &[Key] = &[
    ("min", "the smallest values that may be executed, one number per dimension"),
    ("max", "the largest values that may be executed, none below its min"),
];

pub(super) const SCHEDULER: &[Key] = &[
    ("type", "\"DDIM\" or \"DDPM\""),
    ("num_train_timesteps", "steps of the forward process, 1 to 10000"),
    ("beta_schedule", "\"squaredcos_cap_v2\", \"linear\" or \"scaled_linear\""),
    ("beta_start", "the first beta, 0.000001 to 0.999"),
    ("beta_end", "the last beta, up to 0.999 and not below beta_start"),
    ("prediction_type", "\"epsilon\", \"sample\" or \"v_prediction\""),
    ("clip_sample", "true or false"),
    ("clip_sample_range", "a number, 0.000001 to 1000"),
    ("set_alpha_to_one", "true or false"),
    ("steps_offset", "a whole number from 0, small enough that no timestep reaches num_train_timesteps"),
    ("timestep_spacing", "\"leading\", \"trailing\" or \"linspace\""),
    ("num_inference_steps", "how many timesteps are visited, 1 to num_train_timesteps"),
];

pub(super) const GRAPHS: &[Key] = &[
    ("encoder", "{\"file\": \"encoder.onnx\", \"sha256\": ..}"),
    ("denoiser", "{\"file\": \"denoiser.onnx\", \"sha256\": ..}"),
];

pub(super) const GRAPH: &[Key] = &[
    ("file", "the name of a file in the bundle's folder, without a path"),
    ("sha256", "the 64 hexadecimal digits that sha256sum prints for the file"),
];

pub(super) const COLORS: [(&str, ColorOrder); 2] = [("rgb", ColorOrder::Rgb), ("bgr", ColorOrder::Bgr)];
pub(super) const OPERATIONS: [(&str, Operation); 1] = [("diff_to_reference", Operation::DiffToReference)];
pub(super) const SCHEDULERS: [(&str, SchedulerKind); 2] =
    [("DDIM", SchedulerKind::Ddim), ("DDPM", SchedulerKind::Ddpm)];
pub(super) const BETAS: [(&str, BetaSchedule); 3] = [
    ("squaredcos_cap_v2", BetaSchedule::SquaredcosCapV2),
    ("linear", BetaSchedule::Linear),
    ("scaled_linear", BetaSchedule::ScaledLinear),
];
pub(super) const PREDICTIONS: [(&str, PredictionType); 3] = [
    ("epsilon", PredictionType::Epsilon),
    ("sample", PredictionType::Sample),
    ("v_prediction", PredictionType::VPrediction),
];
pub(super) const SPACINGS: [(&str, TimestepSpacing); 3] = [
    ("leading", TimestepSpacing::Leading),
    ("trailing", TimestepSpacing::Trailing),
    ("linspace", TimestepSpacing::Linspace),
];

/// What `kind` may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Image,
    Vector,
}
pub(super) const KINDS: [(&str, Kind); 2] = [("image", Kind::Image), ("vector", Kind::Vector)];

/// What `mode` may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mode {
    MinMax,
    MeanStd,
    Identity,
}
pub(super) const MODES: [(&str, Mode); 3] =
    [("min_max", Mode::MinMax), ("mean_std", Mode::MeanStd), ("identity", Mode::Identity)];
