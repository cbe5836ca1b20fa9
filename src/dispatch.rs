//! From the command line to the command, and from its result to the exit code.
//!
//! Invariant: every error is printed here, once.

#[cfg(feature = "policy")]
mod policy;
mod registry;

use std::io::{self, IsTerminal};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rapid_core::action::Order;
use rapid_core::text;
use rapid_core::time::Zone;
use rapid_devices::driver::replay;
use rapid_devices::hotplug::HotplugError;
use rapid_episode::record::inspect::ReadError;
use rapid_episode::record::{self, EpisodeRequest, RecordError};
use rapid_registry::scenario::Scenario;
use rapid_registry::{ModuleError, Registry, RegistryErrors};
use rapid_screens::tui::ScreenOptions;
use rapid_status::Level;
use rapid_status::palette::Palette;
use rapid_status::session::SessionRequest;
use rapid_system::outlet;
use tokio_util::sync::CancellationToken;

use self::registry::{
    connected, devices, find_registry, load, print_warning, register, registry_or_builtin, registry_path, unregister,
    usual_places,
};
use crate::app::{self, AppError, Devices, Options, Policy, Screen, Server, mask_path};
use crate::cli::{
    Calibration, Cli, Command, Global, LatencyArgs, LevelArg, PolicyArgs, ReplayArgs, RunArgs, SessionCommand,
};
use crate::commands::devices::Formats;
use crate::commands::inspect::InspectFailure;
use crate::commands::logs::LogsOptions;
use crate::commands::mask::MaskOptions;
use crate::commands::notes::NoteError;
use crate::commands::{self, CommandStatus, Format};
use crate::rig::presence::{self, PresenceError, json_path, read_mask};
use crate::session::journal::Plan;

#[cfg(feature = "policy")]
use crate::commands::compare::CompareFailure;
#[cfg(feature = "policy")]
use crate::compare::CompareError;

/// Tasks that are still running at the end must finish within this time.
const TASKS_TIMEOUT: Duration = Duration::from_millis(500);
/// How long a thread that opened or closed a device waits for another one.
const IDLE_THREAD: Duration = Duration::from_secs(2);
/// The reader of an output must accept an error message within this time: it may never read.
const STDERR_TIMEOUT: Duration = Duration::from_secs(2);
/// The mask's JSON file lists 64 devices at most; a larger file is not one.
const LARGEST_JSON: u64 = 1 << 20;

/// Why a program ended: with `--json` the last line of standard output.
#[derive(serde::Serialize)]
struct Ended<'a> {
    event: &'static str,
    command: &'a str,
    message: &'a str,
    exit_code: u8,
}

/// Prints why the command named `command` ended, as JSON.
fn print_ended(command: &str, message: &str, exit_code: u8) {
    let ended = Ended { event: "error", command, message, exit_code };
    let line = text::json(&ended).unwrap_or_default() + "\n";
    outlet::write_within(io::stdout(), line, STDERR_TIMEOUT);
}

/// Prints a command line's error, or its help or version, and returns the exit code.
pub fn refuse(error: &clap::Error) -> ExitCode {
    // Help and version go to standard output and are not errors.
    let code = if error.use_stderr() { 2 } else { 0 };
    // If even this cannot be written, no error can be shown.
    let _ = error.print();
    if code != 0 && std::env::args_os().any(|word| word == "--json") {
        let message = error.to_string();
        let message = message.split("\n\nUsage:").next().unwrap_or_default();
        print_ended(&Cli::name_in(std::env::args_os()), message.trim_start_matches("error: ").trim_end(), code);
    }
    ExitCode::from(code)
}

/// Runs a command line.
pub fn dispatch(cli: Cli) -> ExitCode {
    let (json, command) = (cli.global.json, cli.name.clone());
    // Without it, too, the command does what it can.
    let _ = app::signals::outlive_large_files();
    match check_built(&cli).and_then(|()| execute(cli)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { text, code }) => {
            // Paths, and errors of libraries about files, are untrusted text.
            let message = with_cause(text);
            let lines: Vec<_> = message.lines().map(|line| text::plain(line).into_owned()).collect();
            if !message.is_empty() {
                let message = format!("{} {}\n", Palette::for_output(&io::stderr()).bad("error:"), lines.join("\n"));
                outlet::write_within(io::stderr(), message, STDERR_TIMEOUT);
                if json {
                    print_ended(&command, &lines.join("\n"), code);
                }
            }
            ExitCode::from(code)
        }
    }
}

