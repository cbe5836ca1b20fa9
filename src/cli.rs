//! The command line: its grammar, help and examples, but not the commands themselves.
//!
//! Invariant: a command shows and accepts only the options that have an effect on it.

#[cfg(feature = "export")]
mod export;
mod list;
mod measure;
mod notes;
mod policy;
mod registry;
mod run;
mod session;

use std::ffi::OsString;
use std::ops::RangeBounds;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{ArgAction, ArgMatches, Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum, ValueHint};
use rapid_registry::units::parse_duration;

#[cfg(feature = "export")]
pub use export::{ExportArgs, Layout, PictureForm};
pub use list::{LabelFilter, ListArgs, SortArg, VerdictArg};
pub use measure::{AblationArgs, Calibration, Count, LatencyArgs};
pub use notes::LabelArgs;
#[cfg(feature = "policy")]
pub use policy::{EvalArgs, ObserveArgs, PolicyCommand, ShowArgs};
pub use policy::{InferenceArgs, PolicyArgs, ReplayArgs};
pub use registry::{RegisterArgs, UnregisterArgs};
pub use run::{FoxgloveArgs, RunArgs, ShownArgs, TaskArgs, WebArgs};
pub use session::{EpisodeCommand, SessionCommand};

/// Record robot demonstrations with hot-plugged sensors
#[derive(Debug, Parser)]
#[command(
    version, long_version = LONG_VERSION, max_term_width = 100, after_long_help = EXAMPLES,
    override_usage = "rapid [COMMAND] [OPTIONS]", disable_help_flag = true,
    disable_version_flag = true, disable_help_subcommand = true
)]
pub struct Cli {
    /// What to do instead of running the rig.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Options of a run.
    #[command(flatten)]
    pub run: RunArgs,
    /// Options of the simulated task.
    #[command(flatten)]
    pub task: TaskArgs,
    /// Options of a policy.
    #[command(flatten)]
    pub policy: PolicyArgs,
    /// General options, of the commands in `general_options`.
    #[command(flatten)]
    pub global: Global,
    /// Name of the command, `run` without one.
    #[arg(skip)]
    pub name: String,
    /// Print version
    #[arg(long, short = 'V', action = ArgAction::Version, help_heading = GENERAL, hide_short_help = true)]
    version: Option<bool>,
}

/// `rapid --version`; `-V` prints only the first line.
#[cfg(feature = "policy")]
const LONG_VERSION: &str = rapid_policy::onnxruntime::LONG_VERSION;
#[cfg(not(feature = "policy"))]
const LONG_VERSION: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    "\nonnxruntime: none (built without `policy`)\nlibstdc++: none (built without `policy`)"
);

const EXAMPLES: &str = "\
Without a command, rapid runs the rig and opens the monitor: it finds the sensors that devices.toml \
declares, streams them, publishes the Physical Mask and records episodes (space starts and ends one).

Examples:
  rapid --sim                           a first look, without any hardware
  rapid devices                         what is plugged in, and which entry it matches
  rapid                                 the monitor on the real rig
  rapid --web 0.0.0.0                   also a page for a phone; W shows its link as a QR code
  rapid --headless --record --duration 30s --task \"place block\" --tag finger=soft
  rapid --infer --sim task --duration 20s         a policy sorts a simulated block
  rapid inspect episodes/20260101_place-block_001.mcap
  rapid recover episodes                after a crash: repairs unfinished episodes

Exit codes: 0 success, 1 failed while running, 2 invalid configuration or arguments,
            3 a required device is missing,
            4 without the monitor: an episode is BAD, 130 interrupted twice";

const INSPECT: &str = "\
One file gives a report; a folder or several files one line each: GOOD, SUSPECT or BAD. With --plot each gives a \
picture instead, X.svg beside X.mcap: verdict, and the presence, rate, losses and pictures of each sensor over time. \
A file of that name that is not such a picture is not replaced.

Examples:
  rapid inspect episodes/20260101_place-block_001.mcap
  rapid inspect episodes/20260101_place-block_001.mcap --plot
  rapid inspect episodes --plot=pictures/
  rapid inspect episodes
  rapid inspect --json episodes | jq -r 'select(.verdict == \"GOOD\") | .file'";

