//! `rapid replay --infer`: what can be typed.

use std::path::PathBuf;

use clap::parser::ValueSource;
use clap::{ArgMatches, Args, ValueHint};

use super::RunArgs;

pub(super) const REPLAY: &str = "\
The registry is the one in the episode; --config is not looked at. With --infer nothing is run: the
chunks of a policy's own episode are computed again; beside another episode the policy looks on.";

/// Options of a policy beside an episode.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Options of a comparison")]
pub struct CompareArgs {
    /// Compare a policy with the episode [default: as `rapid eval`]
    #[arg(long = "infer", value_name = "BUNDLE", num_args = 0..=1, value_hint = ValueHint::DirPath)]
    pub compare_with: Option<Option<PathBuf>>,
    /// Fail if the actions of its own episode differ by more
    #[arg(long, value_name = "DIFFERENCE", value_parser = tolerance, requires = "compare_with")]
    pub tolerance: Option<f64>,
    /// Steps of denoising [default: as the policy says]
    #[arg(long, value_name = "COUNT", requires = "compare_with")]
    pub denoising_steps: Option<usize>,
    /// onnxruntime to use instead of the one inside rapid
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, requires = "compare_with")]
    pub ort_lib: Option<PathBuf>,
}

/// Why an episode is not to be compared: an option of a run.
pub(super) fn conflict(replay: &ArgMatches) -> Option<String> {
    let typed = |id: &str| replay.value_source(id) == Some(ValueSource::CommandLine);
    if !typed("compare_with") {
        return None;
    }
    let run = RunArgs::augment_args(clap::Command::new("run"));
    let option = run.get_arguments().map(|argument| argument.get_id().as_str()).find(|id| typed(id))?;
    Some(format!("--{option} is an option of a run, and --infer compares without one: leave one of them out"))
}

fn tolerance(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(difference) if (0.0..f64::INFINITY).contains(&difference) => Ok(difference),
        _ => Err("write a number from 0 on, for example 1e-4".to_owned()),
    }
}
