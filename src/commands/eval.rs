//! `rapid eval`: closed-loop trials of a policy on the simulated task, as in the paper's table of hot-plug
//! robustness.

use std::io::{self, Write};
use std::time::Instant;

use rapid_core::text;
use rapid_policy::bundle::{Bundle, BundleErrors};
use rapid_policy::model::Model;
use rapid_policy::onnxruntime::{Environment, LibraryError};
use rapid_policy::sampler::PolicyError;
use rapid_registry::Registry;
use rapid_registry::simulation::task::Outcome;
use rapid_status::palette::Palette;
use serde_json::json;

use super::Format;
use super::progress::Bar;
use crate::cli::EvalArgs;
use crate::lockstep::TrialError;
use crate::lockstep::evaluate::{Bench, Condition, Configuration, Status, Trial, robot_time, wilson};

/// Why there is no result.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// The bundle.
    #[error(transparent)]
    Bundle(#[from] BundleErrors),
    /// onnxruntime.
    #[error(transparent)]
    Library(#[from] LibraryError),
    /// The graphs.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A trial.
    #[error(transparent)]
    Trial(#[from] TrialError),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// The result of a condition.
struct Row {
    condition: Condition,
    trials: Vec<Trial>,
}

/// Score and status in the paper's table (25 trials each), and those of its baseline with a static
/// configuration. A condition that is not in the table has neither.
const fn paper(condition: Condition, configuration: Configuration) -> (Option<f64>, &'static str) {
    match (condition, configuration) {
        (Condition::NoWrist | Condition::EarlyUnplug, _) => (None, "-"),
        (Condition::Full, _) => (Some(0.92), "Normal"),
        (Condition::NoTactile, _) => (Some(0.52), "Degraded"),
        (_, Configuration::Static) => (None, "Crash"),
        (Condition::HotUnplug, Configuration::Dynamic) => (Some(0.56), "Degraded"),
        (Condition::HotReplug, Configuration::Dynamic) => (Some(0.84), "Normal"),
    }
}

/// Runs the trials and prints the results. Stops between two trials when `stop` returns true, and prints
/// the results so far.
///
/// # Errors
/// When the policy cannot be loaded or run.
pub fn run(args: &EvalArgs, format: Format, stop: &dyn Fn() -> bool, out: &mut dyn Write) -> Result<(), EvalError> {
    let bundle = Bundle::open(args.bundle.as_deref())?.holding_last(args.hold_last);
    warn_of_training_seeds(&bundle, args);
    let registry = Registry::task();
    bundle.check_registry(&registry)?;
    let actuators: Vec<_> =
        registry.actuator().into_iter().map(|(device, action)| (device.name.as_str(), action.names.len())).collect();
    bundle.check_actuators(&actuators)?;
    let environment = Environment::open(args.inference.ort_lib.as_deref())?;
    let mut model = Model::load(&bundle, &environment, args.inference.computing(registry.inference))?;
    let conditions = if args.condition.is_empty() { &Condition::ALL[..] } else { &args.condition };
    let configuration = if args.static_config { Configuration::Static } else { Configuration::Dynamic };
    let mut bench = Bench { bundle: &bundle, registry: &registry, model: &mut model, configuration };
    let begun = Instant::now();
    let bar = Bar::new("trials", args.trials * conditions.len(), format == Format::Text);
    let mut rows: Vec<Row> = Vec::new();
    let mut done = 0;
    'all: for condition in conditions {
        rows.push(Row { condition: *condition, trials: Vec::new() });
        for seed in (args.seed..).take(args.trials) {
            if stop() {
                break 'all;
            }
            bar.at(done);
            let trial = bench.run(*condition, seed)?;
            done += 1;
            if format == Format::Json {
                writeln!(out, "{}", tagged("trial", &json!(trial)))?;
            }
            if let Some(row) = rows.last_mut() {
                row.trials.push(trial);
            }
        }
    }
    drop(bar);
    rows.retain(|row| !row.trials.is_empty());
    match format {
        Format::Json => {
            for row in &rows {
                writeln!(out, "{}", tagged("condition", &row.json(&bundle, configuration)))?;
            }
        }
        Format::Text => table(&rows, &bundle, args, configuration, begun.elapsed().as_secs_f64(), out)?,
    }
    Ok(())
}

/// A trial whose block was demonstrated shows nothing about others.
fn warn_of_training_seeds(bundle: &Bundle, args: &EvalArgs) {
    let Some([first, last]) = bundle.training_seeds() else { return };
    let end = args.seed.saturating_add(args.trials as u64);
    if args.seed <= last && first < end {
        let text = format!(
            "this policy was trained on demonstrations with the seeds {first} to {last}: choose others, such as \
             --seed {}",
            last.saturating_add(1)
        );
        let _ = writeln!(io::stderr(), "{} {text}", Palette::for_output(&io::stderr()).warn("warning:"));
    }
}

fn tagged(event: &str, value: &serde_json::Value) -> serde_json::Value {
    let mut value = value.clone();
    value["event"] = event.into();
    value
}

impl Row {
    fn count(&self, outcome: Outcome) -> usize {
        self.trials.iter().filter(|trial| trial.status != Status::Crash && trial.outcome == outcome).count()
    }

    fn crashes(&self) -> usize {
        self.trials.iter().filter(|trial| trial.status == Status::Crash).count()
    }

    /// The worst status.
    fn status(&self) -> Status {
        self.trials.iter().map(|trial| trial.status).max().unwrap_or(Status::Normal)
    }

    fn json(&self, bundle: &Bundle, configuration: Configuration) -> serde_json::Value {
        let (total, successes) = (self.trials.len(), self.count(Outcome::Success));
        let (low, high) = wilson(successes, total);
        let (paper, paper_status) = paper(self.condition, configuration);
        json!({
            "condition": self.condition, "configuration": configuration, "trials": total, "success": successes,
            "wrong_bin": self.count(Outcome::WrongBin), "incomplete": self.count(Outcome::Incomplete),
            "crash": self.crashes(), "score": successes as f64 / total.max(1) as f64, "interval": [low, high],
            "status": self.status(), "paper_score": paper, "paper_status": paper_status, "policy": bundle.name,
            "policy_hash": bundle.hash,
        })
    }
}

fn table(
    rows: &[Row],
    bundle: &Bundle,
    args: &EvalArgs,
    configuration: Configuration,
    taken: f64,
    out: &mut dyn Write,
) -> Result<(), io::Error> {
    let kind = match configuration {
        Configuration::Dynamic => "dynamic configuration",
        Configuration::Static => "a loop that reads a fixed list of sensors and fails when a read does",
    };
    writeln!(
        out,
        "{}  {} per condition from seed {}; {kind}\n",
        text::plain(&bundle.name),
        text::counted(args.trials as u64, "trial"),
        args.seed
    )?;
    writeln!(out, "condition     score  95 %          success  wrong bin  incomplete  crash  status    paper")?;
    for row in rows {
        let (total, successes) = (row.trials.len(), row.count(Outcome::Success));
        let (low, high) = wilson(successes, total);
        let (paper, paper_status) = paper(row.condition, configuration);
        let paper = paper.map_or_else(|| "-   ".to_owned(), |score| format!("{score:.2}"));
        writeln!(
            out,
            "{:<12}  {:>5.2}  {low:.2} to {high:.2}  {successes:>7}  {:>9}  {:>10}  {:>5}  {:<8}  {paper} {paper_status}",
            row.condition.word(),
            successes as f64 / total as f64,
            row.count(Outcome::WrongBin),
            row.count(Outcome::Incomplete),
            row.crashes(),
            word(row.status()),
        )?;
    }
    let steps: u64 = rows.iter().flat_map(|row| &row.trials).map(|trial| u64::from(trial.steps)).sum();
    let robot = robot_time(steps);
    writeln!(
        out,
        "\n{} of robot time in {taken:.1} s ({:.0} times real time)",
        text::clock(robot),
        robot.as_secs_f64() / taken.max(1e-9)
    )?;
    for trial in rows.iter().flat_map(|row| &row.trials).filter(|trial| trial.failure.is_some()).take(5) {
        let reason = trial.failure.as_deref().unwrap_or_default();
        writeln!(out, "trial {} ({}): {}", trial.seed, trial.condition.word(), text::plain(reason))?;
    }
    Ok(())
}

const fn word(status: Status) -> &'static str {
    match status {
        Status::Normal => "Normal",
        Status::Degraded => "Degraded",
        Status::Crash => "Crash",
    }
}