const RECOVER: &str = "\
A run that may record does this automatically, in the background, for the files in its --out folder.

X.mcap.partial becomes X.mcap, and is kept as X.mcap.damaged if any of its data had to be left out. \
A truncated or damaged X.mcap is repaired into X.recovered.mcap beside it. A file that is being written \
is left alone.

Examples:
  rapid recover episodes
  rapid recover copied/20260101_place-block_001.mcap";

const MONITOR: &str = "\
It shows a rapid that runs without a screen, as a service or in another terminal, with the same keys; up to eight \
may be attached, `rapid logs -f` among them. The run continues when the monitor or its connection ends. When the run ends, the \
monitor shows its last state and waits for the next.

The user of the run and root may attach; if the run was started with --group-control, as the service is, so may the \
members of its group.

Examples:
  rapid monitor
  rapid monitor --read-only --instance left
  ssh -t rig rapid monitor                on another machine";

/// What a run without a command is called in JSON.
const RUN_NAME: &str = "run";

const RELOAD: &str = "\
The running rapid reads its devices.toml again. Entries that were added, each with a free bit, get a topic and a bit of \
the mask while everything else continues; a device that is plugged in starts. They are recorded from the next episode on.

Any other change needs a restart: then nothing is changed, the reasons are printed, and the exit code is 1.

Examples:
  rapid register && rapid reload
  rapid reload --instance left --json";

const GENERAL: &str = "General options";

/// Options of several commands, accepted before or after the command.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = GENERAL)]
pub struct Global {
    /// Simulate the registry, a scenario file, or `task`
    ///
    /// Without a value the devices of the registry are simulated; `task` is a robot that sorts blocks.
    #[arg(long, global = true, value_name = "SCENARIO", num_args = 0..=1, value_hint = ValueHint::FilePath)]
    pub sim: Option<Option<PathBuf>>,
    /// Registry [default: devices.toml]
    ///
    /// The default is the first devices.toml in the working directory, ~/.config/rapid and /etc/rapid.
    #[arg(long, short, global = true, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub config: Option<PathBuf>,
    /// Print JSON objects, one per line
    #[arg(long, global = true, hide_short_help = true)]
    pub json: bool,
    /// Name of this rig, if several run on one machine
    #[arg(long, global = true, value_name = "NAME", value_parser = instance, hide_short_help = true,
        env = "RAPID_INSTANCE", hide_env_values = true)]
    pub instance: Option<String>,
    /// Print help; --help adds all options and examples
    #[arg(long, short, global = true, action = ArgAction::Help)]
    help: Option<bool>,
}

/// The general options that have an effect on a command; the others are hidden there, and rejected.
fn general_options(command: &str) -> &'static [&'static str] {
    match command {
        "devices" | "register" | "calibrate" | "policy" => &["sim", "config", "json"],
        "unregister" | "modules" | "check" | "doctor" | "ablation" => &["config", "json"],
        "artifacts" => &["config"],
        "mask" | "replay" | "episode" | "session" | "reload" | "logs" => &["json", "instance"],
        "arm" | "disarm" | "monitor" => &["instance"],
        "inspect" | "label" | "list" | "recover" | "eval" | "export" => &["json"],
        _ => &[],
    }
}

