//! Policies: where they are, how they are run and tried.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::failure::Failure;
use super::{Source, block_on, prepare};
use crate::app::PolicyOptions;
use crate::cli::{CompareArgs, EvalArgs, Global, PolicyArgs, RunArgs};
use crate::commands::compare::CompareOptions;
use crate::commands::eval::EvalOptions;
use crate::commands::{self, Format};
use crate::lockstep::evaluate::{Condition, Configuration};
use crate::policy::bundle::Bundle;
use crate::policy::horizon::WithoutMask;
use crate::record::EpisodeRequest;
use crate::registry::Registry;

/// The policy of a run, if there is to be one.
pub(super) fn at_the_controls(
    args: PolicyArgs,
    seed: u64,
    registry: &Registry,
) -> Result<Option<PolicyOptions>, Failure> {
    let Some(named) = args.infer else { return Ok(None) };
    let bundle = Bundle::open(named.as_deref()).map_err(Failure::Bundle)?;
    let unfit = |errors| if bundle.inside { Failure::OtherRig(errors) } else { Failure::Bundle(errors) };
    bundle.check_registry(registry).map_err(unfit)?;
    let actuator = registry.actuator().map(|(device, action)| (device.name.as_str(), action.names.len()));
    // What moves nothing needs nothing to move.
    if !args.dry_run {
        bundle.check_actuators(actuator.as_slice()).map_err(unfit)?;
    }
    Ok(Some(PolicyOptions {
        bundle,
        without_mask: if args.go_on { WithoutMask::GoOn } else { WithoutMask::Hold },
        seed,
        dry_run: args.dry_run,
        wait: args.wait,
        denoising_steps: args.denoising_steps,
        library: args.ort_lib,
    }))
}

/// Trials of a policy.
pub(super) fn eval(args: EvalArgs, format: Format) -> Result<(), Failure> {
    let configuration = if args.static_config { Configuration::Static } else { Configuration::Dynamic };
    let options = EvalOptions {
        bundle: args.bundle,
        trials: args.trials,
        seed: args.seed,
        conditions: if args.condition.is_empty() { Condition::ALL.to_vec() } else { args.condition },
        configuration,
        denoising_steps: args.denoising_steps,
        library: args.ort_lib,
    };
    interruptible(move |stop| commands::eval::run(&options, format, stop, &mut io::stdout()))
}

/// A policy beside an episode.
pub(super) fn compare(
    global: &Global,
    file: PathBuf,
    bundle: Option<PathBuf>,
    args: CompareArgs,
) -> Result<(), Failure> {
    let options = CompareOptions {
        file,
        bundle,
        tolerance: args.tolerance,
        denoising_steps: args.denoising_steps,
        library: args.ort_lib,
    };
    let format = if global.json { Format::Json } else { Format::Text };
    interruptible(move |stop| commands::compare::run(&options, format, stop, &mut io::stdout()))
}

/// Demonstrations of the simulated task.
pub(super) fn demonstrate(global: &Global, args: &RunArgs, source: &Source) -> Result<(), Failure> {
    if !matches!(source, Source::Task) {
        return Err(Failure::Arguments("--expert knows the simulated task alone: write --sim task --expert --record"));
    }
    if args.duration.is_some() || args.rate.is_some() || args.window.is_some() {
        let text = "--duration, --rate and --window do not go with --expert: a demonstration takes as long as it takes";
        return Err(Failure::Arguments(text));
    }
    prepare(&args.out).map_err(Failure::Folder)?;
    let modules = super::modules(&crate::registry::Registry::task(), args)?;
    let request = EpisodeRequest {
        out: args.out.clone(),
        task: args.task.clone(),
        tags: args.tag.clone(),
        modules,
        duration: None,
    };
    let format = if global.json { Format::Json } else { Format::Text };
    let (seed, episodes) = (args.seed, args.episodes);
    interruptible(move |stop| commands::demonstrate::run(&request, seed, episodes, format, stop, &mut io::stdout()))
}

/// Does work that ends between two pieces of it when it is interrupted, and prints what it has.
fn interruptible<E: Into<Failure> + Send + 'static>(
    work: impl FnOnce(&dyn Fn() -> bool) -> Result<(), E> + Send + 'static,
) -> Result<(), Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    block_on(async move {
        let work = tokio::task::spawn_blocking(move || work(&|| asked.load(Ordering::Relaxed)));
        tokio::spawn(async move {
            // The one in progress is finished.
            if tokio::signal::ctrl_c().await.is_ok() {
                stop.store(true, Ordering::Relaxed);
            }
        });
        work.await
    })?
    .map_err(|_| Failure::Panicked)?
    .map_err(Into::into)
}
