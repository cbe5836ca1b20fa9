//! How well a control loop keeps its grid while chunks are computed, compared with a bare thread at the same time.
//!
//! A recorded action contains when its tick was due (`log_time`) and when it was published (`publish_time`).

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rapid_core::time::{Stamp, realtime_ns};
use serde_json::Value;

use crate::beat::{sleep, sleep_until};
use crate::figure::Figure;
use crate::load::{self, kind};
use crate::process::Running;
use crate::stats::{Sorted, median};
use crate::{Bench, Failure, LIMIT};

/// Ticks per second.
const HZ: u32 = 30;
/// More than usual: a chunk takes longer than a tick, and the next one is requested as soon as it has arrived.
const DENOISING_STEPS: &str = "25";
/// The program's topic of actions.
const ACTIONS: &str = "/action";

/// Results of one run; times in ms.
struct Run {
    late: Sorted,
    bare: Sorted,
    /// Ticks without an action.
    missing: u64,
    chunks: usize,
    /// Share of the time in which a chunk was computed, %.
    computing: f64,
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let length = bench.length(20, 4);
    let folder = faster(bench)?;
    let mut runs = Vec::new();
    for run in 0..bench.runs {
        bench.progress(&format!("control: run {} of {}, {} s each", run + 1, bench.runs, length.as_secs()));
        runs.push(one(bench, &folder, length)?);
    }
    let of = |value: &dyn Fn(&Run) -> Option<f64>| median(&runs.iter().filter_map(value).collect::<Vec<_>>());
    let ticks: usize = runs.iter().map(|run| run.late.len()).sum();
    let chunks: usize = runs.iter().map(|run| run.chunks).sum();
    let missing: u64 = runs.iter().map(|run| run.missing).sum();
    let note = format!(
        "{ticks} ticks at {HZ} Hz, from the tick to the publishing of its action, {chunks} chunks of {DENOISING_STEPS} steps \
         meanwhile, which took {:.0} % of the time; {missing} ticks had no action. Baseline: a thread that sleeps to the same \
         grid in a process of its own, at the same time",
        of(&|run| Some(run.computing)).unwrap_or_default()
    );
    let figures = [("p50", 0.5), ("p99", 0.99), ("max", 1.0)].into_iter().map(|(label, share)| {
        let figure = Figure::new(format!("control/tick late, {label}"), "ms", of(&|run| run.late.quantile(share)))
            .baseline(of(&|run| run.bare.quantile(share)));
        match label {
            "p50" => figure.note(&note),
            "p99" => figure.target("< 2"),
            _ => figure,
        }
    });
    Ok(figures.collect())
}

/// The policy with a control grid of [`HZ`], queried at every tick at which it is free. Its cameras are unchanged: it
/// observes older pictures.
fn faster(bench: &Bench) -> Result<PathBuf, Failure> {
    let folder = bench.scratch.path().join("faster");
    std::fs::create_dir_all(&folder)?;
    for entry in std::fs::read_dir(&bench.bundle)? {
        let entry = entry?;
        std::fs::copy(entry.path(), folder.join(entry.file_name()))?;
    }
    let file = folder.join("policy.json");
    let mut policy: Value = serde_json::from_slice(&std::fs::read(&file)?)?;
    policy["control_hz"] = HZ.into();
    policy["n_action_steps"] = 1.into();
    std::fs::write(file, serde_json::to_vec(&policy)?)?;
    Ok(folder)
}

fn one(bench: &Bench, folder: &Path, length: Duration) -> Result<Run, Failure> {
    let out = tempfile::Builder::new().prefix("control").tempdir_in(bench.scratch.path())?;
    let instance = format!("bench-control-{}", std::process::id());
    let mut command = Command::new(&bench.rapid);
    command.arg("--infer").arg(folder).args(["--denoising-steps", DENOISING_STEPS]);
    command
        .args(["--sim", "task", "--headless", "--json", "--instance", &instance, "--record", "--out"])
        .arg(out.path());
    let mut program = Running::start(&mut command)?;
    program.wait_for(LIMIT, |line| kind(line).as_deref() == Some("act"))?;

    let stop = Arc::new(AtomicBool::new(false));
    let bare = std::thread::spawn({
        let stop = Arc::clone(&stop);
        move || beat(&stop)
    });
    let begun = realtime_ns();
    sleep(length);
    let seconds = realtime_ns().saturating_sub(begun) as f64 / 1e9;
    stop.store(true, Ordering::Relaxed);
    let bare = bare.join().map_err(|_| "the bare thread panicked")?;
    let usage = program.stop()?;
    let ticks = ticks(&load::only_episode(out.path())?, begun)?;
    let (Some((first, _)), Some((last, _))) = (ticks.first(), ticks.last()) else {
        return Err(format!("no action was recorded: {}", usage.output).into());
    };
    let missing = u64::from(last - first + 1).saturating_sub(ticks.len() as u64);
    let chunks: Vec<f64> = usage.output.lines().filter_map(latency_ms).collect();
    // Chunks are counted from the start of the loop, shortly before the first tick recorded here.
    let computing = (chunks.iter().sum::<f64>() / 10.0 / seconds).min(100.0);
    let late = Sorted::new(ticks.into_iter().map(|(_, late)| late));
    Ok(Run { late, bare: Sorted::new(bare), missing, chunks: chunks.len(), computing })
}

/// Number of each tick from `begun` (ns of the wall clock) on, and how late its action was published, ms.
fn ticks(episode: &Path, begun: u64) -> Result<Vec<(u32, f64)>, Failure> {
    let bytes = std::fs::read(episode)?;
    let mut ticks = Vec::new();
    for message in mcap::MessageStream::new(&bytes)? {
        let message = message?;
        if message.channel.topic == ACTIONS && message.log_time >= begun {
            ticks.push((message.sequence, message.publish_time.saturating_sub(message.log_time) as f64 / 1e6));
        }
    }
    Ok(ticks)
}

/// Only wakes at every tick: how late each time, ms.
fn beat(stop: &AtomicBool) -> Vec<f64> {
    let mut late = Vec::with_capacity(1 << 12);
    let mut due = Stamp::now();
    while !stop.load(Ordering::Relaxed) {
        due = due.after(Duration::from_secs(1) / HZ);
        sleep_until(due);
        late.push(Stamp::now().since(due).as_secs_f64() * 1e3);
    }
    late
}

/// The latency in a line about a chunk.
fn latency_ms(line: &str) -> Option<f64> {
    let line: Value = serde_json::from_str(line).ok()?;
    (line.get("event")?.as_str()? == "chunk").then(|| line.get("latency_ms")?.as_f64())?
}