fn execute(cli: Cli) -> Result<(), Failure> {
    // Not locked: a command may write from another thread.
    let out = &mut io::stdout();
    let global = &cli.global;
    let format = if global.json { Format::Json } else { Format::Text };
    let Some(command) = cli.command else {
        return without_command(cli, format);
    };
    match command {
        Command::Check => reported(commands::check::check(&registry_path(global)?, format, out)?),
        Command::Devices { formats } => {
            let formats = if formats { Formats::Ask } else { Formats::Skip };
            devices(global, formats, format, out)
        }
        Command::Register(args) => register(global, &args, format, out),
        Command::Modules { name } => {
            let registry = find_registry(global).and_then(|path| load(&path).ok());
            Ok(commands::modules::modules(name.as_deref(), registry.as_ref(), format, out)?)
        }
        Command::Unregister(args) => unregister(global, &args, format, out),
        Command::Doctor { out: episodes } => {
            let registry = registry_path(global).and_then(|path| load(&path)).map_err(|failure| failure.text);
            let registry = registry.as_ref().map_err(String::as_str);
            if commands::doctor::doctor(registry, &episodes, format, out)? { Ok(()) } else { Err(Failure::printed(1)) }
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
        Command::Monitor { read_only, shown } => {
            let shown = ScreenOptions { utc: shown.utc, mouse: shown.mouse, tour: false };
            Ok(block_on(commands::monitor::monitor(global.instance.as_deref(), read_only, shown))??)
        }
        Command::Logs { device, follow, level, utc } => {
            let least = match level {
                LevelArg::Debug => Level::Debug,
                LevelArg::Info => Level::Info,
                LevelArg::Warn => Level::Warn,
                LevelArg::Error => Level::Error,
            };
            let zone = if utc { Zone::UTC } else { Zone::local() };
            let palette = Palette::for_output(&io::stdout());
            let options = LogsOptions { device, least, follow, zone, format, palette };
            Ok(commands::logs::logs(global.instance.as_deref(), &options, out)?)
        }
        Command::Reload => Ok(commands::session::reload(global.instance.as_deref(), format, out)?),
        Command::Episode { what } => {
            Ok(commands::session::ask(global.instance.as_deref(), &what.into_request(), format, out)?)
        }
        Command::Session { what } => {
            let request = what.map_or(SessionRequest::Show, SessionCommand::into_request);
            Ok(commands::session::ask(global.instance.as_deref(), &request, format, out)?)
        }
        Command::Calibrate { what: Calibration::Latency(args) } => calibrate(global, &args, format, out),
        Command::Inspect { paths, plot: Some(to) } => {
            reported(commands::plot::plot(&paths, to.as_deref(), format, out, &mut io::stderr())?)
        }
        Command::Inspect { paths, plot: None } => {
            let columns = rapid_screens::tui::columns().unwrap_or(100);
            let palette = Palette::for_output(&io::stdout());
            reported(commands::inspect::inspect(&paths, format, columns, palette, out)?)
        }
        Command::Label(args) => Ok(commands::notes::note(&args.file, &args.changes(), format, out)?),
        Command::List(args) => {
            let palette = Palette::for_output(&io::stdout());
            reported(commands::list::list(&args, format, palette, out, &mut |error| {
                print_warning(&format_args!("labels and notes are missing: {error}"));
            })?)
        }
        #[cfg(feature = "export")]
        Command::Export(args) => export(args, format),
        Command::Recover { paths } => recover(paths, format),
        Command::Ablation(args) => {
            let registry = registry_or_builtin(global)?;
            Ok(commands::ablation::ablation(&registry, global.config.as_deref(), &args, format, out)?)
        }
        #[cfg(feature = "policy")]
        Command::Policy { what } => policy::about(global, &what, format, out),
        #[cfg(feature = "policy")]
        Command::Eval(args) => policy::eval(args, format),
        Command::Replay(args) => replay(global, *args, format),
        Command::Completions { shell } => Ok(commands::completions::completions(&mut Cli::grammar(), shell, out)?),
        Command::Keys { schema } => Ok(commands::completions::keys(schema, out)?),
        Command::Man { to } => Ok(commands::completions::man(Cli::grammar(), &to, out)?),
    }
}

/// Plays an episode to a run, or compares a policy with it.
#[cfg_attr(not(feature = "policy"), expect(unused_variables, reason = "for a policy"))]
fn replay(global: &Global, args: ReplayArgs, format: Format) -> Result<(), Failure> {
    #[cfg(feature = "policy")]
    if args.infer.is_some() {
        return policy::compare(args, format);
    }
    let replay::Replayed { registry, scenario, length } = replay::scenario(&args.file).map_err(Failure::argument)?;
    let mut options = args.run;
    // Without a monitor, a replay ends where the episode does.
    if options.headless {
        options.duration.get_or_insert(length);
    }
    run(global, &options, (registry, Devices::Simulated(scenario)), 0, None)
}

fn calibrate(global: &Global, args: &LatencyArgs, format: Format, out: &mut dyn io::Write) -> Result<(), Failure> {
    let (registry, attached) = connected(global)?;
    Ok(block_on(commands::calibrate::latency(&registry, &attached, args, format, out))??)
}

/// Runs the rig, or records demonstrations of the simulated task.
fn without_command(cli: Cli, format: Format) -> Result<(), Failure> {
    let global = &cli.global;
    #[cfg(feature = "policy")]
    if cli.task.expert {
        return policy::demonstrate(global, &cli.run, &cli.task, format);
    }
    let is_shown = !cli.run.headless && !global.json && io::stdout().is_terminal() && io::stdin().is_terminal();
    let is_new = global.sim.is_none() && cli.policy.infer.is_none() && find_registry(global).is_none();
    let mut rig = if is_new && is_shown {
        // The first minutes: the screen asks for the names of what is plugged in.
        (Registry::empty(Path::new("devices.toml")), Devices::Machine)
    } else {
        rig(global, cli.task.seed)?
    };
    if cli.run.tour && global.sim == Some(None) {
        // A step of the tour ends with what its user does.
        rig.1 = Devices::Simulated(Scenario::quiet(&rig.0));
    }
    run(global, &cli.run, rig, cli.task.seed, Some(cli.policy))
}

fn reported(outcome: CommandStatus) -> Result<(), Failure> {
    match outcome {
        CommandStatus::Done => Ok(()),
        CommandStatus::BadConfiguration => Err(Failure::printed(2)),
    }
}

/// The registry and the devices of this machine or, with `--sim`, of a scenario.
fn rig(global: &Global, seed: u64) -> Result<(Registry, Devices), Failure> {
    let Some(scenario) = &global.sim else {
        return Ok((load(&registry_path(global)?)?, Devices::Machine));
    };
    if is_task(global) {
        let registry = Registry::task();
        let scenario = Scenario::task(&registry, seed);
        return Ok((registry, Devices::Simulated(scenario)));
    }
    let registry = registry_or_builtin(global)?;
    let scenario = match scenario {
        Some(file) => Scenario::load(file, &registry)?,
        None => Scenario::demo(&registry),
    };
    Ok((registry, Devices::Simulated(scenario)))
}

/// `--sim task`, the simulated task; a scenario file of that name is ./task.
fn is_task(global: &Global) -> bool {
    global.sim.as_ref().is_some_and(|scenario| scenario.as_deref() == Some(Path::new("task")))
}

fn mask(global: &Global, watch: bool) -> Result<(), Failure> {
    let path = mask_path(global.instance.as_deref());
    let json = json_path(&path);
    let names = || commands::mask::layout(&rapid_system::folder::read_text(&json, LARGEST_JSON).ok()?);
    let read = || read_mask(&path).map_err(|error| no_mask(&error));
    let options = MaskOptions { watch, json: global.json, palette: Palette::for_output(&io::stdout()) };
    let stop = CancellationToken::new();
    block_on(async {
        let interrupted = stop.clone();
        tokio::spawn(async move {
            if tokio::signal::ctrl_c().await.is_ok() {
                interrupted.cancel();
            }
        });
        Ok(commands::mask::run(read, names, rapid_core::time::realtime_ns, options, stop, io::stdout()).await?)
    })?
}

/// Why there is no mask to read; without one of this name, also which there are.
fn no_mask(error: &PresenceError) -> String {
    let others = match error {
        PresenceError::NotPublished { .. } => presence::instances(&mask_path(None)),
        _ => Vec::new(),
    };
    let command = |name: &String| match name.as_str() {
        "" => "rapid mask".to_owned(),
        name => format!("rapid mask --instance {name}"),
    };
    let commands: Vec<_> = others.iter().map(command).collect();
    if commands.is_empty() { error.to_string() } else { format!("{error}; running: {}", commands.join(", ")) }
}

fn recover(paths: Vec<PathBuf>, format: Format) -> Result<(), Failure> {
    // Files that are already repaired stay repaired.
    let (outcome, written) = until_interrupted("the repair", move |stop| {
        commands::recover::run(&paths, format, stop, &mut io::stdout(), &mut io::stderr())
    })?;
    if outcome.is_done() { Ok(written?) } else { Err(Failure::printed(argument_code(outcome.is_bad_argument()))) }
}

#[cfg(feature = "export")]
fn export(args: crate::cli::ExportArgs, format: Format) -> Result<(), Failure> {
    let exported = until_interrupted("the export", move |stop| {
        commands::export::export(&args, format, stop, &mut io::stdout(), &mut io::stderr())
    })?;
    if exported? { Ok(()) } else { Err(Failure::printed(1)) }
}

/// Does `work`, called `what`, which ends soon after its argument is set: that is at the first interrupt.
fn until_interrupted<T: Send + 'static>(
    what: &'static str,
    work: impl FnOnce(&AtomicBool) -> T + Send + 'static,
) -> Result<T, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    let requested = Arc::clone(&stop);
    let ended = block_on(async move {
        let mut work = tokio::task::spawn_blocking(move || work(&requested));
        let interrupted = tokio::select! {
            done = &mut work => return Ok(done),
            interrupted = tokio::signal::ctrl_c() => interrupted,
        };
        interrupted?;
        stop.store(true, Ordering::Relaxed);
        tokio::select! {
            done = &mut work => Ok(done),
            // The disk may be slow.
            _ = tokio::signal::ctrl_c() => Err(Failure::from(AppError::InterruptedTwice)),
        }
    })??;
    ended.map_err(|_| AppError::Panicked(what).into())
}

