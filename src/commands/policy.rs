//! `rapid policy`: what a policy observes and does, whether it suits the rig, how long a chunk takes on this machine; and what a
//! recorded chunk was computed from.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rapid_core::text;
use rapid_policy::bundle::{
    ActionRotation, Bundle, BundleAction, BundleErrors, ObservationInput, ObservationSpec, Representation,
    VectorOperation, VectorRotation, VectorSpec, WhenAbsent,
};
use rapid_policy::model::Model;
use rapid_policy::onnxruntime::{Environment, LibraryError};
use rapid_policy::pace::{PaceReport, PaceVerdict};
use rapid_policy::sampler::{Computing, PolicyError};
use rapid_registry::{InferenceSpec, Registry};
use serde_json::{Value, json};

use super::Format;
use crate::cli::{ObserveArgs, ShowArgs};
use crate::compare::{self, ChunkInputs, CompareError};

/// Why a policy cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ShowError {
    /// The bundle.
    #[error(transparent)]
    Bundle(#[from] BundleErrors),
    /// onnxruntime.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The graphs.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The episode.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// It has no such chunk of this policy, or not all that it was computed from.
    #[error(
        "{}: it has no {} of this policy, or not all samples that the chunk was computed from: name the \
         folder of the policy that ran{}. If the policy was already running when the \
         episode began, samples of the first chunks may be missing and, in a file of an earlier version, the reference of \
         all chunks: `rapid replay --infer` counts the reasons",
        file.display(),
        number.map_or_else(|| "chunk".to_owned(), |number| format!("chunk {number}")),
        if number.is_some() { ", or another chunk with --chunk" } else { "" },
    )]
    NoChunk {
        /// The episode.
        file: PathBuf,
        /// The number, if one was asked for.
        number: Option<usize>,
    },
    /// The file of arrays.
    #[error("{}: {source}{}", file.display(), fix(source))]
    Arrays {
        /// Its path.
        file: PathBuf,
        /// What is wrong.
        source: ArraysError,
    },
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

impl ShowError {
    /// The fix is another argument.
    pub const fn is_bad_argument(&self) -> bool {
        matches!(self, Self::Bundle(_) | Self::Compare(_) | Self::NoChunk { .. })
    }
}

/// What to do about a file that is there already.
fn fix(error: &ArraysError) -> &'static str {
    match error {
        ArraysError::Io(error) if error.kind() == io::ErrorKind::AlreadyExists => "; choose another file with --to",
        ArraysError::Io(_) | ArraysError::Zip(_) => "",
    }
}

/// Writes what a recorded chunk was computed from to a new file of arrays.
///
/// # Errors
/// When the policy or the episode cannot be read, the chunk is not there, or the file cannot be written.
pub fn observe(args: &ObserveArgs, format: Format, out: &mut dyn Write) -> Result<(), ShowError> {
    let bundle = Bundle::open(args.bundle.as_deref())?;
    let environment = Environment::open(args.inference.ort_lib.as_deref())?;
    let computing = args.inference.computing(InferenceSpec::default());
    let inputs = compare::inputs(&args.file, &bundle, &environment, computing, args.chunk)?;
    let inputs = inputs.ok_or_else(|| ShowError::NoChunk { file: args.file.clone(), number: args.chunk })?;
    let to = args.to.clone().unwrap_or_else(|| args.file.with_extension("npz"));
    let number = inputs.number;
    let arrays = arrays(inputs, &bundle);
    write(&to, &arrays).map_err(|source| ShowError::Arrays { file: to.clone(), source })?;
    match format {
        Format::Json => {
            let shapes: serde_json::Map<String, Value> =
                arrays.iter().map(|array| (array.name.clone(), json!(array.shape))).collect();
            writeln!(
                out,
                "{}",
                json!({"event": "policy_inputs", "file": to.to_string_lossy(), "chunk": number, "arrays": shapes})
            )?;
        }
        Format::Text => {
            for Array { name, shape, .. } in &arrays {
                let shape: Vec<String> = shape.iter().map(ToString::to_string).collect();
                writeln!(out, "{:<12} {}", text::plain(name), shape.join(" x "))?;
            }
            writeln!(out, "{}: chunk {number}", text::plain(&to.to_string_lossy()))?;
        }
    }
    Ok(())
}

/// A named array of 32-bit floats.
struct Array {
    name: String,
    shape: Vec<usize>,
    values: Vec<f32>,
}

fn arrays(inputs: ChunkInputs, bundle: &Bundle) -> Vec<Array> {
    let ChunkInputs { number: _, observations, mask, noise, step_noise, recorded } = inputs;
    let chunk = [bundle.horizon, bundle.action.outputs()];
    let mut arrays: Vec<Array> =
        observations.into_iter().map(|(name, shape, values)| Array { name, shape, values }).collect();
    arrays.extend(mask.map(|(name, values)| Array { name, shape: vec![1, values.len()], values }));
    arrays.push(Array { name: "noise".to_owned(), shape: [&[1], &chunk[..]].concat(), values: noise });
    if !step_noise.is_empty() {
        let shape = [&[step_noise.len()], &chunk[..]].concat();
        arrays.push(Array { name: "step_noise".to_owned(), shape, values: step_noise.concat() });
    }
    let executed = vec![bundle.horizon, bundle.action.len()];
    arrays.push(Array { name: "recorded".to_owned(), shape: executed, values: recorded });
    arrays
}

