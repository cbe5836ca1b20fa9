//! The policy of a run, demonstrations of the simulated task, and work that ctrl-C ends early.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rapid_policy::bundle::{Bundle, BundleErrors};
use rapid_policy::horizon::WithoutMask;
use rapid_policy::live::LiveOptions;
use rapid_registry::Registry;
use rapid_registry::task::HANDHELD_MODULE;

use super::Failure;
use super::registry::{find_registry, load};
use super::{block_on, check_writable, is_task, request, rig};
use crate::app::PolicyOptions;
use crate::cli::{EvalArgs, Global, PolicyArgs, PolicyCommand, ReplayArgs, RunArgs, TaskArgs};
use crate::commands::{self, Format};

/// The policy of a run: the one that was named, or the one that is built in.
pub(super) fn options(args: PolicyArgs, seed: u64, registry: &Registry) -> Result<PolicyOptions, Failure> {
    let bundle = Bundle::open(args.infer.flatten().as_deref()).map_err(Failure::argument)?.holding_last(args.hold_last);
    let unfit = |errors: BundleErrors| {
        let inside = "\nThe policy built into rapid is for the simulated task only: rapid --infer --sim task\n    fix: name the \
                      folder of a policy that was trained on this rig: rapid --infer FOLDER (models/README.md describes \
                      how to make one)";
        Failure::argument(format_args!("{errors}{}", if bundle.inside { inside } else { "" }))
    };
    bundle.check_registry(registry).map_err(unfit)?;
    let actuator = registry.actuator().map(|(device, action)| (device.name.as_str(), action.names.len()));
    // A dry run moves nothing, so it needs no actuator.
    if !args.dry_run {
        bundle.check_actuators(actuator.as_slice()).map_err(unfit)?;
    }
    Ok(PolicyOptions {
        live: LiveOptions {
            bundle: Arc::new(bundle),
            without_mask: if args.ignore_missing { WithoutMask::GoOn } else { WithoutMask::Hold },
            seed,
            dry_run: args.dry_run,
        },
        wait: args.wait,
        computing: args.inference.computing(registry.inference),
        library: args.inference.ort_lib,
    })
}

/// Records demonstrations of the simulated task.
pub(super) fn demonstrate(global: &Global, args: &RunArgs, task: &TaskArgs, format: Format) -> Result<(), Failure> {
    if !is_task(global) {
        return Err(Failure::argument(
            "--expert demonstrates the simulated task only: write --sim task --expert --record",
        ));
    }
    check_writable(&args.out).map_err(Failure::argument)?;
    let registry = if task.handheld { Registry::task_handheld() } else { Registry::task() };
    let mut request = request(args, &registry)?;
    if task.handheld && request.modules.is_empty() {
        request.modules.push(HANDHELD_MODULE.to_owned());
    }
    let trials = (task.seed, task.episodes);
    interruptible(move |stop| commands::demonstrate::run(registry, &request, trials, format, stop, &mut io::stdout()))
}

/// Shows a policy beside the rig, if there is one, or the inputs of a chunk.
pub(super) fn about(global: &Global, what: &PolicyCommand, format: Format, out: &mut dyn Write) -> Result<(), Failure> {
    let args = match what {
        PolicyCommand::Show(args) => args,
        PolicyCommand::Observe(args) => return Ok(commands::policy::observe(args, format, out)?),
    };
    let registry = match find_registry(global) {
        _ if global.sim.is_some() => Some(rig(global, 0)?.0),
        Some(path) => Some(load(&path)?),
        None => None,
    };
    Ok(commands::policy::show(args, registry.as_ref(), format, out)?)
}

/// Evaluates a policy on the simulated task.
pub(super) fn eval(args: EvalArgs, format: Format) -> Result<(), Failure> {
    interruptible(move |stop| commands::eval::run(&args, format, stop, &mut io::stdout()))
}

/// Compares a policy with an episode.
pub(super) fn compare(args: ReplayArgs, format: Format) -> Result<(), Failure> {
    interruptible(move |stop| commands::compare::run(&args, format, stop, &mut io::stdout()))
}

/// Runs work that stops at its next opportunity when interrupted, and then prints the results so far.
fn interruptible<E: Into<Failure> + Send + 'static>(
    work: impl FnOnce(&dyn Fn() -> bool) -> Result<(), E> + Send + 'static,
) -> Result<(), Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    let requested = Arc::clone(&stop);
    block_on(async move {
        let work = tokio::task::spawn_blocking(move || work(&|| requested.load(Ordering::Relaxed)));
        tokio::spawn(async move {
            // The piece of work in progress is finished first.
            if tokio::signal::ctrl_c().await.is_ok() {
                stop.store(true, Ordering::Relaxed);
            }
        });
        work.await
    })?
    .map_err(|_| Failure::panicked())?
    .map_err(Into::into)
}