/// Runs the rig of a registry, `(registry, devices)`.
fn run(
    global: &Global,
    args: &RunArgs,
    (mut registry, devices): (Registry, Devices),
    seed: u64,
    policy: Option<PolicyArgs>,
) -> Result<(), Failure> {
    registry.rig.observation_hz = args.rate.unwrap_or(registry.rig.observation_hz);
    registry.rig.sync_window = args.window.unwrap_or(registry.rig.sync_window);
    let episode = request(args, &registry)?;
    if args.record {
        check_writable(&args.out).map_err(Failure::argument)?;
    }
    let monitor = !args.headless && policy.as_ref().is_none_or(|policy| policy.infer.is_none() || policy.monitor);
    let screen = match (monitor && io::stdout().is_terminal(), global.json) {
        (_, true) => Screen::Json,
        (false, false) => Screen::Lines,
        (true, false) => Screen::Monitor,
    };
    let options = Options {
        policy: policy_of(policy, seed, &registry)?,
        registry,
        devices,
        screen,
        shown: ScreenOptions { utc: args.shown.utc, mouse: args.shown.mouse, tour: args.tour },
        episode,
        plan: plan(args),
        record: args.record,
        arm: args.arm,
        duration: args.duration,
        instance: global.instance.clone(),
        group_control: args.group_control,
        servers: servers(args),
    };
    Ok(block_on(app::run(options))??)
}