/// Why there is no file of arrays.
#[derive(Debug, thiserror::Error)]
pub enum ArraysError {
    /// The file.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Its directory.
    #[error(transparent)]
    Zip(#[from] zip::result::ZipError),
}

/// Writes a new `.npz`: a ZIP with one `.npy` for each array
/// (<https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>, version 1.0).
fn write(to: &Path, arrays: &[Array]) -> Result<(), ArraysError> {
    // An episode named by mistake is not overwritten.
    let mut file = zip::ZipWriter::new(File::create_new(to)?);
    let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for Array { name, shape, values } in arrays {
        file.start_file(format!("{name}.npy"), stored)?;
        let shape: Vec<String> = shape.iter().map(ToString::to_string).collect();
        let shape = shape.join(", ");
        let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape},), }}");
        // Magic, version and length take 10 bytes, and the numbers begin at a multiple of 64.
        let padding = 63 - (header.len() + 10) % 64;
        header.push_str(&" ".repeat(padding));
        header.push('\n');
        file.write_all(b"\x93NUMPY\x01\x00")?;
        file.write_all(&u16::try_from(header.len()).unwrap_or(u16::MAX).to_le_bytes())?;
        file.write_all(header.as_bytes())?;
        let numbers: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        file.write_all(&numbers)?;
    }
    file.finish()?.sync_all()?;
    Ok(())
}

/// Prints a policy, and whether it suits `registry`, if there is one.
///
/// # Errors
/// When it cannot be loaded or computed.
pub fn show(
    args: &ShowArgs,
    registry: Option<&Registry>,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), ShowError> {
    let bundle = Bundle::open(args.bundle.as_deref())?;
    let environment = Environment::open(args.inference.ort_lib.as_deref())?;
    let on = registry.map(|registry| registry.inference).unwrap_or_default();
    let computing = args.inference.computing(on);
    let mut model = Model::load(&bundle, &environment, computing)?;
    let shown = Shown {
        unfit: registry.map(|registry| unfit(&bundle, registry)).unwrap_or_default(),
        rig: registry.map(|registry| registry.rig.name.clone()),
        chunk: model.rehearse()?,
        library: environment.origin.to_string(),
        computing,
        bundle,
    };
    match format {
        Format::Json => writeln!(out, "{}", shown.json())?,
        Format::Text => shown.text(out)?,
    }
    Ok(())
}

/// What of the policy does not suit the rig.
fn unfit(bundle: &Bundle, registry: &Registry) -> Vec<String> {
    let actuator = registry.actuator().map(|(device, action)| (device.name.as_str(), action.names.len()));
    let checks = [bundle.check_registry(registry), bundle.check_actuators(actuator.as_slice())];
    let errors = checks.into_iter().filter_map(Result::err).flat_map(|errors| errors.diagnostics);
    errors.map(|error| error.message).collect()
}

struct Shown {
    bundle: Bundle,
    computing: Computing,
    library: String,
    /// Name of the rig, if there is one.
    rig: Option<String>,
    unfit: Vec<String>,
    /// Time of a chunk.
    chunk: Duration,
}

impl Shown {
    fn steps(&self) -> usize {
        self.computing.denoising_steps.unwrap_or(self.bundle.scheduler.num_inference_steps)
    }

    fn json(&self) -> Value {
        let Self { bundle, computing, library, rig, unfit, chunk } = self;
        let observations = bundle.observations.iter().map(|observation| {
            let mut shown = json!({
                "key": observation.key, "modality": observation.modality, "kind": kind(observation),
                "shape": shape(observation), "required": observation.required,
                "hold_last_ms": held(observation).as_millis(),
                "down_sample_steps": observation.down_sample_steps,
            });
            if let (Some(history), Some(shown)) = (&observation.history, shown.as_object_mut()) {
                shown.insert("history".to_owned(), json!({"steps": history.steps, "valid": history.valid}));
            }
            shown
        });
        let pace = match PaceReport::new(bundle, *chunk).verdict {
            PaceVerdict::Whole => "whole",
            PaceVerdict::Pauses => "pauses",
            PaceVerdict::TooSlow => "too_slow",
        };
        json!({
            "event": "policy_bundle", "policy": bundle.name, "hash": bundle.hash,
            "folder": bundle.folder.to_string_lossy(), "mask_aware": bundle.mask_aware,
            "observations": observations.collect::<Vec<_>>(), "actuator": bundle.action.actuator,
            "axes": bundle.action.names, "representation": bundle.action.representation.word(),
            "rotation": bundle.action.rotation.map(ActionRotation::word),
            "base": bundle.action.representation.base().map(|base| &base.modality), "control_hz": bundle.control_hz, "horizon": bundle.horizon,
            "n_action_steps": bundle.n_action_steps, "denoising_steps": self.steps(), "registry": rig,
            "unfit": unfit, "threads": computing.on.threads, "provider": computing.on.provider.word(),
            "library": library, "chunk_ms": chunk.as_secs_f64() * 1e3, "pace": pace,
        })
    }

