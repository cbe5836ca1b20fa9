//! Converts the text of `policy.json` to a [`Bundle`], and checks what types cannot express, such as matching lengths.

use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use rapid_registry::did_you_mean;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::action::check_action;
use super::file::{Graphs, Head, HistoryFile, ImageFile, MaskFile, ObservationFile, VectorFile};
use super::normalization::normalization;
use super::read::{Problems, Strict, read, read_tagged};
use super::spec::{
    Bundle, BundleErrors, HistorySpec, ImageSpec, MAX_SPAN, MaskSpec, ObservationInput, ObservationSpec, QUATERNION,
    SchedulerSpec, TimestepSpacing, VectorSpec, WhenAbsent,
};
use super::values::Whole;

/// What `format` must be.
const FORMAT: &str = "rapid-policy/1";
/// Channels of every picture.
const CHANNELS: usize = 3;
/// Values of a rotation as an observation, the first two rows of its matrix.
const SIX: usize = 6;
/// Fixes for an observation that is a rotation.
const ROTATION_SHAPE: &str = "write \"shape\": [6], the first two rows of the matrix, or leave rotation out";
const ROTATION_SLICE: &str = "write \"slice\": [begin, end] of the sample's quaternion x y z w, or leave rotation out";
/// Smaller ones are lost in the 1 - beta of a 32-bit float.
const BETAS: RangeInclusive<f64> = 1e-6..=0.999;

/// Parses `text`; messages name it `file`. The caller sets the folder and the hash.
pub(super) fn parse(text: &str, file: &str) -> Result<Bundle, BundleErrors> {
    let mut problems = Problems::new(file);
    let bundle = match serde_json::from_str(text) {
        Ok(Strict(value)) => root(&value, &mut problems),
        Err(error) => {
            report_syntax(text, &error, &mut problems);
            None
        }
    };
    if bundle.is_none() {
        // The cause of a missing part has been reported; if it has not, this is the report.
        problems.report_first("cannot be read", "compare it with the description of the format");
    }
    problems.check()?;
    bundle.ok_or(BundleErrors { diagnostics: Vec::new() })
}

fn report_syntax(text: &str, error: &serde_json::Error, problems: &mut Problems) {
    let line = text.lines().nth(error.line().saturating_sub(1)).unwrap_or_default();
    let fix = if ["NaN", "Infinity"].iter().any(|word| line.contains(word)) {
        "JSON has no NaN and no Infinity: the statistics it was exported with are not finite, compute them again"
    } else {
        "correct it, or export the bundle again"
    };
    let message = error.to_string();
    let message = message.split(" at line ").next().unwrap_or_default();
    problems.report_at((error.line(), error.column()), "", &format!("not JSON: {message}"), fix);
}

fn root(value: &Value, problems: &mut Problems) -> Option<Bundle> {
    // Nothing is known about other formats.
    if let Some(format) = value.get("format").filter(|format| *format != FORMAT) {
        let fix = format!("this program reads \"{FORMAT}\": export the bundle for it");
        problems.report("format", format!("is {format}"), fix);
        return None;
    }
    let head: Option<Head> = read("", value, problems);
    if let Some(head) = &head {
        check_head(head, problems);
    }
    let observations = value.get("observations").and_then(|value| observations(value, problems));
    let mask = match value.get("mask")? {
        Value::Null => Some(None),
        value => read("mask", value, problems).map(|mask| Some(check_mask(mask, problems))),
    };
    if let (Some(observations), Some(mask), Some(head)) = (&observations, &mask, &head) {
        check_mask_fits(observations, mask.as_ref(), head.mask_aware, problems);
    }
    let action = section(value, "action", problems);
    let action = action.and_then(|action| check_action(action, observations.as_deref(), problems));
    let scheduler = section(value, "scheduler", problems);
    if let Some(scheduler) = &scheduler {
        check_scheduler(scheduler, problems);
    }
    let graphs = section(value, "graphs", problems);
    let graphs = graphs.map(|Graphs { encoder, denoiser }| {
        (read("graphs.encoder", &encoder, problems), read("graphs.denoiser", &denoiser, problems))
    });
    let (head, (encoder, denoiser)) = (head?, graphs?);
    Some(Bundle {
        folder: PathBuf::new(),
        inside: false,
        hash: String::new(),
        name: head.name,
        mask_aware: head.mask_aware,
        n_obs_steps: head.n_obs_steps.get(),
        horizon: head.horizon.get(),
        n_action_steps: head.n_action_steps.get(),
        action_start: head.action_start.get(),
        control_hz: head.control_hz,
        max_observation_age: Duration::from_millis(head.max_observation_age_ms.get() as u64),
        observations: observations?,
        mask: mask?,
        action: action?,
        scheduler: scheduler?,
        encoder: encoder?,
        denoiser: denoiser?,
        training: Value::Object(head.training),
    })
}

