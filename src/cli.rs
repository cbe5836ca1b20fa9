//! The command line: what can be typed, and nothing of what it does.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueHint};

/// Records robot demonstrations from sensors that come and go.
///
/// Without a command, `rapid` opens the monitor: it finds the sensors named in devices.toml, streams
/// them, publishes the Physical Mask and records episodes on request.
#[derive(Debug, Parser)]
#[command(version, max_term_width = 100, after_help = EXAMPLES)]
pub struct Cli {
    /// What to do instead of running the rig.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Options that every command understands.
    #[command(flatten)]
    pub global: Global,
    /// Options of a run.
    #[command(flatten)]
    pub run: RunArgs,
}

const EXAMPLES: &str = "\
Examples:
  rapid --sim                                      look around, without any hardware
  rapid devices                                    what is plugged in, and which entry it is
  rapid                                            the monitor; space starts and stops an episode
  rapid --headless --record --duration 30s --task \"place block\" --tag finger=soft
  rapid inspect episodes/20260101_place-block_001.mcap

Exit codes: 0 done; 1 failed while running; 2 bad configuration or arguments;
            3 a required device is missing; 130 interrupted twice.";

/// Options that every command understands, before or after it.
#[derive(Debug, Clone, Args)]
pub struct Global {
    /// Registry of the rig's devices [default: ./devices.toml, then ~/.config/rapid/devices.toml, then
    /// /etc/rapid/devices.toml]
    #[arg(long, short, global = true, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub config: Option<PathBuf>,
    /// Print JSON, one object a line, instead of text
    #[arg(long, global = true)]
    pub json: bool,
    /// Keeps this rig apart from another one on the same machine: the names of its mask file and of
    /// its bus contain NAME
    #[arg(long, global = true, value_name = "NAME", value_parser = instance)]
    pub instance: Option<String>,
}

/// Options of a run.
#[derive(Debug, Clone, Args)]
pub struct RunArgs {
    /// Log lines instead of the monitor
    #[arg(long)]
    pub headless: bool,
    /// Record an episode from the start
    #[arg(long)]
    pub record: bool,
    /// End after this time of recording, or of running when nothing is recorded (30s, 5m)
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub duration: Option<Duration>,
    /// Folder for episodes
    #[arg(long, value_name = "DIR", default_value = "episodes", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// What is demonstrated; part of the file's name
    #[arg(long, value_name = "TEXT", default_value = "episode")]
    pub task: String,
    /// A property of the episode, recorded with it; may be repeated
    #[arg(long, value_name = "KEY=VALUE", value_parser = tag)]
    pub tag: Vec<(String, String)>,
    /// Simulated devices instead of real ones; without a file, those of the registry, of which one is
    /// unplugged and replugged
    #[arg(long, value_name = "SCENARIO", num_args = 0..=1, value_hint = ValueHint::FilePath)]
    pub sim: Option<Option<PathBuf>>,
    /// Observations a second, instead of what the registry says
    #[arg(long, value_name = "HZ", value_parser = rate)]
    pub rate: Option<f64>,
    /// Half width of the window around a tick, instead of what the registry says (25ms)
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub window: Option<Duration>,
}

/// What to do instead of running the rig.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Lists what is plugged in, which entry of the registry it is, and if none, why not
    Devices {
        /// Also list formats and controls of cameras
        #[arg(long)]
        formats: bool,
    },
    /// Checks the registry and says everything that is wrong with it
    Check,
    /// Writes what follows from the registry: udev rules, descriptors, systemd unit
    Artifacts {
        /// Copy them into /etc and make udev read them (needs root)
        #[arg(long)]
        install: bool,
        /// Where to write them
        #[arg(long, value_name = "DIR", default_value = "udev", value_hint = ValueHint::DirPath)]
        to: PathBuf,
    },
    /// Prints the Physical Mask that a running rapid publishes
    Mask {
        /// Print every change until interrupted
        #[arg(long)]
        watch: bool,
    },
    /// Tells what an episode holds: messages, rates, gaps, lateness, presence over time
    Inspect {
        /// Episode
        #[arg(value_hint = ValueHint::FilePath)]
        file: PathBuf,
    },
    /// Plays an episode as if its devices were plugged in
    Replay {
        /// Episode
        #[arg(value_hint = ValueHint::FilePath)]
        file: PathBuf,
        /// Options of the run.
        #[command(flatten)]
        run: RunArgs,
    },
    /// Prints a completion script: source <(rapid completions bash)
    Completions {
        /// Shell
        shell: clap_complete::Shell,
    },
}

fn duration(text: &str) -> Result<Duration, String> {
    humantime::parse_duration(text).map_err(|error| format!("{error}; write a number and a unit: 30s, 500ms, 2m"))
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