    fn text(&self, out: &mut dyn Write) -> io::Result<()> {
        let Self { bundle, computing, library, rig, unfit, chunk } = self;
        let mut line = |name: &str, value: &str| writeln!(out, "{name:<10} {}", text::plain(value));
        let hash = bundle.hash.get(..12).unwrap_or_default();
        line("policy", &format!("{} ({hash}), {}", bundle.name, bundle.folder.display()))?;
        for (index, observation) in bundle.observations.iter().enumerate() {
            line(if index == 0 { "observes" } else { "" }, &observed(observation, bundle.mask_aware))?;
        }
        let action = &bundle.action;
        line("moves", &format!("{}: {}", action.actuator, action.names.join(", ")))?;
        line("", &represented(action))?;
        let (steps, train) = (self.steps(), bundle.scheduler.num_train_timesteps);
        let (horizon, executed, hz) = (bundle.horizon, bundle.n_action_steps, bundle.control_hz);
        line(
            "chunks",
            &format!("{horizon} actions at {hz} Hz, {executed} executed; {steps} of {train} denoising steps"),
        )?;
        let (provider, threads) = (computing.on.provider.word(), computing.on.threads);
        let threads = text::counted(threads as u64, "thread");
        line("speed", &format!("{}; on {threads} of {provider}, {library}", PaceReport::new(bundle, *chunk).text))?;
        match rig {
            None => line("rig", "no registry here: --config FILE or --sim task compares it with one"),
            Some(rig) if unfit.is_empty() => line("rig", &format!("{rig}: it has all that the policy wants")),
            Some(rig) => {
                line("rig", &format!("{rig}: it does not suit:"))?;
                unfit.iter().try_for_each(|reason| line("", reason))
            }
        }
    }
}

fn observed(observation: &ObservationSpec, mask_aware: bool) -> String {
    let shape: Vec<String> = shape(observation).iter().map(ToString::to_string).collect();
    let when_absent = match (observation.required, held(observation)) {
        _ if observation.history.is_some() => "zeros for steps at which it was absent".to_owned(),
        (true, _) => "required".to_owned(),
        (false, _) if !mask_aware => "holds without it".to_owned(),
        (false, Duration::ZERO) => "may be absent: zeros".to_owned(),
        (false, time) => format!("may be absent: the last sample for {} s, then zeros", time.as_secs_f64()),
    };
    let key = if observation.key == observation.modality { String::new() } else { format!(" as {}", observation.key) };
    let (turned, first) = match &observation.input {
        ObservationInput::Vector(VectorSpec { rotation, operation, .. }) => (
            rotation.map_or("", |VectorRotation::Rotation6d| " (rotation_6d)"),
            operation.map_or("", |VectorOperation::FirstOfRun| " of the run's first sample"),
        ),
        ObservationInput::Image(_) => ("", ""),
    };
    let apart = match observation.down_sample_steps {
        1 => String::new(),
        ticks => format!(", a step every {ticks} ticks"),
    };
    let history = observation.history.as_ref().map_or(String::new(), |history| {
        format!(", a history of {} steps (input {} marks those present)", history.steps, history.valid)
    });
    let kind = kind(observation);
    let shape = shape.join("x");
    format!("{}{key}: {kind} {shape}{turned}{first}{history}{apart}, {when_absent}", observation.modality)
}

/// What the network's actions are relative to, and how it gives their rotation.
fn represented(action: &BundleAction) -> String {
    let base = action.representation.base().map_or(String::new(), |base| match action.representation {
        Representation::Delta(_) => {
            format!(" from one target to the next, the first from the pose of {}", base.modality)
        }
        _ => format!(" to the pose of {}", base.modality),
    });
    let rotation = action.rotation.map_or(String::new(), |rotation| format!(", rotation as {}", rotation.word()));
    format!("learned as {}{base}{rotation}", action.representation.word())
}

const fn kind(observation: &ObservationSpec) -> &'static str {
    match observation.input {
        ObservationInput::Image(_) => "image",
        ObservationInput::Vector(_) => "vector",
    }
}

fn shape(observation: &ObservationSpec) -> Vec<usize> {
    match &observation.input {
        ObservationInput::Image(image) => vec![image.height, image.width],
        ObservationInput::Vector(vector) => vec![vector.len],
    }
}

const fn held(observation: &ObservationSpec) -> Duration {
    match observation.when_absent {
        WhenAbsent::Zero => Duration::ZERO,
        WhenAbsent::HoldLast(time) => time,
    }
}