fn section<T: DeserializeOwned>(root: &Value, name: &str, problems: &mut Problems) -> Option<T> {
    read(name, root.get(name)?, problems)
}

fn check_range(entry: &str, number: f64, range: &RangeInclusive<f64>, problems: &mut Problems) {
    if !range.contains(&number) {
        problems.wrong(entry, format!("{number} is not between {} and {}", range.start(), range.end()));
    }
}

fn check_head(head: &Head, problems: &mut Problems) {
    let (horizon, start, steps) = (head.horizon.get(), head.action_start.get(), head.n_action_steps.get());
    match horizon.checked_sub(start) {
        None | Some(0) => problems.wrong("action_start", format!("{start} lies beyond the horizon of {horizon}")),
        Some(left) if steps > left => {
            let message = format!("is {steps}, but from action_start = {start} to horizon = {horizon} are {left}");
            problems.wrong("n_action_steps", message);
        }
        Some(_) => {}
    }
    check_range("control_hz", head.control_hz, &(0.1..=1000.0), problems);
}

fn observations(value: &Value, problems: &mut Problems) -> Option<Vec<ObservationSpec>> {
    let list = value.as_array()?;
    if list.is_empty() {
        problems.wrong("observations", "is empty");
    }
    let mut found: Vec<ObservationSpec> = Vec::with_capacity(list.len());
    for (at, value) in list.iter().enumerate() {
        let entry = format!("observations[{at}]");
        let Some(observation) = observation(&entry, value, problems) else { continue };
        if found.iter().any(|earlier| earlier.key == observation.key) {
            let fix = "give each observation a key of its own, as the encoder's inputs have";
            problems.report(
                &format!("{entry}.key"),
                format!("another observation has the key \"{}\"", observation.key),
                fix,
            );
        }
        found.push(observation);
    }
    if found.len() < list.len() {
        return None;
    }
    check_valid_names(&found, problems);
    Some(found)
}

/// The input that says which steps of a history have a sample must not be another one, too.
fn check_valid_names(observations: &[ObservationSpec], problems: &mut Problems) {
    let named = |at: usize| observations.get(at).and_then(|one| one.history.as_ref()).map(|history| &history.valid);
    for at in 0..observations.len() {
        let Some(valid) = named(at) else { continue };
        let key = observations.iter().position(|one| one.key == *valid);
        let key = key.map(|key| format!("the key of observations[{key}]"));
        let earlier = (0..at).find(|earlier| named(*earlier) == Some(valid));
        let earlier = earlier.map(|earlier| format!("history.valid of observations[{earlier}]"));
        if let Some(other) = key.or(earlier) {
            let fix = "give it a name of its own, as the encoder's inputs have";
            problems.report(&format!("observations[{at}].history.valid"), format!("\"{valid}\" is {other}"), fix);
        }
    }
}