/// The policy of a run, if one was requested.
#[cfg_attr(not(feature = "policy"), expect(unused_variables, clippy::unnecessary_wraps, reason = "for a policy"))]
fn policy_of(args: Option<PolicyArgs>, seed: u64, registry: &Registry) -> Result<Option<Box<dyn Policy>>, Failure> {
    match args {
        #[cfg(feature = "policy")]
        Some(args) if args.infer.is_some() => Ok(Some(Box::new(policy::options(args, seed, registry)?))),
        _ => Ok(None),
    }
}

/// The servers of a run that were requested.
#[cfg_attr(not(any(feature = "foxglove", feature = "web")), expect(unused_variables, reason = "there is no server"))]
fn servers(args: &RunArgs) -> Vec<Box<dyn Server>> {
    let requested: Vec<Option<Box<dyn Server>>> = Vec::from([
        #[cfg(feature = "foxglove")]
        args.foxglove_server.foxglove.map(|address| -> Box<dyn Server> {
            let args = &args.foxglove_server;
            let (control, origins) = (args.foxglove_control, args.foxglove_origin.clone());
            Box::new(app::FoxgloveOptions { address, control, origins })
        }),
        #[cfg(feature = "web")]
        args.web.web.map(|address| -> Box<dyn Server> {
            Box::new(app::WebOptions { address, token: args.web.web_token.clone() })
        }),
    ]);
    requested.into_iter().flatten().collect()
}

