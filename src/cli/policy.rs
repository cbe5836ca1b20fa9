//! The options of a policy, and the grammar of `rapid policy`, `rapid eval` and `rapid replay`.

use std::path::PathBuf;
use std::time::Duration;

#[cfg(feature = "policy")]
use clap::Subcommand;
use clap::{Args, ValueHint};
#[cfg(feature = "policy")]
use rapid_policy::sampler::Computing;
use rapid_registry::{InferenceSpec, Provider};

use super::run::{RUN, RunArgs};
use super::time;
#[cfg(feature = "policy")]
use crate::lockstep::evaluate::Condition;

const POLICY: &str = "Policy options";

#[cfg(feature = "policy")]
pub(super) const POLICIES: &str = "\
Examples:
  rapid policy show --sim task
  rapid policy observe episodes/20260101_sort_001.mcap --to chunk.npz";

#[cfg(feature = "policy")]
pub(super) const EVAL: &str = "\
Conditions: full (all sensors), no-tactile (without the tactile sensor), hot-unplug (it is unplugged after \
the touch, before the ways to the bins part), hot-replug (it is unplugged on the way to the block, and \
plugged in again after the touch), early-unplug (it is unplugged before the touch), no-wrist (without the \
camera that shows where the block lies).

--hold-last keeps the last sample of a sensor that was unplugged for some time, as if it were there; without \
it the policy sees zeros.

The seed of a trial determines when each sensor captures (anywhere in its period of 100 ms) and how long \
after that its sample is delivered (5 to 50 ms); the policy starts when the last of them was delivered. \
Trials run faster than real time; the same seed gives the same trial.

Examples:
  rapid eval
  rapid eval --trials 100 --json > result.jsonl
  rapid eval --hold-last 20s --condition hot-unplug --condition early-unplug
  rapid eval --static-config --condition hot-unplug models/tactile-id";

/// Options of a policy.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = POLICY)]
#[expect(clippy::struct_excessive_bools, reason = "each is a switch of the command line")]
pub struct PolicyArgs {
    /// Run a policy, headless [default: the built-in one]
    ///
    /// The built-in policy is for `--sim task`.
    #[arg(long, value_name = "BUNDLE", num_args = 0..=1, value_hint = ValueHint::DirPath, help_heading = RUN)]
    pub infer: Option<Option<PathBuf>>,
    /// Show and record its actions without moving anything
    #[arg(long, requires = "infer", hide_short_help = true)]
    pub dry_run: bool,
    /// Wait until all sensors it requires are plugged in, instead of failing
    #[arg(long, requires = "infer", hide_short_help = true)]
    pub wait: bool,
    /// Open the monitor
    #[arg(long, requires = "infer", conflicts_with = "headless", hide_short_help = true)]
    pub monitor: bool,
    /// Continue when a sensor is missing that the policy was not trained to do without
    #[arg(long, alias = "go-on", requires = "infer", hide_short_help = true)]
    pub ignore_missing: bool,
    /// Hold the last sample of a sensor that is unplugged for this long [default: as the policy states]
    #[arg(long, value_name = "TIME", value_parser = hold, requires = "infer", hide_short_help = true)]
    pub hold_last: Option<Duration>,
    /// How inference runs.
    #[command(flatten, next_help_heading = POLICY)]
    pub inference: InferenceArgs,
}

fn hold(text: &str) -> Result<Duration, String> {
    let range = Duration::from_millis(1)..=Duration::from_mins(10);
    time(text, range, "must be between 1ms and 10min", "20s")
}

/// How inference runs.
#[derive(Debug, Clone, Args)]
pub struct InferenceArgs {
    /// Denoising steps [default: from the policy]
    #[arg(long, value_name = "COUNT")]
    pub denoising_steps: Option<usize>,
    /// Threads to compute on [default: 1, or that of [inference] in devices.toml]
    #[allow(rustdoc::broken_intra_doc_links, reason = "a table of devices.toml, as it is written there")]
    #[arg(long, value_name = "COUNT", value_parser = threads)]
    pub threads: Option<usize>,
    /// cpu, cuda or tensorrt [default: cpu, or that of [inference] in devices.toml]
    #[allow(rustdoc::broken_intra_doc_links, reason = "a table of devices.toml, as it is written there")]
    #[arg(long, value_name = "NAME", value_parser = provider)]
    pub provider: Option<Provider>,
    /// onnxruntime library to use instead of the built-in one
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub ort_lib: Option<PathBuf>,
}

impl InferenceArgs {
    /// With what the registry states for this machine, where nothing is given.
    #[cfg(feature = "policy")]
    pub fn computing(&self, registry: InferenceSpec) -> Computing {
        let threads = self.threads.unwrap_or(registry.threads);
        let provider = self.provider.unwrap_or(registry.provider);
        Computing { denoising_steps: self.denoising_steps, on: InferenceSpec { threads, provider } }
    }
}

fn threads(text: &str) -> Result<usize, String> {
    let count = text.parse().ok().filter(|count| (1..=InferenceSpec::MOST_THREADS).contains(count));
    count.ok_or_else(|| format!("write a number from 1 to {}", InferenceSpec::MOST_THREADS))
}

fn provider(text: &str) -> Result<Provider, String> {
    let known = Provider::WORDS.into_iter().find(|(word, _)| *word == text);
    known.map(|(_, provider)| provider).ok_or_else(|| "one of cpu, cuda, tensorrt".to_owned())
}

