//! The text of `policy.json` to a [`Bundle`].

use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;

use super::action;
use super::json::Strict;
use super::keys::{self, Kind, Mode, ModeKeys};
use super::observations;
use super::read::{Key, Object, Problems};
use super::spec::{Bundle, BundleErrors, GraphFile, MaskSpec, Normalization, SchedulerSpec, TimestepSpacing};

/// What `format` must be.
const FORMAT: &str = "rapid-policy/1";
/// Longest side of a picture, pixels.
pub(super) const MAX_SIDE: usize = 8192;
/// Most numbers of a vector.
pub(super) const MAX_VALUES: usize = 4096;
const MAX_OBS_STEPS: usize = 64;
const MAX_HORIZON: usize = 1024;
const MAX_TIMESTEPS: usize = 10_000;
/// Smaller ones are lost in a 32-bit float's 1 - beta.
const MIN_BETA: f64 = 1e-6;
const MAX_BETA: f64 = 0.999;
const MAX_AGE_MS: usize = 60_000;

/// Reads `text`; `file` is how it is named in messages. The folder and the hash are the caller's.
pub(super) fn parse(text: &str, file: &str) -> Result<Bundle, BundleErrors> {
    let mut problems = Problems::new(file);
    let value = match serde_json::from_str(text) {
        Ok(Strict(value)) => Some(value),
        Err(error) => {
            syntax(text, &error, &mut problems);
            None
        }
    };
    let bundle = value.as_ref().and_then(|value| root(value, &mut problems));
    problems.check()?;
    // Whatever is missing has been reported.
    bundle.ok_or_else(|| {
        let mut problems = Problems::new(file);
        problems.report("", "it cannot be read", "compare it with the format's description");
        problems.check().err().unwrap_or(BundleErrors { diagnostics: Vec::new() })
    })
}

fn syntax(text: &str, error: &serde_json::Error, problems: &mut Problems) {
    let line = text.lines().nth(error.line().saturating_sub(1)).unwrap_or_default();
    let fix = if ["NaN", "Infinity"].iter().any(|word| line.contains(word)) {
        "JSON has no NaN and no Infinity: the statistics it was exported with are not finite, compute them anew"
    } else {
        "mend it, or export the bundle again"
    };
    let message = error.to_string();
    let message = message.split(" at line ").next().unwrap_or_default();
    problems.report_at((error.line(), error.column()), "", &format!("not JSON: {message}"), fix);
}

fn root(value: &Value, problems: &mut Problems) -> Option<Bundle> {
    // Of another format nothing else is known.
    if let Some(format) = value.get("format").filter(|format| *format != FORMAT) {
        let fix = format!("this program reads \"{FORMAT}\": export the bundle for it");
        problems.report("", format!("format is {format}"), fix);
        return None;
    }
    let root = Object::new(String::new(), value, keys::ROOT, problems)?;
    root.value("format", problems);
    let name = root.text("name", problems);
    let mask_aware = root.flag("mask_aware", problems);
    let n_obs_steps = root.integer("n_obs_steps", 1..=MAX_OBS_STEPS, problems);
    let horizon = root.integer("horizon", 1..=MAX_HORIZON, problems);
    let n_action_steps = root.integer("n_action_steps", 1..=MAX_HORIZON, problems);
    let action_start = root.integer("action_start", 0..=MAX_HORIZON - 1, problems);
    if let (Some(horizon), Some(start)) = (horizon, action_start) {
        if start >= horizon {
            root.report("action_start", &format!("= {start} lies beyond the horizon of {horizon}"), problems);
        } else if let Some(steps) = n_action_steps.filter(|steps| *steps > horizon - start) {
            let left =
                format!("= {steps}, but from action_start = {start} to horizon = {horizon} are {}", horizon - start);
            root.report("n_action_steps", &left, problems);
        }
    }
    let control_hz = root.number("control_hz", 0.1..=1000.0, problems);
    let max_age = root.integer("max_observation_age_ms", 1..=MAX_AGE_MS, problems);
    let observations = observations::read(&root, problems);
    let mask = mask(&root, problems);
    if let (Some(observations), Some(mask), Some(mask_aware)) = (&observations, &mask, mask_aware) {
        observations::against_mask(&root, observations, mask.as_ref(), mask_aware, problems);
    }
    let action = action::read(&root, problems);
    let scheduler = root.object("scheduler", keys::SCHEDULER, problems).and_then(|object| scheduler(&object, problems));
    let graphs = root.object("graphs", keys::GRAPHS, problems);
    let encoder = graphs.as_ref().and_then(|graphs| graph(graphs, "encoder", problems));
    let denoiser = graphs.as_ref().and_then(|graphs| graph(graphs, "denoiser", problems));
    let training = root.value("training", problems);
    if training.is_some_and(|training| !training.is_object()) {
        root.report("training", "must be an object", problems);
    }
    Some(Bundle {
        folder: PathBuf::new(),
        inside: false,
        hash: String::new(),
        name: name?,
        mask_aware: mask_aware?,
        n_obs_steps: n_obs_steps?,
        horizon: horizon?,
        n_action_steps: n_action_steps?,
        action_start: action_start?,
        control_hz: control_hz?,
        max_observation_age: Duration::from_millis(max_age? as u64),
        observations: observations?,
        mask: mask?,
        action: action?,
        scheduler: scheduler?,
        encoder: encoder?,
        denoiser: denoiser?,
        training: training?.clone(),
    })
}

