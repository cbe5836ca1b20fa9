//! The command line: what can be typed, and nothing of what it does.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{ArgAction, ArgMatches, Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueHint};

mod ablation;
mod calibrate;
mod compare;
mod policy;
mod register;

pub use ablation::{AblationArgs, Count};
pub use calibrate::Calibration;
pub use compare::CompareArgs;
pub use policy::{EvalArgs, PolicyArgs};
pub use register::{RegisterArgs, UnregisterArgs};

/// Records robot demonstrations from sensors that come and go
#[derive(Debug, Parser)]
#[command(
    version, long_version = LONG_VERSION, max_term_width = 100, after_help = EXAMPLES, override_usage = "rapid [OPTIONS]\n       rapid <COMMAND> [OPTIONS]",
    disable_help_flag = true, disable_version_flag = true
)]
pub struct Cli {
    /// What to do instead of running the rig.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Options of a run.
    #[command(flatten)]
    pub run: RunArgs,
    /// A policy at the controls.
    #[command(flatten)]
    pub policy: PolicyArgs,
    /// Where devices come from.
    #[command(flatten, next_help_heading = RUN)]
    pub simulation: SimArgs,
    /// Options that every command understands.
    #[command(flatten)]
    pub global: Global,
    /// Print version
    #[arg(long, short = 'V', action = ArgAction::Version, help_heading = GENERAL)]
    version: Option<bool>,
}

/// `rapid --version`; `-V` says the first line alone.
const LONG_VERSION: &str =
    concat!(env!("CARGO_PKG_VERSION"), "\n", env!("RAPID_BUILT_WITH"), "\n", env!("RAPID_BUILT_WITH_CXX"));

const EXAMPLES: &str = "\
Without a command, rapid runs the rig and shows the monitor: it finds the sensors that devices.toml \
names, streams them, publishes the Physical Mask and records episodes (space starts and ends one).

Examples:
  rapid --sim                           look around, without any hardware
  rapid devices                         what is plugged in, and which entry it is
  rapid                                 the monitor on the real rig
  rapid --headless --record --duration 30s --task \"place block\" --tag finger=soft
  rapid --infer --sim task --duration 20s         a policy sorts a simulated block
  rapid inspect episodes/20260101_place-block_001.mcap
  rapid recover episodes                after a crash: makes the unfinished episodes whole

Exit codes: 0 done, 1 failed while running, 2 bad configuration or arguments,
            3 a device that is needed is not there,
            4 without a screen: an episode is BAD, 130 interrupted twice";

const RECOVER: &str = "\
A run that may record does this by itself, in the background, for what it finds in its --out folder.

X.mcap.partial becomes X.mcap, and is kept as X.mcap.damaged if anything of it was left out. \
Of a cut or damaged X.mcap a whole X.recovered.mcap is made beside it. A file being written is left alone.

Examples:
  rapid recover episodes
  rapid recover copied/20260101_place-block_001.mcap";

const RUN: &str = "Options of a run";
const GENERAL: &str = "General options";

/// Options that every command understands, before or after it.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = GENERAL)]
pub struct Global {
    /// Registry [default: devices.toml here, ~/.config/rapid/ or /etc/rapid/]
    #[arg(long, short, global = true, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub config: Option<PathBuf>,
    /// JSON objects, one a line, instead of text
    #[arg(long, global = true)]
    pub json: bool,
    /// Name of this rig, to run beside another one on the same machine
    #[arg(long, global = true, value_name = "NAME", value_parser = instance)]
    pub instance: Option<String>,
    /// Print help
    #[arg(long, short, global = true, action = ArgAction::Help)]
    help: Option<bool>,
}

/// Where devices come from.
#[derive(Debug, Clone, Args)]
pub struct SimArgs {
    /// Simulated devices: those of the registry, what a scenario file says, or `task`, a robot that sorts blocks
    #[arg(long, value_name = "SCENARIO", num_args = 0..=1, value_hint = ValueHint::FilePath)]
    pub sim: Option<Option<PathBuf>>,
}

