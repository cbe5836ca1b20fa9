//! From what was typed to what is run, and from how that ended to the exit code.
//!
//! Invariant: every error is printed here, once.

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::CommandFactory;
use tokio_util::sync::CancellationToken;

use crate::app::{self, AppError, Devices, Options, Screen, mask_path};
use crate::cli::{Cli, Command, Global, RunArgs};
use crate::commands::{self, Format, Outcome, devices::Formats, mask::MaskOptions};
use crate::driver::replay;
use crate::headless::style::{ColourChoice, Palette, Terminal};
use crate::hotplug::udev;
use crate::record::inspect::{self, InspectError};
use crate::record::{EpisodeRequest, RecordError};
use crate::registry::scenario::Scenario;
use crate::registry::{Registry, RegistryErrors};
use crate::rig::presence::{PresenceError, json_path, read_mask};

/// Tasks that are left at the end have this long to go.
const LAST_TASKS: Duration = Duration::from_millis(500);

/// Why a command ended without having done what it was asked.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error(transparent)]
    App(#[from] AppError),
    /// The registry is wrong.
    #[error("{0}")]
    Registry(#[from] RegistryErrors),
    /// There is none.
    #[error(
        "no devices.toml: looked for {}\n  fix: write one (`rapid devices` lists what is plugged in), name one with --config, \
         or look around with `rapid --sim`", .0.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
    )]
    NoRegistry(Vec<PathBuf>),
    #[error(transparent)]
    Presence(#[from] PresenceError),
    #[error(transparent)]
    Hotplug(#[from] crate::hotplug::HotplugError),
    #[error(transparent)]
    Inspect(#[from] InspectError),
    #[error(transparent)]
    Artifacts(#[from] commands::artifacts::ArtifactsError),
    #[error(transparent)]
    Mask(#[from] commands::mask::MaskError),
    #[error("{}: {reason}", file.display())]
    Replay { file: PathBuf, reason: String },
    /// What was wrong has been printed.
    #[error("")]
    Told,
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

impl Failure {
    /// Exit codes: 1 failed while running, 2 bad configuration or arguments, 130 interrupted twice.
    fn code(&self) -> u8 {
        match self {
            Self::App(AppError::InterruptedTwice) => 130,
            Self::App(AppError::Record(RecordError::NoFolder(_)) | AppError::Logging(_))
            | Self::Registry(_)
            | Self::NoRegistry(_)
            | Self::Told => 2,
            _ => 1,
        }
    }
}

/// Runs what was typed.
#[must_use]
pub fn dispatch(cli: Cli) -> ExitCode {
    let outcome = match cli.command {
        None => run(&cli.global, &cli.run, None),
        Some(Command::Replay { ref file, run: ref args }) => run(&cli.global, args, Some(file)),
        Some(command) => print(&cli.global, &cli.run, command),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        // Whoever read the output has read enough of it.
        Err(Failure::Output(error)) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(failure) => {
            let text = failure.to_string();
            if !text.is_empty() {
                let _ = writeln!(io::stderr(), "{} {text}", stderr_palette().bad("error:"));
            }
            ExitCode::from(failure.code())
        }
    }
}

/// Everything that prints and ends.
fn print(global: &Global, run: &RunArgs, command: Command) -> Result<(), Failure> {
    let out = &mut io::stdout().lock();
    let format = if global.json { Format::Json } else { Format::Text };
    match command {
        Command::Check => {
            let path = registry_path(global)?;
            match commands::check::check(&path, format, out)? {
                Outcome::Done => Ok(()),
                Outcome::BadConfiguration => Err(Failure::Told),
            }
        }
        Command::Devices { formats } => {
            let registry = find_registry(global).map(|path| load(&path)).transpose()?;
            let formats = if formats { Formats::Ask } else { Formats::Skip };
            let plugged = commands::devices::list(registry.as_ref(), &attached(run, registry.as_ref())?, formats);
            if format == Format::Json {
                for device in &plugged {
                    serde_json::to_writer(&mut *out, device).map_err(io::Error::from)?;
                    writeln!(out)?;
                }
                return Ok(());
            }
            Ok(commands::devices::print(&plugged, registry.as_ref(), out)?)
        }
        Command::Artifacts { install, to } => {
            let registry = load(&registry_path(global)?)?;
            if install {
                return Ok(commands::artifacts::install(&registry, out)?);
            }
            Ok(commands::artifacts::write(&registry, &to, out)?)
        }
        Command::Mask { watch } => mask(global, watch),
        Command::Inspect { file } => {
            let inspection = inspect::inspect(&file)?;
            if format == Format::Json {
                serde_json::to_writer(&mut *out, &inspection).map_err(io::Error::from)?;
                return Ok(writeln!(out)?);
            }
            Ok(out.write_all(inspect::render(&inspection, columns(), paint()).as_bytes())?)
        }
        Command::Completions { shell } => Ok(commands::completions::completions(&mut Cli::command(), shell, out)?),
        Command::Replay { .. } => Ok(()),
    }
}

/// What is attached: to this machine, or at the beginning of a scenario.
fn attached(run: &RunArgs, registry: Option<&Registry>) -> Result<Vec<crate::registry::Attachment>, Failure> {
    match (&run.sim, registry) {
        (Some(file), Some(registry)) => Ok(crate::hotplug::script::attached(scenario(file.as_deref(), registry)?)),
        _ => Ok(udev::enumerate()?),
    }
}

fn mask(global: &Global, watch: bool) -> Result<(), Failure> {
    let path = mask_path(global.instance.as_deref());
    let json = json_path(&path);
    let names = || commands::mask::layout(&std::fs::read_to_string(&json).ok()?);
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

/// The rig: on this machine, simulated, or played from an episode.
fn run(global: &Global, args: &RunArgs, replayed: Option<&Path>) -> Result<(), Failure> {
    let (mut registry, devices) = match (replayed, &args.sim) {
        (Some(file), _) => {
            let failed = |reason: String| Failure::Replay { file: file.to_owned(), reason };
            let (registry, scenario) = replay::scenario(file).map_err(|error| failed(error.to_string()))?;
            (registry, Devices::Simulated(scenario))
        }
        (None, Some(file)) => {
            let registry = match find_registry(global) {
                Some(path) => load(&path)?,
                None => Registry::builtin(),
            };
            let scenario = scenario(file.as_deref(), &registry)?;
            (registry, Devices::Simulated(scenario))
        }
        (None, None) => (load(&registry_path(global)?)?, Devices::Machine),
    };
    if let Some(rate) = args.rate {
        registry.rig.observation_hz = rate;
    }
    if let Some(window) = args.window {
        registry.rig.sync_window = window;
    }
    let screen = match (args.headless || !io::stdout().is_terminal(), global.json) {
        (_, true) => Screen::Json,
        (true, false) => Screen::Lines,
        (false, false) => Screen::Monitor,
    };
    let options = Options {
        registry,
        devices,
        screen,
        episode: EpisodeRequest {
            out: args.out.clone(),
            task: args.task.clone(),
            tags: args.tag.clone(),
            duration: args.duration,
        },
        record: args.record,
        duration: args.duration,
        instance: global.instance.clone(),
    };
    Ok(block_on(app::run(options))??)
}

fn scenario(file: Option<&Path>, registry: &Registry) -> Result<Scenario, Failure> {
    match file {
        Some(file) => Ok(Scenario::load(file, registry)?),
        None => Ok(Scenario::demo(registry)),
    }
}

/// Reads a registry; its warnings go to standard error.
fn load(path: &Path) -> Result<Registry, Failure> {
    let loaded = Registry::load(path)?;
    for warning in &loaded.warnings {
        let _ = writeln!(io::stderr(), "{} {warning}", stderr_palette().warn("warning:"));
    }
    Ok(loaded.registry)
}

fn registry_path(global: &Global) -> Result<PathBuf, Failure> {
    find_registry(global).ok_or_else(|| Failure::NoRegistry(usual_places()))
}

/// The registry named, or the first of the usual places where there is one.
fn find_registry(global: &Global) -> Option<PathBuf> {
    if let Some(path) = &global.config {
        return Some(path.clone());
    }
    usual_places().into_iter().find(|path| path.exists())
}

fn usual_places() -> Vec<PathBuf> {
    let home = || std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".config"));
    let config = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|path| path.is_absolute());
    let mut places = vec![PathBuf::from("devices.toml")];
    places.extend(config.or_else(home).map(|folder| folder.join("rapid/devices.toml")));
    places.push(PathBuf::from("/etc/rapid/devices.toml"));
    places
}

/// Runs `work` on a runtime of its own. When it is done nothing is waited for: a thread that is
/// still opening a device that does not answer would hold up the end for as long as the kernel likes.
fn block_on<T>(work: impl Future<Output = T>) -> io::Result<T> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().thread_name("worker").build()?;
    let done = runtime.block_on(work);
    runtime.shutdown_timeout(LAST_TASKS);
    Ok(done)
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