#[expect(clippy::option_option, reason = "`None` is a mask that was wrong, `Some(None)` one that is null")]
fn mask(root: &Object, problems: &mut Problems) -> Option<Option<MaskSpec>> {
    let Some(mask) = root.object_or_null("mask", keys::MASK, problems)? else { return Some(None) };
    let input = mask.text("input", problems);
    let order = mask.texts("order", problems);
    mask.word("absent", &[("zero_embedding", ())], problems);
    let order = order?;
    if order.is_empty() {
        mask.report("order", "is empty", problems);
    }
    for (at, modality) in order.iter().enumerate() {
        if order[..at].contains(modality) {
            mask.report("order", &format!("[{at}] names \"{modality}\" a second time"), problems);
        }
    }
    Some(Some(MaskSpec { input: input?, order }))
}

fn scheduler(object: &Object, problems: &mut Problems) -> Option<SchedulerSpec> {
    let kind = object.word("type", &keys::SCHEDULERS, problems);
    let train = object.integer("num_train_timesteps", 1..=MAX_TIMESTEPS, problems);
    let beta_schedule = object.word("beta_schedule", &keys::BETAS, problems);
    let beta_start = object.number("beta_start", MIN_BETA..=MAX_BETA, problems);
    let beta_end = object.number("beta_end", MIN_BETA..=MAX_BETA, problems);
    if let (Some(start), Some(end)) = (beta_start, beta_end)
        && end < start
    {
        object.report("beta_end", &format!("= {end} is below beta_start = {start}"), problems);
    }
    let prediction_type = object.word("prediction_type", &keys::PREDICTIONS, problems);
    let clip_sample = object.flag("clip_sample", problems);
    let clip_sample_range = object.number("clip_sample_range", 1e-6..=1000.0, problems);
    let set_alpha_to_one = object.flag("set_alpha_to_one", problems);
    let offset = object.integer("steps_offset", 0..=MAX_TIMESTEPS, problems);
    let spacing = object.word("timestep_spacing", &keys::SPACINGS, problems);
    let steps = object.integer("num_inference_steps", 1..=MAX_TIMESTEPS, problems);
    if let (Some(train), Some(steps)) = (train, steps) {
        let last = offset.map(|offset| (steps - 1) * (train / steps) + offset);
        if steps > train {
            let message = format!("= {steps} is more than num_train_timesteps = {train}");
            object.report("num_inference_steps", &message, problems);
        } else if let (Some(TimestepSpacing::Leading), Some(last)) = (spacing, last)
            && last >= train
        {
            let message = format!("leads to timestep {last} of {train}");
            object.report("steps_offset", &message, problems);
        }
    }
    #[expect(clippy::cast_possible_truncation, reason = "within the range of an f32")]
    Some(SchedulerSpec {
        kind: kind?,
        num_train_timesteps: train?,
        beta_schedule: beta_schedule?,
        beta_start: beta_start?,
        beta_end: beta_end?,
        prediction_type: prediction_type?,
        clip_sample: clip_sample?,
        clip_sample_range: clip_sample_range? as f32,
        set_alpha_to_one: set_alpha_to_one?,
        steps_offset: offset?,
        timestep_spacing: spacing?,
        num_inference_steps: steps?,
    })
}