/// Options of a run.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = RUN)]
#[expect(clippy::struct_excessive_bools, reason = "each is a switch of the command line")]
pub struct RunArgs {
    /// Lines instead of the monitor
    #[arg(long)]
    pub headless: bool,
    /// Record an episode from the start
    #[arg(long)]
    pub record: bool,
    /// End after so much recording, or running if nothing is recorded: 30s, 5m
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub duration: Option<Duration>,
    /// Folder for episodes
    #[arg(long, value_name = "DIR", default_value = "episodes", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// What is demonstrated; also in the file's name
    #[arg(long, value_name = "TEXT", default_value = "episode")]
    pub task: String,
    /// Property of the episode, such as finger=soft; may be repeated
    #[arg(long, value_name = "KEY=VALUE", value_parser = tag)]
    pub tag: Vec<(String, String)>,
    /// Module that is mounted and has no sensor of its own; may be repeated
    #[arg(long, value_name = "NAME")]
    pub module: Vec<String>,
    /// Observations a second [default: as the registry says]
    #[arg(long, value_name = "HZ", value_parser = rate)]
    pub rate: Option<f64>,
    /// Number of the first trial of `--sim task`, and of the noise of a policy
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// With `--sim task --record`: a script that knows the task demonstrates it, faster than real time
    #[arg(long, requires = "record")]
    pub expert: bool,
    /// Demonstrations to record, each of another trial
    #[arg(long, value_name = "COUNT", default_value_t = 1, requires = "expert")]
    pub episodes: usize,
    /// Let the actuator move as soon as it is there; without this `rapid arm` or a key of the monitor does
    #[arg(long)]
    pub arm: bool,
    /// Half width of an observation's window [default: as the registry says]
    #[arg(long, value_name = "TIME", value_parser = window)]
    pub window: Option<Duration>,
}