fn observation(entry: &str, value: &Value, problems: &mut Problems) -> Option<ObservationSpec> {
    let read = read_tagged(entry, "kind", value, problems)?;
    let mut history = None;
    let (key, modality, required, when_absent, steps, numbers, len, input) = match read {
        ObservationFile::Image(file) => {
            let input = ObservationInput::Image(check_image(entry, &file, problems));
            if let Some(value) = &file.history {
                history = Some(check_history(entry, value, &file, problems));
            }
            let (when_absent, steps) = (file.when_absent, file.down_sample_steps);
            (file.key, file.modality, file.required, when_absent, steps, file.normalization, CHANNELS, input)
        }
        ObservationFile::Vector(file) => {
            let vector = check_vector(entry, &file, problems);
            let len = vector.len;
            let input = ObservationInput::Vector(vector);
            let (when_absent, steps) = (file.when_absent, file.down_sample_steps);
            (file.key, file.modality, file.required, when_absent, steps, file.normalization, len, input)
        }
    };
    let (when_absent, down_sample_steps) = (when_absent.unwrap_or_default(), steps.map_or(1, Whole::get));
    let normalization = normalization(&format!("{entry}.normalization"), &numbers, Some(len), problems)?;
    if required && history.is_none() && when_absent != WhenAbsent::Zero {
        let fix = "leave it out: without what it requires the policy holds";
        problems.report(&format!("{entry}.when_absent"), "the observation is required", fix);
    }
    let history = match history {
        Some(history) => Some(history?),
        None => None,
    };
    Some(ObservationSpec { key, modality, required, when_absent, down_sample_steps, history, input, normalization })
}

/// What an observation with a history must be besides. `None` only if the history itself cannot be read.
fn check_history(entry: &str, value: &Value, file: &ImageFile, problems: &mut Problems) -> Option<HistorySpec> {
    let HistoryFile { steps, valid } = read(&format!("{entry}.history"), value, problems)?;
    let (steps, apart) = (steps.get(), file.down_sample_steps.map_or(1, Whole::get));
    let span = (steps - 1) * apart;
    if span > MAX_SPAN {
        let plural = if apart == 1 { "" } else { "s" };
        let message = format!("{steps} steps of {apart} tick{plural} are a span of {span} ticks, more than {MAX_SPAN}");
        let fix = format!("take fewer steps, or a smaller down_sample_steps: (steps - 1) x it is at most {MAX_SPAN}");
        problems.report(&format!("{entry}.history.steps"), message, fix);
    }
    if file.required {
        let fix = "write \"required\": false here; another observation of the modality may be required";
        problems.report(
            &format!("{entry}.required"),
            "an observation with a history is given without its modality too",
            fix,
        );
    }
    if file.when_absent.is_some() {
        let fix = "leave it out: a step of a history without a sample is zeros, and nothing is held in it";
        problems.report(&format!("{entry}.when_absent"), "the observation has a history", fix);
    }
    Some(HistorySpec { steps, valid })
}

fn check_image(entry: &str, file: &ImageFile, problems: &mut Problems) -> ImageSpec {
    let [channels, height, width] = file.shape.map(Whole::get);
    let (shape, show) =
        (format!("[{channels}, {height}, {width}]"), |[height, width]: [usize; 2]| format!("[{height}, {width}]"));
    if channels != CHANNELS {
        problems.wrong(&format!("{entry}.shape"), format!("is {shape}, but pictures have {CHANNELS} channels"));
    }
    if let (Some(resize), Some(crop)) = (file.resize, file.crop)
        && (crop[0] > resize[0] || crop[1] > resize[1])
    {
        problems.wrong(&format!("{entry}.crop"), format!("{} is larger than resize = {}", show(crop), show(resize)));
    }
    if let Some((step, size)) = file.crop.map(|size| ("crop", size)).or(file.resize.map(|size| ("resize", size)))
        && size != [height, width]
    {
        problems.wrong(&format!("{entry}.shape"), format!("is {shape}, but {step} leaves {}", show(size)));
    }
    ImageSpec { height, width, color: file.color, resize: file.resize, crop: file.crop, operation: file.operation }
}

fn check_vector(entry: &str, file: &VectorFile, problems: &mut Problems) -> VectorSpec {
    let len = file.shape[0].get();
    if file.rotation.is_some() {
        if len != SIX {
            problems.report(
                &format!("{entry}.shape"),
                format!("is [{len}], but a rotation has {SIX} values"),
                ROTATION_SHAPE,
            );
        }
        let named = file.slice.as_ref().map_or(0, ExactSizeIterator::len);
        if named != QUATERNION {
            let message = if named == 0 {
                "is missing".to_owned()
            } else {
                format!("names {named} values, but a quaternion has {QUATERNION}")
            };
            problems.report(&format!("{entry}.slice"), message, ROTATION_SLICE);
        }
    } else if let Some(slice) = file.slice.as_ref().filter(|slice| slice.len() != len) {
        let message = format!("[{}, {}] holds {} values, shape has {len}", slice.start, slice.end, slice.len());
        problems.wrong(&format!("{entry}.slice"), message);
    }
    VectorSpec { len, slice: file.slice.clone(), rotation: file.rotation, operation: file.operation }
}