/// Refuses options of what this program was built without.
fn check_built(cli: &Cli) -> Result<(), Failure> {
    let replay = if let Some(Command::Replay(args)) = &cli.command { Some(args) } else { None };
    let run = replay.map_or(&cli.run, |replay| &replay.run);
    let infers = cli.policy.infer.is_some() || cli.task.expert || replay.is_some_and(|replay| replay.infer.is_some());
    let requested = [
        ("foxglove", cfg!(feature = "foxglove"), run.foxglove_server.foxglove.is_some(), "--foxglove"),
        ("policy", cfg!(feature = "policy"), infers, "--infer and --expert"),
        ("web", cfg!(feature = "web"), run.web.web.is_some(), "--web"),
    ];
    let missing = requested.into_iter().find(|&(_, is_built, is_requested, _)| is_requested && !is_built);
    missing.map_or(Ok(()), |(feature, _, _, options)| {
        Err(Failure::argument(format_args!(
            "this rapid was built without `{feature}`: build it with `cargo build --release --features {feature}`, or leave \
             {options} out"
        )))
    })
}

/// The episodes to record, if the registry knows the modules that were named.
fn request(args: &RunArgs, registry: &Registry) -> Result<EpisodeRequest, Failure> {
    let mounted = rapid_registry::mounted(&registry.modules, &args.module)?;
    Ok(EpisodeRequest {
        out: args.out.clone(),
        task: args.task.clone(),
        tags: args.tag.clone(),
        modules: mounted.into_iter().map(|module| module.name.clone()).collect(),
        duration: args.duration,
        taken: Vec::new(),
    })
}

/// What the session is to collect.
fn plan(args: &RunArgs) -> Plan {
    Plan {
        task: args.task.clone(),
        tags: args.tag.iter().cloned().collect(),
        goal: args.goal,
        episode_time: args.episode_time,
        reset_time: args.reset_time,
        countdown: args.countdown,
    }
}

/// Refuses a folder that cannot be written to, before any device is started.
fn check_writable(out: &Path) -> Result<(), RecordError> {
    record::open_folder(out)?;
    let enter_and_write = rustix::fs::Access::WRITE_OK | rustix::fs::Access::EXEC_OK;
    rustix::fs::access(out, enter_and_write)
        .map_err(|error| RecordError::Io { path: out.to_owned(), source: error.into() })
}

/// Runs `work` on a separate runtime, and afterwards does not wait for other threads: one that is still opening an
/// unresponsive device would delay the exit for as long as the kernel blocks it.
fn block_on<T>(work: impl Future<Output = T>) -> Result<T, Failure> {
    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    // Devices are opened in threads of their own, seldom: what is at rest holds no thread for the next one.
    let runtime = runtime.enable_all().thread_name("worker").thread_keep_alive(IDLE_THREAD).build()?;
    let done = catch_unwind(AssertUnwindSafe(|| runtime.block_on(work)));
    runtime.shutdown_timeout(TASKS_TIMEOUT);
    done.map_err(|_| Failure::panicked())
}