/// What to do instead of running the rig.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// List connected devices and the registry entries they match
    #[command(after_long_help = "Examples:\n  rapid devices --formats        with the formats of the cameras\n  \
        rapid devices --sim            how the simulated rig is matched")]
    Devices {
        /// Also list formats and controls of cameras
        #[arg(long)]
        formats: bool,
    },
    /// Add an entry to the registry for a connected device
    #[command(after_long_help = registry::REGISTER)]
    Register(Box<RegisterArgs>),
    /// List the types of modules that `rapid register --module` knows
    #[command(
        after_long_help = "A file of the same form describes a type of your own.\n\nExamples:\n  rapid modules\n  \
        rapid modules tip_tactile > my_tip.toml && rapid register --module ./my_tip.toml"
    )]
    Modules {
        /// Print the descriptor of this one
        #[arg(value_name = "NAME", value_hint = ValueHint::FilePath)]
        name: Option<String>,
    },
    /// Remove an entry from the registry; the rest is kept unchanged
    #[command(after_long_help = "Examples:\n  rapid unregister cam_left --dry-run\n  rapid unregister cam_left --yes")]
    Unregister(UnregisterArgs),
    /// Check the registry and report every mistake in it
    #[command(after_long_help = "Exit code: 0 if the registry is valid, otherwise 2.\n\nExamples:\n  rapid check\n  \
        rapid check --config other.toml --json")]
    Check,
    /// Diagnose this machine: bandwidth, permissions, limits, disk
    #[command(after_long_help = "Exit code: 0 if nothing is bad, otherwise 1.\n\nExamples:\n  rapid doctor\n  \
        rapid doctor --out /data/episodes      that disk\n  \
        rapid doctor --json | jq -r 'select(.level == \"bad\") | .fix'")]
    Doctor {
        /// Folder for episodes, whose disk is tested
        #[arg(long, value_name = "DIR", default_value = "episodes", value_hint = ValueHint::DirPath)]
        out: PathBuf,
    },
    /// Write udev rules, systemd units and the layout of Foxglove
    #[command(
        after_long_help = "Files: udev rules, one descriptor per entry, a systemd unit, and a layout for Foxglove.\n\nExamples:\n  \
        rapid artifacts                to read them first, in udev/\n  \
        sudo install -D -m 644 devices.toml /etc/rapid/devices.toml\n  \
        sudo rapid --config /etc/rapid/devices.toml artifacts --install"
    )]
    Artifacts {
        /// Install them below /etc and reload udev (needs root)
        #[arg(long, conflicts_with = "to")]
        install: bool,
        /// Folder to write them to
        #[arg(long, value_name = "DIR", default_value = "udev", value_hint = ValueHint::DirPath)]
        to: PathBuf,
    },
    /// Measure a property of a sensor
    #[command(after_long_help = "Examples:\n  rapid calibrate latency --device cam_wrist\n  \
        rapid calibrate latency --help")]
    Calibrate {
        /// Which property.
        #[command(subcommand)]
        what: Calibration,
    },
    /// Print the Physical Mask that a running rapid publishes
    #[command(after_long_help = "Examples:\n  rapid mask\n  rapid mask --watch\n  \
        rapid mask --json --instance left | jq .mask")]
    Mask {
        /// Print every change until interrupted
        #[arg(long)]
        watch: bool,
    },
    /// Enable the actuator of a running rapid: motors follow actions
    #[command(
        after_long_help = "An actuator that was unplugged, failed, was disarmed or received no actions for a while must be \
        armed again, and so must one that was stopped by an emergency stop or an enabling switch. It is refused until \
        each of these permits motion.\n\nExamples:\n  rapid arm\n  rapid arm --instance left\n  rapid arm --drive-back"
    )]
    Arm {
        /// Drive joints slowly back inside their limits, if outside (else refused). Stand clear
        #[arg(long)]
        drive_back: bool,
    },
    /// Disable the actuator of a running rapid: its motors stop
    #[command(
        after_long_help = "It holds for the rest of the run, with or without an actuator, until the next arm, and needs \
        neither disk nor shared memory.\n\nExamples:\n  rapid disarm\n  rapid disarm --instance left"
    )]
    Disarm,
    /// Open the monitor of a running rapid, which continues without it
    #[command(after_long_help = MONITOR)]
    Monitor {
        /// Only look: no key changes anything in the run
        #[arg(long)]
        read_only: bool,
        /// How it is shown.
        #[command(flatten)]
        shown: ShownArgs,
    },
    /// Print the log of a running rapid, and what its programs print
    #[command(
        after_long_help = "It has the last 2000 lines; the files below ~/.local/state/rapid keep what programs printed \
        before.\n\nExamples:\n  rapid logs\n  rapid logs tactile_tip -f          one device and its programs, until the run ends\n  \
        rapid logs --level warn --utc"
    )]
    Logs {
        /// Only lines about this entry of the registry
        #[arg(value_name = "NAME")]
        device: Option<String>,
        /// Continue with new lines until the run ends
        #[arg(long, short)]
        follow: bool,
        /// Lowest severity shown: debug, info, warn or error
        #[arg(long, value_name = "LEVEL", default_value = "info", hide_possible_values = true)]
        level: LevelArg,
        /// Times in UTC instead of the zone of this machine
        #[arg(long)]
        utc: bool,
    },
    /// Apply entries added to the registry to a running rapid
    #[command(after_long_help = RELOAD)]
    Reload,
    /// Begin, end, discard or label episodes of a running rapid
    #[command(after_long_help = session::EPISODE)]
    Episode {
        /// What to do.
        #[command(subcommand)]
        what: EpisodeCommand,
    },
    /// Print or change what a running rapid collects
    #[command(after_long_help = session::SESSION)]
    Session {
        /// What to do.
        #[command(subcommand)]
        what: Option<SessionCommand>,
    },
    /// Report on episodes: verdict, rates, gaps, latency, presence
    #[command(after_long_help = INSPECT)]
    Inspect {
        /// Episodes, finished or .partial, or folders of them
        #[arg(value_hint = ValueHint::AnyPath, value_name = "FILE|DIR", required = true)]
        paths: Vec<PathBuf>,
        /// Draw each episode as an SVG: beside it, in a folder, under a name, or - for standard output
        #[arg(long, value_name = "SVG|DIR|-", num_args = 0..=1, require_equals = true, value_hint = ValueHint::AnyPath)]
        plot: Option<Option<PathBuf>>,
    },
    /// Label an episode of any folder, attach a note, mark moments
    #[command(after_long_help = notes::LABEL)]
    Label(LabelArgs),
    /// List episodes by verdict, label, task, tag, sensor or date
    #[command(after_long_help = list::LIST)]
    List(ListArgs),
    /// Export episodes as a LeRobot dataset
    #[cfg(feature = "export")]
    #[command(after_long_help = export::EXPORT)]
    Export(ExportArgs),
    /// Repair unfinished episodes after a kill, power loss or full disk
    #[command(after_long_help = RECOVER)]
    Recover {
        /// Episodes, or folders: in a folder every .partial is repaired
        #[arg(required = true, value_name = "FILE|DIR", value_hint = ValueHint::AnyPath)]
        paths: Vec<PathBuf>,
    },
    /// Replay an episode as if its devices were plugged in
    #[command(after_long_help = policy::REPLAY)]
    Replay(Box<ReplayArgs>),
    /// Show a policy: what it observes and moves, its speed here
    #[cfg(feature = "policy")]
    #[command(after_long_help = policy::POLICIES)]
    Policy {
        /// What about it.
        #[command(subcommand)]
        what: PolicyCommand,
    },
    /// Evaluate a policy on the simulated task with sensors unplugged
    #[cfg(feature = "policy")]
    #[command(after_long_help = policy::EVAL)]
    Eval(EvalArgs),
    /// List the configurations of a comparison and what to record next
    #[command(after_long_help = measure::ABLATION)]
    Ablation(AblationArgs),
    /// Print a shell completion script
    #[command(
        hide = true,
        after_long_help = "Examples:\n  source <(rapid completions bash)\n  \
        rapid completions fish >~/.config/fish/completions/rapid.fish"
    )]
    Completions {
        /// Shell
        shell: clap_complete::Shell,
    },
    /// Print the keys of the registry, or their JSON schema for editors
    #[command(hide = true, after_long_help = "Examples:\n  rapid keys\n  rapid keys --schema >devices.schema.json")]
    Keys {
        /// The JSON schema
        #[arg(long)]
        schema: bool,
    },
    /// Write the manual pages, one per command
    #[command(
        hide = true,
        after_long_help = "Examples:\n  rapid man && man ./man/rapid-replay.1\n  \
        sudo rapid man /usr/local/share/man/man1"
    )]
    Man {
        /// Folder to write them to
        #[arg(value_name = "DIR", default_value = "man", value_hint = ValueHint::DirPath)]
        to: PathBuf,
    },
}

