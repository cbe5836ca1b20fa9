//! From what was typed to what is run, and from how that ended to the exit code.
//!
//! Invariant: every error is printed here, once.

mod failure;
mod places;
mod policy;
mod register;

use std::io::{self, IsTerminal, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::CommandFactory;
use tokio_util::sync::CancellationToken;

use self::failure::Failure;
use self::places::{find_registry, load, registry_or_builtin, registry_path};
use crate::action::Order;
use crate::app::{self, AppError, Devices, Options, Screen, mask_path};
use crate::cli::{Calibration, Cli, Command, Global, PolicyArgs, RunArgs, SimArgs};
use crate::commands::calibrate::LatencyOptions;
use crate::commands::devices::{Entries, Formats};
use crate::commands::{self, Format, Outcome, mask::MaskOptions};
use crate::driver::replay;
use crate::headless::style::{ColourChoice, Palette, Terminal};
use crate::hotplug::udev;
use crate::outlet;
use crate::record::inspect;
use crate::record::{self, EpisodeRequest, RecordError};
use crate::registry::scenario::Scenario;
use crate::registry::{Attachment, Registry};
use crate::rig::presence::{json_path, read_mask};
use crate::text;

/// Tasks that are left at the end have this long to go.
const LAST_TASKS: Duration = Duration::from_millis(500);
/// The reader of standard error has this long to take why a command failed: it may never read.
const LAST_WORDS: Duration = Duration::from_secs(2);
/// The mask's JSON file holds 64 devices at most; anything larger is not it.
const LARGEST_JSON: u64 = 1 << 20;

/// Runs what was typed.
#[must_use]
pub fn dispatch(cli: Cli) -> ExitCode {
    let outcome = match cli.command {
        None => run(&cli.global, &cli.run, Source::of(cli.simulation), Some(cli.policy)),
        Some(Command::Replay { file, run: ref args, compare }) => match compare.compare_with.clone() {
            Some(bundle) => policy::compare(&cli.global, file, bundle, compare),
            None => run(&cli.global, args, Source::Episode(file), None),
        },
        Some(command) => print(&cli.global, cli.simulation, command),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        // Whoever read the output has read enough of it.
        Err(Failure::Output(error)) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(failure) => {
            // Paths and what a library says of a file are text of strangers.
            let said = failure::with_cause(failure.to_string());
            let text: Vec<_> = said.lines().map(|line| text::plain(line).into_owned()).collect();
            let text = text.join("\n");
            if !text.is_empty() {
                let said = format!("{} {text}\n", stderr_palette().bad("error:"));
                outlet::write_within(io::stderr(), said, LAST_WORDS);
            }
            ExitCode::from(failure.code())
        }
    }
}

/// Everything that prints and ends.
fn print(global: &Global, before: SimArgs, command: Command) -> Result<(), Failure> {
    // Not locked: a command may write from another thread.
    let out = &mut io::stdout();
    let format = if global.json { Format::Json } else { Format::Text };
    match command {
        Command::Check => {
            let path = registry_path(global)?;
            match commands::check::check(&path, format, out)? {
                Outcome::Done => Ok(()),
                Outcome::BadConfiguration => Err(Failure::Told),
            }
        }
        Command::Devices { formats, simulation } => {
            let formats = if formats { Formats::Ask } else { Formats::Skip };
            devices(
                global,
                Source::of(if simulation.sim.is_some() { simulation } else { before }),
                formats,
                format,
                out,
            )
        }
        Command::Register(args) => register::register(global, before, &args, format, out),
        Command::Unregister(args) => register::unregister(global, &args, format, out),
        Command::Doctor { out: episodes } => {
            let registry = registry_path(global).and_then(|path| load(&path)).map_err(|failure| failure.to_string());
            let registry = registry.as_ref().map_err(String::as_str);
            if commands::doctor::doctor(registry, &episodes, format, out)? { Ok(()) } else { Err(Failure::Found) }
        }
        Command::Artifacts { install, to } => {
            let registry = load(&registry_path(global)?)?;
            if install {
                return Ok(commands::artifacts::install(&registry, out)?);
            }
            Ok(commands::artifacts::write(&registry, &to, out)?)
        }
        Command::Mask { watch } => mask(global, watch),
        Command::Arm { drive_back } => {
            let order = if drive_back { Order::ArmBack } else { Order::Arm };
            Ok(commands::arm::order(global.instance.as_deref(), order, out)?)
        }
        Command::Disarm => Ok(commands::arm::order(global.instance.as_deref(), Order::Disarm, out)?),
        Command::Calibrate { what: Calibration::Latency { device, duration, led, light_delay, simulation } } => {
            let source = Source::of(if simulation.sim.is_some() { simulation } else { before });
            let (registry, attached) = plugged(global, source)?;
            let options = LatencyOptions { device, duration, led, light_delay };
            Ok(block_on(commands::calibrate::latency(&registry, &attached, &options, format, out))??)
        }
        Command::Inspect { paths } => match commands::inspect::inspect(&paths, format, columns(), paint(), out)? {
            Outcome::Done => Ok(()),
            Outcome::BadConfiguration => Err(Failure::Told),
        },
        Command::Recover { paths } => recover(&paths, format),
        Command::Ablation(args) => Ok(commands::ablation::ablation(
            &registry_or_builtin(global)?,
            global.config.as_deref(),
            &args,
            format,
            out,
        )?),
        Command::Eval(args) => policy::eval(args, format),
        Command::Completions { shell } => Ok(commands::completions::completions(&mut Cli::command(), shell, out)?),
        Command::Replay { .. } => Ok(()),
    }
}

/// Where devices come from.
enum Source {
    /// This machine.
    Machine,
    /// A scenario: the demonstration, or that of a file.
    Scenario(Option<PathBuf>),
    /// The simulated task.
    Task,
    /// A recorded episode.
    Episode(PathBuf),
}

impl Source {
    fn of(simulation: SimArgs) -> Self {
        match simulation.sim {
            None => Self::Machine,
            // A file of that name is ./task.
            Some(Some(file)) if file.as_os_str() == "task" => Self::Task,
            Some(file) => Self::Scenario(file),
        }
    }
}

/// What is plugged in is worth knowing even while the registry is wrong: it is told first.
fn devices(
    global: &Global,
    source: Source,
    formats: Formats,
    format: Format,
    out: &mut dyn Write,
) -> Result<(), Failure> {
    if let Source::Scenario(_) | Source::Task = source {
        let (registry, attached) = plugged(global, source)?;
        let plugged = commands::devices::list(Entries::Of(&registry), &attached, formats);
        return Ok(commands::devices::print(&plugged, Some(&registry), format, out)?);
    }
    let (entries, wrong) = match find_registry(global).map(|path| load(&path)) {
        None => (None, None),
        Some(Ok(registry)) => (Some(registry), None),
        Some(Err(wrong)) => (None, Some(wrong)),
    };
    let known = match (&entries, &wrong) {
        (Some(registry), _) => Entries::Of(registry),
        (None, Some(_)) => Entries::Wrong,
        (None, None) => Entries::NoFile,
    };
    let plugged = commands::devices::list(known, &udev::enumerate()?, formats);
    commands::devices::print(&plugged, entries.as_ref(), format, out)?;
    wrong.map_or(Ok(()), Err)
}

/// A registry that can be used, and what is plugged in.
fn plugged(global: &Global, source: Source) -> Result<(Registry, Vec<Attachment>), Failure> {
    let file = match source {
        Source::Scenario(file) => file,
        Source::Task => {
            let registry = Registry::task();
            let attached = crate::hotplug::script::attached(&Scenario::task(&registry, 0));
            return Ok((registry, attached));
        }
        Source::Machine | Source::Episode(_) => return Ok((load(&registry_path(global)?)?, udev::enumerate()?)),
    };
    let registry = registry_or_builtin(global)?;
    let attached = crate::hotplug::script::attached(&scenario(file.as_deref(), &registry)?);
    Ok((registry, attached))
}

fn mask(global: &Global, watch: bool) -> Result<(), Failure> {
    let path = mask_path(global.instance.as_deref());
    let json = json_path(&path);
    let names = || commands::mask::layout(&crate::folder::read_text(&json, LARGEST_JSON).ok()?);
    let read = || read_mask(&path).map_err(|error| error.to_string());
    let options = MaskOptions { watch, json: global.json, palette: palette() };
    let stop = CancellationToken::new();
    block_on(async {
        let interrupted = stop.clone();
        tokio::spawn(async move {
            if tokio::signal::ctrl_c().await.is_ok() {
                interrupted.cancel();
            }
        });
        Ok(commands::mask::run(read, names, crate::time::realtime_ns, options, stop, io::stdout()).await?)
    })?
}

fn recover(paths: &[PathBuf], format: Format) -> Result<(), Failure> {
    let progress = io::stderr().is_terminal() && format == Format::Text;
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    let paths = paths.to_owned();
    let told = block_on(async move {
        let mut work = tokio::task::spawn_blocking(move || {
            commands::recover::run(&paths, format, progress, &asked, &mut io::stdout(), &mut io::stderr())
        });
        let interrupted = tokio::select! {
            done = &mut work => return Ok(done),
            interrupted = tokio::signal::ctrl_c() => interrupted,
        };
        interrupted?;
        stop.store(true, Ordering::Relaxed);
        tokio::select! {
            done = &mut work => Ok(done),
            // The disk may take its time; what was repaired is repaired.
            _ = tokio::signal::ctrl_c() => Err(Failure::App(AppError::InterruptedTwice)),
        }
    })??;
    let (outcome, written) = told.map_err(|_| Failure::App(AppError::Panicked("the repair")))?;
    if outcome.is_done() { Ok(written?) } else { Err(Failure::Recover(outcome)) }
}

/// The rig: on this machine, simulated, or played from an episode.
fn run(global: &Global, args: &RunArgs, source: Source, policy: Option<PolicyArgs>) -> Result<(), Failure> {
    if args.expert {
        return policy::demonstrate(global, args, &source);
    }
    let mut duration = args.duration;
    let (mut registry, devices) = match source {
        Source::Episode(file) => {
            let replay::Replayed { registry, scenario, length } = replay::scenario(&file).map_err(Failure::Replay)?;
            // Without anybody at the screen, a replay ends where the episode does.
            if args.headless && duration.is_none() {
                duration = Some(length);
            }
            (registry, Devices::Simulated(scenario))
        }
        Source::Scenario(file) => {
            let registry = registry_or_builtin(global)?;
            let scenario = scenario(file.as_deref(), &registry)?;
            (registry, Devices::Simulated(scenario))
        }
        Source::Task => {
            let registry = Registry::task();
            let scenario = Scenario::task(&registry, args.seed);
            (registry, Devices::Simulated(scenario))
        }
        Source::Machine => (load(&registry_path(global)?)?, Devices::Machine),
    };
    if let Some(rate) = args.rate {
        registry.rig.observation_hz = rate;
    }
    if let Some(window) = args.window {
        registry.rig.sync_window = window;
    }
    let modules = modules(&registry, args)?;
    if args.record {
        prepare(&args.out).map_err(Failure::Folder)?;
    }
    let monitor = policy.as_ref().is_none_or(|policy| policy.infer.is_none() || policy.monitor);
    let screen = match (args.headless || !monitor || !io::stdout().is_terminal(), global.json) {
        (_, true) => Screen::Json,
        (true, false) => Screen::Lines,
        (false, false) => Screen::Monitor,
    };
    let policy = policy.map(|policy| policy::at_the_controls(policy, args.seed, &registry)).transpose()?.flatten();
    let options = Options {
        policy,
        registry,
        devices,
        screen,
        episode: EpisodeRequest {
            out: args.out.clone(),
            task: args.task.clone(),
            tags: args.tag.clone(),
            modules,
            duration,
        },
        record: args.record,
        arm: args.arm,
        duration,
        instance: global.instance.clone(),
    };
    Ok(block_on(app::run(options))??)
}

/// The modules that were said to be mounted, if the registry knows them.
fn modules(registry: &Registry, args: &RunArgs) -> Result<Vec<String>, Failure> {
    let mounted = crate::registry::mounted(&registry.modules, &args.module)?;
    Ok(mounted.into_iter().map(|module| module.name.clone()).collect())
}

/// The folder an episode is to be written to at once: better refused before the devices are started.
fn prepare(out: &Path) -> Result<(), RecordError> {
    let refused = |source| RecordError::Io { path: out.to_owned(), source };
    record::open_folder(out)?;
    let enter_and_write = rustix::fs::Access::WRITE_OK | rustix::fs::Access::EXEC_OK;
    rustix::fs::access(out, enter_and_write).map_err(|error| refused(error.into()))
}

fn scenario(file: Option<&Path>, registry: &Registry) -> Result<Scenario, Failure> {
    match file {
        Some(file) => Ok(Scenario::load(file, registry)?),
        None => Ok(Scenario::demo(registry)),
    }
}

/// Runs `work` on a runtime of its own. When it is done nothing is waited for: a thread that is
/// still opening a device that does not answer would hold up the end for as long as the kernel likes.
fn block_on<T>(work: impl Future<Output = T>) -> Result<T, Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().thread_name("worker").build()?;
    let done = catch_unwind(AssertUnwindSafe(|| runtime.block_on(work)));
    runtime.shutdown_timeout(LAST_TASKS);
    done.map_err(|_| Failure::Panicked)
}

fn palette() -> Palette {
    ColourChoice::Auto.resolve(Terminal::of(&io::stdout()), |name| std::env::var(name).ok())
}

fn stderr_palette() -> Palette {
    ColourChoice::Auto.resolve(Terminal::of(&io::stderr()), |name| std::env::var(name).ok())
}

fn paint() -> inspect::Paint {
    if palette() == Palette::Ansi { inspect::Paint::Ansi } else { inspect::Paint::Plain }
}

fn columns() -> usize {
    crate::tui::columns().unwrap_or(100)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_stuck_in_a_device_does_not_hold_up_the_end() {
        let (release, stuck) = std::sync::mpsc::channel::<()>();
        let done = block_on(async move {
            let (tell, begun) = tokio::sync::oneshot::channel();
            tokio::task::spawn_blocking(move || {
                let _ = tell.send(());
                stuck.recv()
            });
            begun.await.expect("begun");
            7
        });
        assert_eq!(done.expect("runtime"), 7);
        // Only now may the device answer: a runtime that waited for it would not have come here.
        drop(release);
    }
}
