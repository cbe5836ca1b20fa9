//! What is typed about ablations.

use std::path::PathBuf;

use clap::{Args, ValueEnum, ValueHint};

pub(super) const ABLATION: &str = "\
An episode belongs to a configuration by its tag finger=... (or that of a module) and by the sensors that \
were present when it began. A word of --modality is an entry, a module with sensors, a part of the names of \
entries (tactile for tactile_tip), or vision: cameras that do not sit in a fingertip.

Examples:
  rapid ablation --finger rigid,soft --modality vision,vision+tactile --episodes 20
  rapid ablation plan.toml --in /data/episodes --json

A file has: episodes = 20, fingers = [\"rigid\"], modalities = [\"vision\"], and if needed task = \"...\", \
tag = \"finger\" and [words] vision = [\"cam_wrist\"].";

/// Which configurations, and where their episodes are.
#[derive(Debug, Clone, Args)]
pub struct AblationArgs {
    /// Plan [default: ablation.toml, if there is one]
    #[arg(value_hint = ValueHint::FilePath)]
    pub plan: Option<PathBuf>,
    /// Fingers, by the values of their tag
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    pub finger: Vec<String>,
    /// Sets of modalities
    #[arg(long, value_name = "X,X+Y", value_delimiter = ',')]
    pub modality: Vec<String>,
    /// Episodes of each configuration [default: as the plan says, or 10]
    #[arg(long, value_name = "COUNT", value_parser = at_least_one)]
    pub episodes: Option<usize>,
    /// Only episodes of this task
    #[arg(long, value_name = "TEXT")]
    pub task: Option<String>,
    /// Folder of the episodes
    #[arg(long = "in", value_name = "DIR", default_value = "episodes", value_hint = ValueHint::DirPath)]
    pub folder: PathBuf,
    /// Which verdicts count: good, suspect (and good) or any
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
    text.parse().ok().filter(|count| *count > 0).ok_or_else(|| "a number from 1 on".to_owned())
}