/// A severity on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LevelArg {
    /// Everything.
    Debug,
    /// State changes, and what is more severe.
    Info,
    /// Warnings and errors.
    Warn,
    /// Errors.
    Error,
}

/// `rapid help COMMAND` is `rapid COMMAND --help`: the list of commands has no line for it.
fn without_help_first(typed: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut words: Vec<OsString> = typed.into_iter().collect();
    if words.get(1).is_some_and(|word| word == "help") {
        words.remove(1);
        words.push("--help".into());
    }
    words
}

impl Cli {
    /// Parses a command line, the name of the program first.
    ///
    /// # Errors
    /// When it is invalid; help and version are also such an "error".
    pub fn read(typed: impl IntoIterator<Item = OsString>) -> Result<Self, clap::Error> {
        let mut command = Self::grammar();
        let matches = command
            .try_get_matches_from_mut(without_help_first(typed))
            .map_err(|error| explained(error, &mut command))?;
        let mut cli = Self::from_arg_matches(&matches)?;
        matches.subcommand_name().unwrap_or(RUN_NAME).clone_into(&mut cli.name);
        let without_effect = || misplaced(&matches, &command).or_else(|| cli.without_effect(&matches));
        match without_effect().or_else(|| cli.contradiction(&command)) {
            Some(text) => Err(command.error(ErrorKind::ArgumentConflict, text)),
            None => Ok(cli),
        }
    }