/// `rapid policy`.
#[cfg(feature = "policy")]
#[derive(Debug, Clone, Subcommand)]
pub enum PolicyCommand {
    /// Show what a policy observes and moves, whether it suits the rig, and how long a chunk takes here
    #[command(after_long_help = "Examples:\n  rapid policy show\n  rapid policy show models/tactile-id --sim task\n  \
        rapid policy show POLICY --threads 4 --json")]
    Show(ShowArgs),
    /// Write what a recorded chunk of actions was computed from, as `NumPy` arrays
    ///
    /// The observations by their keys, the mask, the noise, and the recorded chunk (`recorded`): with the graphs of the policy
    /// they are all that is needed to compute it again (examples/recompute.py).
    #[command(after_long_help = "Examples:\n  rapid policy observe episodes/20260101_sort_001.mcap\n  \
        rapid policy observe EPISODE POLICY --chunk 12 --to chunk.npz")]
    Observe(ObserveArgs),
}

/// Which chunk is written where.
#[cfg(feature = "policy")]
#[derive(Debug, Clone, Args)]
pub struct ObserveArgs {
    /// Episode that the policy recorded
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// Folder of the policy [default: the one built into rapid]
    #[arg(value_hint = ValueHint::DirPath)]
    pub bundle: Option<PathBuf>,
    /// Which of its chunks, from 0 [default: the first one whose samples are all in the episode]
    #[arg(long, value_name = "N")]
    pub chunk: Option<usize>,
    /// File to write [default: that of the episode, with .npz]
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub to: Option<PathBuf>,
    /// How inference runs.
    #[command(flatten)]
    pub inference: InferenceArgs,
}

/// Which policy is shown.
#[cfg(feature = "policy")]
#[derive(Debug, Clone, Args)]
pub struct ShowArgs {
    /// Folder of the policy [default: the one built into rapid]
    #[arg(value_hint = ValueHint::DirPath)]
    pub bundle: Option<PathBuf>,
    /// How inference runs.
    #[command(flatten)]
    pub inference: InferenceArgs,
}

/// What `rapid eval` runs.
#[cfg(feature = "policy")]
#[derive(Debug, Clone, Args)]
pub struct EvalArgs {
    /// Folder of the policy [default: the one built into rapid]
    #[arg(value_hint = ValueHint::DirPath)]
    pub bundle: Option<PathBuf>,
    /// Trials per condition
    #[arg(long, value_name = "COUNT", default_value_t = 25, value_parser = trials)]
    pub trials: usize,
    /// Seed of the first trial; demonstrations start at 0 unless recorded with another --seed
    #[arg(long, value_name = "N", default_value_t = 50_000)]
    pub seed: u64,
    /// Condition (--help explains each); repeatable [default: all]
    #[arg(long, value_name = "NAME", value_parser = condition)]
    pub condition: Vec<Condition>,
    /// Baseline: a loop that reads a fixed list of sensors, and fails when a read does
    #[arg(long)]
    pub static_config: bool,
    /// Hold the last sample of a sensor that is unplugged for this long [default: as the policy states]
    #[arg(long, value_name = "TIME", value_parser = hold, conflicts_with = "static_config")]
    pub hold_last: Option<Duration>,
    /// How inference runs.
    #[command(flatten)]
    pub inference: InferenceArgs,
}

#[cfg(feature = "policy")]
fn trials(text: &str) -> Result<usize, String> {
    let count = text.parse().map_err(|_| "write a number, for example 25".to_owned())?;
    if count > 0 { Ok(count) } else { Err("must be at least 1".to_owned()) }
}

#[cfg(feature = "policy")]
fn condition(text: &str) -> Result<Condition, String> {
    let known = Condition::ALL.into_iter().find(|condition| condition.word() == text);
    known.ok_or_else(|| format!("one of {}", Condition::ALL.map(Condition::word).join(", ")))
}

pub(super) const REPLAY: &str = "\
The registry is the one recorded in the episode. With --infer nothing is run: the action chunks of an \
episode recorded with the policy are computed again; with any other episode, the policy's actions are \
compared with the recorded ones.

Examples:
  rapid replay episodes/20260101_place-block_001.mcap
  rapid replay episodes/20260101_place-block_001.mcap --headless --record --out again
  rapid replay episodes/20260101_place-block_001.mcap --infer models/tactile-id --tolerance 1e-4";

/// Which episode, and how it is replayed.
#[derive(Debug, Clone, Args)]
pub struct ReplayArgs {
    /// Episode
    #[arg(value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// Options of the run.
    #[command(flatten)]
    pub run: RunArgs,
    /// Compare a policy with the episode [default: the one built into rapid]
    #[arg(long, value_name = "BUNDLE", num_args = 0..=1, value_hint = ValueHint::DirPath, help_heading = COMPARISON)]
    pub infer: Option<Option<PathBuf>>,
    /// Largest accepted difference of actions computed again
    #[arg(long, value_name = "DIFFERENCE", value_parser = tolerance, requires = "infer", help_heading = COMPARISON)]
    pub tolerance: Option<f64>,
    /// How inference runs.
    #[command(flatten, next_help_heading = COMPARISON)]
    pub inference: InferenceArgs,
}

const COMPARISON: &str = "Comparison options";

fn tolerance(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(difference) if (0.0..f64::INFINITY).contains(&difference) => Ok(difference),
        _ => Err("write a number of 0 or more, for example 1e-4".to_owned()),
    }
}
