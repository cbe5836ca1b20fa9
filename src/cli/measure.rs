//! The grammar of `rapid calibrate` and `rapid ablation`.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum, ValueHint};

use super::{duration, time};

pub(super) const ABLATION: &str = "\
An episode belongs to a configuration by its tag finger=... (or that of a module) and by the sensors that \
were present when it started. A word of --modality is an entry, a module with sensors, a part of the names \
of entries (tactile for tactile_tip), or vision: cameras that are not in a fingertip.

Examples:
  rapid ablation --finger rigid,soft --modality vision,vision+tactile --episodes 20
  rapid ablation plan.toml --in /data/episodes --json

Keys of a plan: episodes = 20, fingers = [\"rigid\"], modalities = [\"vision\"], and optionally task = \"...\", \
tag = \"finger\" and [words] vision = [\"cam_wrist\"].";

/// Which configurations, and where their episodes are.
#[derive(Debug, Clone, Args)]
pub struct AblationArgs {
    /// Plan [default: ablation.toml, if there is one]
    #[arg(value_hint = ValueHint::FilePath)]
    pub plan: Option<PathBuf>,
    /// Fingers: values of their tag
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    pub finger: Vec<String>,
    /// Sets of modalities
    #[arg(long, value_name = "X,X+Y", value_delimiter = ',')]
    pub modality: Vec<String>,
    /// Episodes per configuration [default: from the plan, or 10]
    #[arg(long, value_name = "COUNT", value_parser = at_least_one)]
    pub episodes: Option<usize>,
    /// Only episodes of this task
    #[arg(long, value_name = "TEXT")]
    pub task: Option<String>,
    /// Folder of the episodes
    #[arg(long = "in", value_name = "DIR", default_value = "episodes", value_hint = ValueHint::DirPath)]
    pub folder: PathBuf,
    /// Worst verdict that counts: good, suspect or any
    #[arg(long, value_name = "VERDICT", default_value = "suspect", hide_possible_values = true)]
    pub count: Count,
}

/// The worst verdict with which an episode counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Count {
    /// GOOD.
    Good,
    /// GOOD or SUSPECT.
    Suspect,
    /// All of them.
    Any,
}

fn at_least_one(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|count| *count > 0).ok_or_else(|| "write a number of 1 or more".to_owned())
}

const LATENCY: &str = "\
How: stop a running rapid (the camera must be free), darken the room, and point the camera at this \
terminal from nearby, so that the terminal fills most of the picture; use full screen and full brightness. \
Then start this: the terminal flashes white and black in a pattern that matches at one delay only, up to \
three times a second. The result is the line for the camera's entry. Switch automatic exposure off \
(`controls` of the entry) if the pictures do not follow.

The result includes the latency of the terminal and its screen, often 10 to 40 ms. That of an LED is \
negligible: --led takes one of /sys/class/leds (needs permission to write there).

Examples:
  rapid calibrate latency --device cam_wrist
  rapid calibrate latency --device cam_wrist --light-delay 15ms
  sudo rapid calibrate latency --device cam_wrist --led ACT --duration 1m
  rapid calibrate latency --sim --device cam_wrist          without a camera";

/// What can be measured.
#[derive(Debug, Subcommand)]
pub enum Calibration {
    /// Measure the latency of a camera by flashing a light in front of it
    #[command(after_long_help = LATENCY)]
    Latency(LatencyArgs),
}

/// How the latency of a camera is measured.
#[derive(Debug, Clone, Args)]
pub struct LatencyArgs {
    /// Entry of the camera [default: the only one that is plugged in]
    #[arg(long, value_name = "NAME")]
    pub device: Option<String>,
    /// How long to flash: 5s to 10m
    #[arg(long, value_name = "TIME", default_value = "20s", value_parser = flashing)]
    pub duration: Duration,
    /// Flash an LED instead of this terminal: its name, or its folder
    #[arg(long, value_name = "NAME|DIR", value_hint = ValueHint::DirPath)]
    pub led: Option<PathBuf>,
    /// Latency of the light itself, if known; subtracted from the result
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = light_delay)]
    pub light_delay: Duration,
}

fn flashing(text: &str) -> Result<Duration, String> {
    match duration(text)? {
        length if (Duration::from_secs(5)..=Duration::from_mins(10)).contains(&length) => Ok(length),
        _ => Err("must be between 5s and 10m".to_owned()),
    }
}

fn light_delay(text: &str) -> Result<Duration, String> {
    time(text, ..=Duration::from_secs(1), "must be 1s at most", "15ms")
}
