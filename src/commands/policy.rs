//! `rapid policy show`: what a policy observes and does, whether it suits the rig, and how long a chunk takes on this machine.

use std::io::{self, Write};
use std::time::Duration;

use serde_json::{Value, json};

use super::Format;
use crate::cli::ShowArgs;
use crate::policy::bundle::{Bundle, BundleErrors, ObservationInput, ObservationSpec, WhenAbsent};
use crate::policy::library::{Environment, LibraryError};
use crate::policy::model::Model;
use crate::policy::pace::{Pace, PaceVerdict};
use crate::policy::sampler::{Computing, PolicyError};
use crate::registry::Registry;
use crate::text;

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
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
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
            json!({
                "key": observation.key, "modality": observation.modality, "kind": kind(observation),
                "shape": shape(observation), "required": observation.required,
                "hold_last_ms": held(observation).as_millis(),
            })
        });
        let pace = match Pace::of(bundle, *chunk).verdict {
            PaceVerdict::Whole => "whole",
            PaceVerdict::Pauses => "pauses",
            PaceVerdict::TooSlow => "too_slow",
        };
        json!({
            "event": "policy_bundle", "policy": bundle.name, "hash": bundle.hash,
            "folder": bundle.folder.to_string_lossy(), "mask_aware": bundle.mask_aware,
            "observations": observations.collect::<Vec<_>>(), "actuator": bundle.action.actuator,
            "axes": bundle.action.names, "control_hz": bundle.control_hz, "horizon": bundle.horizon,
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
        let (steps, train) = (self.steps(), bundle.scheduler.num_train_timesteps);
        let (horizon, executed, hz) = (bundle.horizon, bundle.n_action_steps, bundle.control_hz);
        line(
            "chunks",
            &format!("{horizon} actions at {hz} Hz, {executed} executed; {steps} of {train} denoising steps"),
        )?;
        let (provider, threads) = (computing.on.provider.word(), computing.on.threads);
        let threads = text::counted(threads as u64, "thread");
        line("speed", &format!("{}; on {threads} of {provider}, {library}", Pace::of(bundle, *chunk).text))?;
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
        (true, _) => "required".to_owned(),
        (false, _) if !mask_aware => "holds without it".to_owned(),
        (false, Duration::ZERO) => "may be absent: zeros".to_owned(),
        (false, time) => format!("may be absent: the last sample for {} s, then zeros", time.as_secs_f64()),
    };
    let key = if observation.key == observation.modality { String::new() } else { format!(" as {}", observation.key) };
    format!("{}{key}: {} {}, {when_absent}", observation.modality, kind(observation), shape.join("x"))
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