/// What to do instead of running the rig.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Lists what is plugged in, which entry of the registry it is, and if none, why not
    #[command(after_help = "Examples:\n  rapid devices --formats        with what the cameras offer\n  \
        rapid devices --sim            how the simulated rig is matched")]
    Devices {
        /// Also list formats and controls of cameras
        #[arg(long)]
        formats: bool,
        /// Where devices come from.
        #[command(flatten)]
        simulation: SimArgs,
    },
    /// Adds an entry to the registry for a device that is plugged in
    #[command(after_help = register::REGISTER)]
    Register(Box<RegisterArgs>),
    /// Takes an entry out of the registry; everything else in it stays as it is
    Unregister(UnregisterArgs),
    /// Checks the registry and says everything that is wrong with it
    Check,
    /// Looks for what on this machine stands in the way: bandwidth, permissions, rules, limits, disk
    #[command(after_help = "Exit code: 0 if nothing is bad, otherwise 1.\n\nExamples:\n  rapid doctor\n  \
        rapid doctor --out /data/episodes      that disk\n  \
        rapid doctor --json | jq -r 'select(.level == \"bad\") | .fix'")]
    Doctor {
        /// Folder for episodes, whose disk is tried
        #[arg(long, value_name = "DIR", default_value = "episodes", value_hint = ValueHint::DirPath)]
        out: PathBuf,
    },
    /// Writes what follows from the registry: udev rules, descriptors, systemd unit
    #[command(after_help = "Examples:\n  rapid artifacts                look at them first, in udev/\n  \
        sudo rapid artifacts --install")]
    Artifacts {
        /// Copy them into /etc and make udev read them (needs root)
        #[arg(long, conflicts_with = "to")]
        install: bool,
        /// Where to write them
        #[arg(long, value_name = "DIR", default_value = "udev", value_hint = ValueHint::DirPath)]
        to: PathBuf,
    },
    /// Measures a property of a sensor
    Calibrate {
        /// Which property.
        #[command(subcommand)]
        what: Calibration,
    },
    /// Prints the Physical Mask that a running rapid publishes
    Mask {
        /// Print every change until interrupted
        #[arg(long)]
        watch: bool,
    },
    /// Lets the actuator of a running rapid move: motors are enabled, and follow actions
    #[command(
        after_help = "An actuator that was unplugged, failed, was disarmed or got no actions for a while needs this again, and \
        so does one that an emergency stop or an enabling switch has stopped. It is refused while one of these does not \
        run.\n\nExamples:\n  \
        rapid arm\n  rapid arm --instance left\n  rapid arm --drive-back"
    )]
    Arm {
        /// Drive joints that are outside their limits back into them, slowly: without this the arm is refused. Stand clear
        #[arg(long)]
        drive_back: bool,
    },
    /// Stops the actuator of a running rapid: its motors are disabled
    #[command(
        after_help = "It holds for the rest of the run, with or without an actuator, until the next arm, and needs neither \
        disk nor shared memory.\n\nExamples:\n  rapid disarm\n  rapid disarm --instance left"
    )]
    Disarm,
    /// Tells what an episode holds: verdict, rates, gaps, lateness, presence over time
    #[command(after_help = "Of one file a report; of a folder or of several files one line each, GOOD, SUSPECT or \
        BAD.\n\nExamples:\n  rapid inspect episodes/20260101_place-block_001.mcap\n  rapid inspect episodes\n  \
        rapid inspect --json episodes | jq -r 'select(.verdict == \"GOOD\") | .file'")]
    Inspect {
        /// Episodes, finished or .partial, or folders of them
        #[arg(value_hint = ValueHint::AnyPath, value_name = "FILE|DIR", required = true)]
        paths: Vec<PathBuf>,
    },
    /// Makes whole episodes of those that were not finished: after a kill, a loss of power, a full disk
    #[command(after_help = RECOVER)]
    Recover {
        /// Episodes, or folders: of a folder every .partial is repaired
        #[arg(required = true, value_name = "FILE|DIR", value_hint = ValueHint::AnyPath)]
        paths: Vec<PathBuf>,
    },
    /// Plays an episode as if its devices were plugged in
    #[command(after_help = compare::REPLAY)]
    Replay {
        /// Episode
        #[arg(value_hint = ValueHint::FilePath)]
        file: PathBuf,
        /// Options of the run.
        #[command(flatten)]
        run: RunArgs,
        /// Options of a comparison.
        #[command(flatten)]
        compare: CompareArgs,
    },
    /// Tries a policy on the simulated task, with a sensor that is pulled out
    #[command(after_help = policy::EVAL)]
    Eval(EvalArgs),
    /// Lists the configurations of a comparison, the episodes recorded of each, and what is next
    #[command(after_help = ablation::ABLATION)]
    Ablation(AblationArgs),
    /// Prints a completion script: source <(rapid completions bash)
    Completions {
        /// Shell
        shell: clap_complete::Shell,
    },
}

impl Cli {
    /// Reads what was typed, the name of the program first.
    ///
    /// # Errors
    /// When it makes no sense; help and version are such an "error" too.
    pub fn read(typed: impl IntoIterator<Item = OsString>) -> Result<Self, clap::Error> {
        let typed: Vec<_> = typed.into_iter().collect();
        let mut command = Self::command();
        if typed.get(1).is_some_and(|first| first == "-h") {
            command = command.after_help("--help adds examples and exit codes");
        }
        let matches = command.try_get_matches_from_mut(typed).map_err(|error| explained(error, &mut command))?;
        let cli = Self::from_arg_matches(&matches)?;
        if let Some((name, _)) = matches.subcommand()
            && let Some(option) = stray(&matches, name)
        {
            let text = match name {
                "replay" => {
                    format!("--{option} stands before the command; write it after: rapid replay FILE --{option}")
                }
                _ => format!("--{option} is an option of a run, and `rapid {name}` runs nothing: leave it out"),
            };
            return Err(command.error(ErrorKind::ArgumentConflict, text));
        }
        if let Some(("replay", typed)) = matches.subcommand()
            && let Some(text) = compare::conflict(typed)
        {
            return Err(command.error(ErrorKind::ArgumentConflict, text));
        }
        let tags = match &cli.command {
            Some(Command::Replay { run, .. }) => &run.tag,
            _ => &cli.run.tag,
        };
        if let Some(key) = repeated(tags) {
            let text =
                format!("--tag {key} is given more than once, and an episode has one value of each: leave one out");
            return Err(command.error(ErrorKind::ArgumentConflict, text));
        }
        if let Some(Some(file)) = &cli.simulation.sim
            && let Some(name) = file.to_str().filter(|name| command.find_subcommand(name).is_some())
        {
            let fix = match name {
                "devices" => "write `rapid devices --sim`",
                "register" => "write `rapid register --sim`",
                "calibrate" => "write `rapid calibrate latency --sim`",
                _ => "leave --sim out, or name a scenario file",
            };
            let text = format!("--sim takes {name:?} for the name of a scenario file: {fix}");
            return Err(command.error(ErrorKind::ArgumentConflict, text));
        }
        Ok(cli)
    }
}