    /// The name of the command in words that may not be a command line, `run` without one.
    pub fn name_in(typed: impl IntoIterator<Item = OsString>) -> String {
        let grammar = Self::command();
        let named = |word: OsString| Some(grammar.find_subcommand(word)?.get_name().to_owned());
        typed.into_iter().skip(1).find_map(named).unwrap_or_else(|| RUN_NAME.to_owned())
    }

    /// The grammar for parsing, help, completions and manual pages: without the general options that have no effect on
    /// a command.
    pub fn grammar() -> clap::Command {
        let command = Self::command();
        let general: Vec<_> = command.get_arguments().filter(|option| option.is_global_set()).cloned().collect();
        let command = command.mut_subcommands(|command| {
            let known = general_options(command.get_name());
            let hidden = general.iter().filter(|option| option.get_id() != "help");
            let hidden: Vec<_> = hidden.filter(|option| !known.contains(&option.get_id().as_str())).collect();
            command.args(hidden.into_iter().map(|option| option.clone().hide(true)))
        });
        // `rapid eval` has them too, without --infer.
        let require = |command: clap::Command| {
            let options = ["denoising_steps", "threads", "provider", "ort_lib"];
            options.into_iter().fold(command, |command, option| {
                command.mut_arg(option, |option| option.requires("infer").hide_short_help(true))
            })
        };
        require(command).mut_subcommand("replay", require)
    }

    /// An option of a run that has no effect beside the others, and the fix.
    fn without_effect(&self, matches: &ArgMatches) -> Option<String> {
        let (of_run, run) = match (&self.command, matches.subcommand()) {
            (None, _) => (matches, &self.run),
            (Some(Command::Replay(replay)), Some((_, of_command))) => (of_command, &replay.run),
            _ => return None,
        };
        let given = |id: &str| {
            of_run.try_contains_id(id).unwrap_or(false) && of_run.value_source(id) == Some(ValueSource::CommandLine)
        };
        if run.headless || self.policy.infer.is_some() && !self.policy.monitor {
            let why = if run.headless { "--headless does not open" } else { "--infer opens only with --monitor" };
            if let Some(shown) = ["tour", "mouse", "utc"].into_iter().find(|id| given(id)) {
                return Some(format!("--{shown} needs the monitor, which {why}: leave one of them out"));
            }
        }
        let is_task = self.global.sim.as_ref().and_then(Option::as_deref).is_some_and(|sim| sim == Path::new("task"));
        let is_used = is_task || self.policy.infer.is_some();
        (given("seed") && !is_used).then(|| {
            "--seed only affects `--sim task` and a policy (--infer), and there is neither: leave it out".to_owned()
        })
    }