fn check_mask(mask: MaskFile, problems: &mut Problems) -> MaskSpec {
    if mask.order.is_empty() {
        problems.wrong("mask.order", "is empty");
    }
    for (at, modality) in mask.order.iter().enumerate() {
        if mask.order.iter().take(at).any(|earlier| earlier == modality) {
            problems.wrong(&format!("mask.order[{at}]"), format!("names \"{modality}\" a second time"));
        }
    }
    MaskSpec { input: mask.input, order: mask.order }
}

/// The mask must cover the observed modalities.
fn check_mask_fits(
    observations: &[ObservationSpec],
    mask: Option<&MaskSpec>,
    mask_aware: bool,
    problems: &mut Problems,
) {
    let histories = || observations.iter().enumerate().filter_map(|(at, one)| Some((at, one.history.as_ref()?)));
    for (at, _) in histories().filter(|_| !mask_aware) {
        let message = "a history is of a policy that was trained with modalities left out, but mask_aware is false";
        let fix = "write \"mask_aware\": true and its mask if it was, or leave history out";
        problems.report(&format!("observations[{at}].history"), message, fix);
    }
    let Some(mask) = mask else {
        if mask_aware {
            problems.wrong("mask", "is null, but the bundle is mask_aware");
        }
        return;
    };
    if observations.is_empty() {
        return;
    }
    let known: Vec<&str> = observations.iter().map(|observation| observation.modality.as_str()).collect();
    for (at, modality) in mask.order.iter().enumerate().filter(|(_, modality)| !known.contains(&modality.as_str())) {
        let fix = did_you_mean(modality, &known, "the modalities here are");
        problems.report(&format!("mask.order[{at}]"), format!("names \"{modality}\", which no observation has"), fix);
    }
    for (at, history) in histories().filter(|(_, history)| history.valid == mask.input) {
        problems.wrong("mask.input", format!("\"{}\" is history.valid of observations[{at}]", history.valid));
    }
    for (at, observation) in observations.iter().enumerate() {
        if observation.key == mask.input {
            problems.wrong("mask.input", format!("\"{}\" is the key of observations[{at}]", mask.input));
        }
        // An encoder knows by the last step of a history that its modality is absent.
        let may_be_absent = !observation.required && observation.history.is_none();
        if mask_aware && may_be_absent && !mask.order.contains(&observation.modality) {
            let message = format!("\"{}\" is not required, but mask.order does not have it", observation.modality);
            let fix = "write \"required\": true, or name it in mask.order if the encoder knows when it is absent";
            problems.report(&format!("observations[{at}]"), message, fix);
        }
    }
}

fn check_scheduler(scheduler: &SchedulerSpec, problems: &mut Problems) {
    let (start, end) = (scheduler.beta_start, scheduler.beta_end);
    check_range("scheduler.beta_start", start, &BETAS, problems);
    check_range("scheduler.beta_end", end, &BETAS, problems);
    if BETAS.contains(&start) && BETAS.contains(&end) && end < start {
        problems.wrong("scheduler.beta_end", format!("{end} is below beta_start = {start}"));
    }
    let range = scheduler.clip_sample_range;
    if !(1e-6..=1000.0).contains(&range) {
        problems.wrong("scheduler.clip_sample_range", format!("{range} is not between 0.000001 and 1000"));
    }
    let (train, steps) = (scheduler.num_train_timesteps, scheduler.num_inference_steps);
    let last = (steps - 1) * (train / steps) + scheduler.steps_offset;
    if steps > train {
        let message = format!("{steps} is more than num_train_timesteps = {train}");
        problems.wrong("scheduler.num_inference_steps", message);
    } else if scheduler.timestep_spacing == TimestepSpacing::Leading && last >= train {
        problems.wrong("scheduler.steps_offset", format!("leads to timestep {last} of {train}"));
    }
}
