//! What is typed about policies.

use std::path::PathBuf;

use clap::{Args, ValueHint};

use crate::lockstep::evaluate::Condition;

const POLICY: &str = "Options of a policy";

pub(super) const EVAL: &str = "\
Conditions: full, no-tactile (the tactile sensor is not there), hot-unplug (it is pulled out while the
block is carried), hot-replug (pulled out on the way to the block, and plugged in again), no-wrist (the
camera that shows where the block lies is not there).
Each trial draws from its seed when each sensor captures (anywhere in the period of 100 ms) and how long
after that its sample is seen (5 to 50 ms); the policy begins when the last of them has been seen.
Trials run faster than real time; the same seed gives the same trial.

Examples:
  rapid eval
  rapid eval --trials 100 --json > result.jsonl
  rapid eval --static-config --condition hot-unplug models/tactile-id";

/// A policy at the controls.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = POLICY)]
#[expect(clippy::struct_excessive_bools, reason = "each is a switch of the command line")]
pub struct PolicyArgs {
    /// Run the policy in this folder, headless [default: the one inside rapid, for `--sim task`]
    #[arg(long, value_name = "BUNDLE", num_args = 0..=1, value_hint = ValueHint::DirPath)]
    pub infer: Option<Option<PathBuf>>,
    /// Show and record what it would do; nothing moves
    #[arg(long, requires = "infer")]
    pub dry_run: bool,
    /// Start when what it requires is plugged in, instead of giving up
    #[arg(long, requires = "infer")]
    pub wait: bool,
    /// Show the monitor
    #[arg(long, requires = "infer", conflicts_with = "headless")]
    pub monitor: bool,
    /// Go on without a sensor that it was not trained to do without
    #[arg(long, requires = "infer")]
    pub go_on: bool,
    /// Steps of denoising [default: as the policy says]
    #[arg(long, value_name = "COUNT", requires = "infer")]
    pub denoising_steps: Option<usize>,
    /// onnxruntime to use instead of the one inside rapid
    #[arg(long, value_name = "FILE", requires = "infer", value_hint = ValueHint::FilePath)]
    pub ort_lib: Option<PathBuf>,
}

/// What `rapid eval` tries.
#[derive(Debug, Clone, Args)]
pub struct EvalArgs {
    /// Folder of a policy [default: the one inside rapid]
    #[arg(value_hint = ValueHint::DirPath)]
    pub bundle: Option<PathBuf>,
    /// Trials a condition
    #[arg(long, value_name = "COUNT", default_value_t = 25, value_parser = trials)]
    pub trials: usize,
    /// Number of the first trial; demonstrations begin at 0 unless --seed said otherwise
    #[arg(long, value_name = "N", default_value_t = 50_000)]
    pub seed: u64,
    /// One of the conditions; may be repeated [default: all]
    #[arg(long, value_name = "NAME", value_parser = condition)]
    pub condition: Vec<Condition>,
    /// As software with a fixed set of sensors: one that goes ends the run
    #[arg(long)]
    pub static_config: bool,
    /// Steps of denoising [default: as the policy says]
    #[arg(long, value_name = "COUNT")]
    pub denoising_steps: Option<usize>,
    /// onnxruntime to use instead of the one inside rapid
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub ort_lib: Option<PathBuf>,
}

fn trials(text: &str) -> Result<usize, String> {
    let count = text.parse().map_err(|_| "write a number, for example 25".to_owned())?;
    if count > 0 { Ok(count) } else { Err("must be at least 1".to_owned()) }
}

fn condition(text: &str) -> Result<Condition, String> {
    let known = Condition::ALL.into_iter().find(|condition| condition.word() == text);
    known.ok_or_else(|| format!("one of {}", Condition::ALL.map(Condition::word).join(", ")))
}
