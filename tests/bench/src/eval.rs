//! The policy in closed loop on the simulated task, compared with a static configuration.

use std::process::Command;
use std::time::{Duration, Instant};

use rapid_registry::simulation::task::STEP_HZ;
use serde_json::Value;

use crate::figure::Figure;
use crate::process::Running;
use crate::{Bench, Failure};

/// Trials take seconds; a busy machine may need minutes.
const LIMIT: Duration = Duration::from_secs(1800);
/// Conditions of `rapid eval`, and their target scores.
const CONDITIONS: [(&str, &[&str]); 5] = [
    ("full", &[">= 0.95"]),
    ("no-tactile", &[">= 0.4", "<= 0.6"]),
    ("hot-unplug", &[]),
    ("hot-replug", &[">= 0.95"]),
    ("no-wrist", &[]),
];
/// Those in which a sensor is unplugged.
const PULLED: [&str; 2] = ["hot-unplug", "hot-replug"];
/// The one that is run once more, with the last sample of the sensor held.
const HELD: &str = PULLED[0];

/// The output of `rapid eval`.
struct Evaluated {
    conditions: Vec<Value>,
    trials: f64,
    /// Steps of the task, all trials.
    steps: f64,
    seconds: f64,
}

impl Evaluated {
    fn of(&self, condition: &str, what: &str) -> Option<f64> {
        self.conditions.iter().find(|row| row["condition"] == condition)?[what].as_f64()
    }

    fn crashes(&self, conditions: &[&str]) -> f64 {
        conditions.iter().filter_map(|condition| self.of(condition, "crash")).sum()
    }
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let trials: u32 = bench.choose(25, 3);
    let count = f64::from(trials);
    bench.progress(&format!("eval: {trials} trials a condition"));
    let own = evaluate(bench, trials, &[])?;
    bench.progress("eval: the static configuration");
    let fixed = evaluate(bench, trials, &["--static-config"])?;
    bench.progress("eval: the last sample held");
    let held = evaluate(bench, trials, &["--hold-last", "20s", "--condition", HELD])?;
    let mut figures = Vec::new();
    for (condition, targets) in CONDITIONS {
        let figure = |bound: &str| {
            Figure::new(format!("eval/score, {condition}{bound}"), "", own.of(condition, "score"))
                .baseline(fixed.of(condition, "score"))
        };
        match targets {
            [] => figures.push(figure("")),
            [target] => figures.push(figure("").target(target)),
            both => figures
                .extend(both.iter().zip([", from below", ", from above"]).map(|(t, name)| figure(name).target(t))),
        }
    }
    if let Some(first) = figures.first_mut() {
        first.note = format!("{trials} trials a condition; baseline: with --static-config");
    }
    figures.push(
        Figure::new(format!("eval/score, {HELD}, last sample held"), "", held.of(HELD, "score"))
            .baseline(own.of(HELD, "score"))
            .target(">= 0.95")
            .note("with --hold-last 20s; baseline: without"),
    );
    let names = CONDITIONS.map(|(condition, _)| condition);
    figures.push(
        Figure::new("eval/crashes, all conditions", "", Some(own.crashes(&names)))
            .baseline(Some(fixed.crashes(&names)))
            .target("= 0"),
    );
    figures.push(
        Figure::new("eval/crashes of the static configuration", "", Some(fixed.crashes(&PULLED)))
            .target(&format!("= {}", 2.0 * count))
            .note("in both conditions in which a sensor is pulled out"),
    );
    let robot_seconds = own.steps / f64::from(STEP_HZ);
    figures.push(
        Figure::new("eval/trials", "1/s", Some(own.trials / own.seconds))
            .note(format!("{} trials in {:.1} s, loading included", own.trials, own.seconds)),
    );
    figures.push(Figure::new("eval/multiple of real time", "x", Some(robot_seconds / own.seconds)));
    Ok(figures)
}

fn evaluate(bench: &Bench, trials: u32, options: &[&str]) -> Result<Evaluated, Failure> {
    let mut command = Command::new(&bench.rapid);
    command.args(["--json", "eval", "--trials", &trials.to_string()]).args(options).arg(&bench.bundle);
    let begun = Instant::now();
    let usage = Running::start(&mut command)?.finish(LIMIT, || {})?;
    let seconds = begun.elapsed().as_secs_f64();
    let lines: Vec<Value> = usage.output.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let (rows, single): (Vec<Value>, Vec<Value>) = lines.into_iter().partition(|line| line["event"] == "condition");
    if !usage.success || rows.is_empty() {
        return Err(
            format!("rapid eval gave {} conditions and ended with success: {}", rows.len(), usage.success).into()
        );
    }
    let steps = single.iter().filter_map(|trial| trial["steps"].as_f64()).sum();
    Ok(Evaluated { conditions: rows, trials: single.len() as f64, steps, seconds })
}