/// Why a command failed: the text to print, if it was not printed already, and the exit code: 1 failed while running, 2
/// invalid configuration or arguments, 3 a required device is missing, 4 a BAD episode, 130 interrupted twice.
#[derive(Debug)]
struct Failure {
    text: String,
    code: u8,
}

impl Failure {
    /// A reader that has closed the output needs no message, and what the command did is done.
    fn new(text: String, code: u8) -> Self {
        // EPIPE, as worded by the standard library.
        if text.ends_with("(os error 32)") { Self::printed(0) } else { Self { text, code } }
    }

    /// The reason has been printed.
    const fn printed(code: u8) -> Self {
        Self { text: String::new(), code }
    }

    /// An argument, or a file that it names, is invalid.
    #[expect(clippy::needless_pass_by_value, reason = "for `map_err`")]
    fn argument(reason: impl ToString) -> Self {
        Self { text: reason.to_string(), code: 2 }
    }

    /// Devices and files have been released while unwinding.
    fn panicked() -> Self {
        Self { text: "rapid panicked; please report this".to_owned(), code: 1 }
    }

    fn no_registry() -> Self {
        let places: Vec<_> = usual_places().iter().map(|path| path.display().to_string()).collect();
        Self::argument(format_args!(
            "no devices.toml: looked for {}\n    fix: register what is plugged in (`rapid register`, or `rapid` on a terminal), name a registry \
             with --config, or try `rapid --sim`",
            places.join(", ")
        ))
    }
}