fn graph(graphs: &Object, name: &str, problems: &mut Problems) -> Option<GraphFile> {
    let graph = graphs.object(name, keys::GRAPH, problems)?;
    let file = graph.text("file", problems);
    let sha256 = graph.text("sha256", problems);
    if let Some(file) = &file
        && (file.contains(['/', '\\']) || file.starts_with('.'))
    {
        graph.report("file", &format!("= \"{file}\" is no plain file name"), problems);
    }
    if let Some(sha256) = &sha256
        && !(sha256.len() == 64 && sha256.bytes().all(|byte| byte.is_ascii_hexdigit()))
    {
        graph.report("sha256", &format!("= \"{sha256}\" is no SHA-256"), problems);
    }
    Some(GraphFile { file: file?, sha256: sha256?.to_ascii_lowercase() })
}

/// A normalisation of `len` dimensions; `sliced` has the key `slice` besides. Of one that is wrong
/// `None`, and it is reported.
pub(super) fn normalization(
    entry: String,
    value: &Value,
    len: Option<usize>,
    sliced: bool,
    problems: &mut Problems,
) -> Option<Normalization> {
    let mode_of = |value: &Value| {
        let word = value.get("mode")?.as_str()?;
        keys::MODES.iter().find(|(mode, _)| *mode == word).map(|(_, mode)| *mode)
    };
    let known = mode_of(value).map_or(keys::ANY_MODE, |mode| match mode {
        Mode::MinMax => keys::MIN_MAX,
        Mode::MeanStd => keys::MEAN_STD,
        Mode::Identity => keys::IDENTITY,
    });
    let object = Object::new(entry, value, keys_of(known, sliced), problems)?;
    match object.word("mode", &keys::MODES, problems)? {
        Mode::MinMax => min_max(&object, len, problems),
        Mode::MeanStd => mean_std(&object, len, problems),
        Mode::Identity => Some(Normalization::Identity),
    }
}

const fn keys_of(mode: ModeKeys, sliced: bool) -> &'static [Key] {
    if sliced { mode.sliced } else { mode.alone }
}

fn min_max(object: &Object, len: Option<usize>, problems: &mut Problems) -> Option<Normalization> {
    let min = object.numbers("min", len, problems);
    let max = object.numbers("max", len, problems);
    let (min, max) = (min?, max?);
    for (at, (min, max)) in min.iter().zip(&max).enumerate() {
        if max <= min {
            object.report("max", &format!("[{at}] = {max} is not above min[{at}] = {min}"), problems);
        } else if !(max - min).is_finite() {
            object.report("max", &format!("[{at}] is too far from min[{at}] for a 32-bit float"), problems);
        }
    }
    Some(Normalization::MinMax { min, max })
}

fn mean_std(object: &Object, len: Option<usize>, problems: &mut Problems) -> Option<Normalization> {
    let mean = object.numbers("mean", len, problems);
    let std = object.numbers("std", len, problems);
    let eps = if object.has("eps") { object.number("eps", 0.0..=1.0, problems) } else { Some(0.0) };
    #[expect(clippy::cast_possible_truncation, reason = "from 0 to 1")]
    let (mean, std, eps) = (mean?, std?, eps? as f32);
    for (at, std) in std.iter().enumerate() {
        if *std < 0.0 {
            object.report("std", &format!("[{at}] = {std} is below 0"), problems);
        } else if std + eps <= 0.0 {
            object.report("std", &format!("[{at}] and eps are both 0: nothing can be divided by that"), problems);
        }
    }
    Some(Normalization::MeanStd { mean, std, eps })
}

/// Which `kind` of observation an object says it is.
pub(super) fn kind_of(value: &Value) -> Option<Kind> {
    let word = value.get("kind")?.as_str()?;
    keys::KINDS.iter().find(|(kind, _)| *kind == word).map(|(_, kind)| *kind)
}