    /// A combination of arguments that cannot be intended, and the fix.
    fn contradiction(&self, command: &clap::Command) -> Option<String> {
        let tags = match &self.command {
            Some(Command::Replay(replay)) => &replay.run.tag,
            _ => &self.run.tag,
        };
        if let Some(key) = repeated(tags) {
            return Some(format!("--tag {key} is given twice, and an episode has one value per key: leave one out"));
        }
        if let Some(Command::Inspect { paths, plot: Some(None) }) = &self.command
            && let Some(svg) = paths.iter().find(|path| path.extension().is_some_and(|ending| ending == "svg"))
        {
            let svg = svg.display();
            return Some(format!("{svg} is given as an episode; the name of the picture follows a `=`: --plot={svg}"));
        }
        if let Some(Command::Inspect { plot: Some(Some(to)), .. }) = &self.command
            && to.as_os_str() == "-"
            && self.global.json
        {
            return Some(
                "--plot=- writes a picture to standard output, and --json objects: leave one of them out".to_owned(),
            );
        }
        let file = self.global.sim.as_ref()?.as_ref()?.to_str()?;
        let name = command.find_subcommand(file)?.get_name();
        let fix = match name {
            "calibrate" => "write `rapid calibrate latency --sim`".to_owned(),
            name if general_options(name).contains(&"sim") => format!("write `rapid {name} --sim`"),
            _ => "leave --sim out, or name a scenario file".to_owned(),
        };
        Some(format!("--sim takes {name:?} for the name of a scenario file: {fix}"))
    }
}

/// A key with more than one value.
fn repeated(tags: &[(String, String)]) -> Option<&str> {
    let mut keys = std::collections::BTreeSet::new();
    tags.iter().map(|(key, _)| key.as_str()).find(|key| !keys.insert(*key))
}

/// An option that has no effect on the command it was given to, and the fix.
fn misplaced(matches: &ArgMatches, command: &clap::Command) -> Option<String> {
    let given = |matches: &ArgMatches, id: &str| matches.value_source(id) == Some(ValueSource::CommandLine);
    let (name, of_command) = matches.subcommand()?;
    let known = general_options(name);
    let stray = |option: &&clap::Arg| !known.contains(&option.get_id().as_str());
    if let Some(option) = command.get_arguments().filter(stray).find(|option| given(matches, option.get_id().as_str()))
    {
        let long = option.get_long()?;
        return Some(match name {
            _ if option.is_global_set() => format!("--{long} has no effect on `rapid {name}`: leave it out"),
            "replay" => format!("--{long} precedes the command; write it after: rapid replay FILE --{long}"),
            _ => format!("--{long} is an option of a run, and `rapid {name}` starts no run: leave it out"),
        });
    }
    if name != "replay" || !given(of_command, "infer") {
        return None;
    }
    let run = RunArgs::augment_args(clap::Command::new("run"));
    let option = run.get_arguments().find(|option| given(of_command, option.get_id().as_str()))?.get_long()?;
    Some(format!("--{option} is an option of a run, and --infer compares without one: leave one of them out"))
}

/// The error with its fix: where a file must be written, and where an option of a run.
fn explained(error: clap::Error, command: &mut clap::Command) -> clap::Error {
    let context = |kind| match error.get(kind) {
        Some(ContextValue::String(word)) => Some(word.as_str()),
        _ => None,
    };
    let text = if let Some(word) = context(ContextKind::InvalidSubcommand) {
        match word.rsplit_once('.') {
            Some((_, "toml")) => format!(
                "{word:?} is not a command; a scenario is given right after --sim (rapid --sim {word}), a registry after --config"
            ),
            Some((_, "mcap" | "partial")) => {
                format!("{word:?} is not a command; an episode is given after a command: rapid inspect {word}")
            }
            _ => return error,
        }
    } else if let Some(option) = context(ContextKind::InvalidArg).filter(|_| error.kind() == ErrorKind::UnknownArgument)
        && command.get_arguments().any(|known| known.get_long() == option.strip_prefix("--"))
    {
        format!("{option} is an option of a run (`rapid {option}`) and has no effect on this command: leave it out")
    } else {
        return error;
    };
    command.error(error.kind(), text)
}

/// A time in `range`, or else the error `wrong`; `example` shows the notation.
fn time(text: &str, range: impl RangeBounds<Duration>, wrong: &str, example: &str) -> Result<Duration, String> {
    match parse_duration(text) {
        Some(time) if range.contains(&time) => Ok(time),
        Some(_) => Err(wrong.to_owned()),
        None => Err(format!("write a number and a unit, for example {example}")),
    }
}

fn duration(text: &str) -> Result<Duration, String> {
    time(text, Duration::from_nanos(1).., "must be longer than 0s", "30s, 500ms or 2m")
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