/// The exit code of each kind of error.
macro_rules! failures {
    ($($(#[$when:meta])* $error:ty: $code:expr;)+) => {$(
        $(#[$when])*
        impl From<$error> for Failure {
            fn from(error: $error) -> Self {
                let code: fn(&$error) -> u8 = $code;
                Self::new(error.to_string(), code(&error))
            }
        }
    )+};
}

/// The exit code of a failure, by whether an invalid argument caused it.
const fn argument_code(is_bad_argument: bool) -> u8 {
    if is_bad_argument { 2 } else { 1 }
}

/// The exit code of a file that cannot be read.
fn read_code(error: &ReadError) -> u8 {
    match error {
        ReadError::NotMcap(_) | ReadError::NotFile(_) => 2,
        ReadError::Io { source, .. } => {
            argument_code(matches!(source.kind(), io::ErrorKind::NotFound | io::ErrorKind::IsADirectory))
        }
    }
}

failures! {
    AppError: |error| match error {
        AppError::InterruptedTwice => 130,
        AppError::Bad { .. } => 4,
        AppError::Required(_) => 3,
        AppError::Logging(_) => 2,
        _ => 1,
    };
    RegistryErrors: |_| 2;
    ModuleError: |_| 2;
    PresenceError: |_| 1;
    HotplugError: |_| 1;
    ReadError: read_code;
    commands::artifacts::ArtifactsError: |_| 1;
    commands::register::RegisterError: |error| argument_code(error.is_bad_argument());
    commands::modules::ModulesError: |error| argument_code(!matches!(error, commands::modules::ModulesError::Output(_)));
    commands::session::RequestError: |_| 1;
    commands::notes::NoteError: |error| {
        let is_argument = matches!(error, NoteError::NoEpisode(_) | NoteError::Beyond { .. } | NoteError::Nothing);
        if is_argument { 2 } else { 1 }
    };
    commands::logs::LogsError: |error| match error {
        commands::logs::LogsError::NoDevice { .. } => 2,
        commands::logs::LogsError::Monitor(_) | commands::logs::LogsError::Output(_) => 1,
    };
    commands::monitor::MonitorError: |_| 1;
    commands::arm::OrderError: |error| match error {
        commands::arm::OrderError::Give(_) => 3,
        commands::arm::OrderError::Output(_) => 1,
    };
    commands::mask::MaskError: |_| 1;
    commands::plot::PlotError: |error| match error {
        commands::plot::PlotError::Episode(error) => read_code(error),
        commands::plot::PlotError::Foreign(_)
        | commands::plot::PlotError::NoFolder(_)
        | commands::plot::PlotError::Several { .. }
        | commands::plot::PlotError::Twice { .. } => 2,
        _ => 1,
    };
    commands::list::ListError: |error| match error {
        commands::list::ListError::Date { .. } => 2,
        commands::list::ListError::Episode(error) => read_code(error),
        commands::list::ListError::Output(_) => 1,
    };
    #[cfg(feature = "export")]
    commands::export::ExportError: |error| match error {
        commands::export::ExportError::Episodes(error) => read_code(error),
        commands::export::ExportError::NoEpisodes(_)
        | commands::export::ExportError::Set(
            rapid_export::SetError::Foreign { .. }
            | rapid_export::SetError::Pictures { .. }
            | rapid_export::SetError::Ffmpeg(
                rapid_export::FfmpegError::Missing { .. } | rapid_export::FfmpegError::Encoder { .. },
            ),
        ) => 2,
        _ => 1,
    };
    commands::calibrate::CalibrateError: |error| argument_code(error.is_bad_argument());
    commands::ablation::AblationError: |error| argument_code(error.is_bad_argument());
    #[cfg(feature = "policy")]
    commands::eval::EvalError: |error| argument_code(matches!(error, commands::eval::EvalError::Bundle(_)));
    #[cfg(feature = "policy")]
    commands::policy::ShowError: |error| argument_code(error.is_bad_argument());
    #[cfg(feature = "policy")]
    CompareFailure: |error| argument_code(matches!(
        error,
        CompareFailure::Bundle(_)
            | CompareFailure::Compare(
                CompareError::File(_)
                    | CompareError::Registry { .. }
                    | CompareError::Unsuited { .. }
                    | CompareError::Nothing(_)
            )
    ));
    #[cfg(feature = "policy")]
    commands::demonstrate::DemonstrateError: |_| 1;
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Self::new(format!("output: {error}"), 1)
    }
}

impl From<InspectFailure> for Failure {
    fn from(failure: InspectFailure) -> Self {
        match failure {
            InspectFailure::Episode(error) => error.into(),
            InspectFailure::Output(error) => error.into(),
        }
    }
}

/// The failure's text, or its cause if that is the limit of open files: then the file that could not be opened is
/// not at fault.
fn with_cause(text: String) -> String {
    // EMFILE and ENFILE, as worded by the standard library.
    if text.contains("(os error 24)") {
        let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
        let limit = limit.map_or_else(String::new, |limit| format!(" of {limit} open files"));
        return format!("the limit{limit} is reached: raise it (`ulimit -n 4096`, or LimitNOFILE= in the unit)");
    }
    if text.contains("(os error 23)") {
        return "this machine has too many files open (sysctl fs.file-max): end the programs that opened them, or raise the limit"
            .to_owned();
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_blocked_in_a_device_does_not_delay_the_exit() {
        let (release, stuck) = std::sync::mpsc::channel::<()>();
        let done = block_on(async move {
            let (started, wait) = tokio::sync::oneshot::channel();
            tokio::task::spawn_blocking(move || {
                let _ = started.send(());
                stuck.recv()
            });
            wait.await.expect("started");
            7
        });
        assert_eq!(done.expect("runtime"), 7);
        // The device answers only now: a runtime that waited for it would not have got here.
        drop(release);
    }
}

#[cfg(test)]
mod failure_tests {
    use rapid_system::folder::FolderError;

    use super::*;

    #[test]
    fn at_the_limit_of_open_files_the_error_names_the_limit_and_not_the_file() {
        let of = |code| {
            let error = io::Error::from_raw_os_error(code);
            let folder = FolderError::Io { path: PathBuf::from("out"), error };
            with_cause(RecordError::Folder(folder).to_string())
        };
        let text = of(24);
        assert!(text.contains("open files is reached") && text.contains("ulimit -n"), "{text}");
        assert!(text.contains("LimitNOFILE=") && !text.contains("--out"), "{text}");
        assert!(of(23).contains("fs.file-max"), "{}", of(23));
        assert!(of(13).contains("--out") && of(13).contains("Permission denied"), "{}", of(13));
    }
}