/// A key with more than one value.
fn repeated(tags: &[(String, String)]) -> Option<&str> {
    let is_again =
        |(place, (key, _)): &(usize, &(String, String))| tags.iter().take(*place).any(|(before, _)| before == key);
    tags.iter().enumerate().find(is_again).map(|(_, (key, _))| key.as_str())
}

/// An option of a run before a command that would not look at it.
fn stray(matches: &ArgMatches, command: &str) -> Option<String> {
    let run = RunArgs::augment_args(clap::Command::new("run"));
    let policy = PolicyArgs::augment_args(clap::Command::new("run"));
    let simulation = SimArgs::augment_args(clap::Command::new("run"));
    // `rapid --sim --json devices` is understood.
    let known = run
        .get_arguments()
        .chain(policy.get_arguments())
        .chain(simulation.get_arguments().filter(|_| !matches!(command, "devices" | "calibrate" | "register")));
    let typed = |id: &str| matches.value_source(id) == Some(ValueSource::CommandLine);
    known.map(|argument| argument.get_id().as_str()).find(|id| typed(id)).map(str::to_owned)
}

/// A file where a command should stand: says where files stand.
fn explained(error: clap::Error, command: &mut clap::Command) -> clap::Error {
    let (ErrorKind::InvalidSubcommand, Some(ContextValue::String(word))) =
        (error.kind(), error.get(ContextKind::InvalidSubcommand))
    else {
        return error;
    };
    let place = match word.rsplit_once('.') {
        Some((_, "toml")) => {
            format!("a scenario stands right after --sim (rapid --sim {word}), a registry after --config")
        }
        Some((_, "mcap" | "partial")) => format!("an episode stands after a command: rapid inspect {word}"),
        _ => return error,
    };
    command.error(ErrorKind::InvalidSubcommand, format!("{word:?} is no command; {place}"))
}

fn duration(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(Duration::ZERO) => Err("must be longer than nothing".to_owned()),
        Ok(duration) => Ok(duration),
        Err(_) => Err("write a number and a unit, for example 30s, 500ms or 2m".to_owned()),
    }
}

fn window(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(window) if (Duration::from_millis(1)..=Duration::from_secs(10)).contains(&window) => Ok(window),
        Ok(_) => Err("must lie between 1ms and 10s".to_owned()),
        Err(_) => Err("write a number and a unit, for example 25ms".to_owned()),
    }
}

fn rate(text: &str) -> Result<f64, String> {
    let hertz: f64 = text.parse().map_err(|_| "write a number, for example 30".to_owned())?;
    if (0.1..=1000.0).contains(&hertz) { Ok(hertz) } else { Err("must lie between 0.1 and 1000 Hz".to_owned()) }
}

fn tag(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("write KEY=VALUE, for example finger=soft".to_owned()),
    }
}

fn instance(text: &str) -> Result<String, String> {
    let plain = !text.is_empty() && text.len() <= 32 && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '-');
    if plain { Ok(text.to_owned()) } else { Err("1 to 32 letters, digits and dashes".to_owned()) }
}

#[cfg(test)]
mod tests;
