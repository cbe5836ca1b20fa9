//! The full load: four cameras at 60 Hz, a state at 1 kHz, the mask at 500 Hz, recorded to a file by the real program.
//!
//! For comparison, in separate processes so that the kernel accounts for them in the same way: the `mcap` crate writing
//! the same messages, and the simulated devices read by a bare loop.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use rapid::app::mask_path;
use serde_json::Value;

use crate::child::Spent;
use crate::figure::Figure;
use crate::mask::{self, Seen, Watch};
use crate::process::{Running, Usage};
use crate::stats::{median, range};
use crate::{Bench, Failure};

const REGISTRY: &str = include_str!("../scenarios/load.devices.toml");
const LOAD: &str = include_str!("../scenarios/load.toml");
const IDLE: &str = include_str!("../scenarios/idle.toml");
/// Allowance for start, end and a slow disk in addition to the recording.
const SLACK: Duration = Duration::from_secs(60);

/// Options that make `rapid` play a scenario of this folder.
pub(crate) fn scenario(bench: &Bench, name: &str) -> Result<Vec<OsString>, Failure> {
    let folder = bench.scratch.path();
    let (registry, scenario) = (folder.join("load.devices.toml"), folder.join(format!("{name}.toml")));
    std::fs::write(&registry, REGISTRY)?;
    std::fs::write(&scenario, if name == "idle" { IDLE } else { LOAD })?;
    Ok(vec!["--config".into(), registry.into(), "--sim".into(), scenario.into()])
}

/// One run.
struct Run {
    usage: Usage,
    seen: Seen,
    /// Samples, masks included, that were lost between driver and file.
    dropped: f64,
    /// Samples that a simulated camera dropped because they were not read in time.
    lost: f64,
    messages: f64,
    bytes: f64,
    seconds: f64,
    mcap: Spent,
    devices: Spent,
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let runs = bench.choose(bench.runs.min(3), 1);
    let runs = (0..runs)
        .map(|run| {
            bench.progress(&format!("load: run {} of {runs}, {} s each", run + 1, bench.load.as_secs()));
            one(bench)
        })
        .collect::<Result<Vec<Run>, Failure>>()?;
    let mut figures = own(&runs);
    figures.extend(threads(&runs));
    let seen: Vec<Seen> = runs.into_iter().map(|run| run.seen).collect();
    figures.extend(mask::figures("load/mask", &seen));
    Ok(figures)
}

fn one(bench: &Bench) -> Result<Run, Failure> {
    let out = tempfile::Builder::new().prefix("load").tempdir_in(bench.scratch.path())?;
    let instance = format!("bench-load-{}", std::process::id());
    let mut command = Command::new(&bench.rapid);
    command.args(["--headless", "--json", "--record", "--instance", &instance]);
    command.arg("--duration").arg(format!("{}s", bench.load.as_secs())).arg("--out").arg(out.path());
    command.args(scenario(bench, "load")?);
    let mut program = Running::start(&mut command)?;
    program.wait_for(SLACK, |line| kind(line).as_deref() == Some("recording"))?;
    program.mark();
    let watch = Watch::start(&mask_path(Some(&instance)));
    let begun = Instant::now();
    let mut reported = 0;
    let usage = program.finish(bench.load + SLACK, || {
        let done = begun.elapsed().as_secs();
        if done >= reported + 5 {
            reported = done;
            bench.progress(&format!("load: {done} of {} s", bench.load.as_secs()));
        }
    })?;
    let seen = watch.end().of(&usage);
    if !usage.success {
        return Err(format!("rapid ended with an error: {}", usage.output).into());
    }
    let Episode { dropped, lost, messages, bytes, seconds: recorded } = Episode::inspect(bench, out.path())?;
    // Deleted before the next one is written: a disk need not hold two.
    drop(out);
    bench.progress("load: the baselines");
    let seconds = bench.load.as_secs().to_string();
    Ok(Run {
        seen,
        dropped,
        lost,
        messages,
        bytes,
        seconds: recorded,
        mcap: Spent::of(Command::new(std::env::current_exe()?).arg("mcap").arg(bench.scratch.path()).arg(&seconds))?,
        devices: Spent::of(Command::new(std::env::current_exe()?).arg("devices").arg(&seconds))?,
        usage,
    })
}

/// The kind of event in a line.
pub(crate) fn kind(line: &str) -> Option<String> {
    Some(serde_json::from_str::<Value>(line).ok()?.get("event")?.as_str()?.to_owned())
}

/// The only episode of a folder.
pub(crate) fn only_episode(folder: &Path) -> Result<PathBuf, Failure> {
    let mut files = std::fs::read_dir(folder)?.flatten().map(|entry| entry.path());
    let file = files.find(|path| path.extension().is_some_and(|extension| extension == "mcap"));
    Ok(file.ok_or("rapid wrote no episode")?)
}

/// The report of `rapid inspect` on an episode.
pub(crate) struct Episode {
    /// Samples, masks included, that were lost between driver and file.
    pub dropped: f64,
    /// Samples that a device dropped because they were not read in time.
    pub lost: f64,
    /// Messages in the file.
    pub messages: f64,
    /// Bytes of the file.
    pub bytes: f64,
    /// Its length.
    pub seconds: f64,
}

impl Episode {
    /// Reads the only episode of a folder.
    pub(crate) fn inspect(bench: &Bench, folder: &Path) -> Result<Self, Failure> {
        let file = only_episode(folder)?;
        let output = Command::new(&bench.rapid).args(["--json", "inspect"]).arg(file).output()?;
        let printed: Value = serde_json::from_slice(&output.stdout)?;
        let number = |value: &Value| value.as_f64().unwrap_or(0.0);
        let missing =
            |list: &Value| list.as_array().into_iter().flatten().map(|one| number(&one["missing"])).sum::<f64>();
        let lost = number(&printed["lost"]);
        let holes = missing(&printed["modalities"]) + missing(&printed["topics"]);
        Ok(Self {
            dropped: number(&printed["dropped"]).max(holes - lost),
            lost,
            messages: number(&printed["messages"]),
            bytes: number(&printed["bytes"]),
            seconds: number(&printed["seconds"]).max(0.001),
        })
    }
}

fn own(runs: &[Run]) -> Vec<Figure> {
    let of = |value: fn(&Run) -> f64| median(&runs.iter().map(value).collect::<Vec<_>>());
    let share = |run: &Run| 100.0 * run.usage.cpu_s / run.seconds;
    let text = |value: Option<f64>| value.map_or_else(|| "?".to_owned(), |value| format!("{value:.2}"));
    let (least, most) = range(&runs.iter().map(share).collect::<Vec<_>>()).unwrap_or_default();
    let cpu = format!(
        "user and system of the whole process from start to end, {least:.1} to {most:.1} over {} runs; {} of it before the \
         recording begins; the baseline writes the messages in one go",
        runs.len(),
        text(of(|run| 100.0 * run.usage.cpu_before_mark_s / run.seconds)),
    );
    let rates = format!(
        "{:.0} s, {} messages/s, {} MB/s",
        of(|run| run.seconds).unwrap_or_default(),
        text(of(|run| run.messages / run.seconds)),
        text(of(|run| run.bytes / run.seconds / 1e6)),
    );
    let memory = format!(
        "peak; {} MB private, {} MB shared memory of the bus",
        text(of(|run| run.usage.anonymous as f64 / 1e6)),
        text(of(|run| run.usage.shared as f64 / 1e6)),
    );
    vec![
        Figure::new("load/samples dropped", "", of(|run| run.dropped)).target("= 0").note(rates),
        Figure::new("load/samples not read in time", "", of(|run| run.lost)).target("= 0").note(
            "lost by the simulated cameras, which keep four pictures: the machine was busy with other things",
        ),
        Figure::new("load/cpu of one core", "%", of(share))
            .baseline(of(|run| 100.0 * run.mcap.cpu_s / run.seconds))
            .target("< 25")
            .note(cpu),
        Figure::new("load/of it simulated devices", "%", of(|run| 100.0 * run.devices.cpu_s / run.devices.seconds))
            .note("a process that reads the same devices and does nothing with it: pictures made once, then copied; timers"),
        Figure::new("load/resident memory", "MB", of(|run| run.usage.resident as f64 / 1e6))
            .baseline(of(|run| run.mcap.resident as f64 / 1e6))
            .target("< 150")
            .note(memory),
    ]
}

/// Processor time by thread name.
fn threads(runs: &[Run]) -> Vec<Figure> {
    let Some(run) = runs.last() else { return Vec::new() };
    let samples = run.messages.max(1.0);
    run.usage
        .by_name()
        .iter()
        .flat_map(|thread| {
            let name = &thread.name;
            let class = if thread.policy == 1 { "SCHED_FIFO" } else { "ordinary scheduling" };
            let bare = (name == "mask").then_some(run.seen.baseline_cpu);
            let devices = (name == "worker").then(|| 100.0 * run.devices.cpu_s / run.devices.seconds);
            [
                Figure::new(format!("load/cpu of threads {name}"), "%", Some(100.0 * thread.cpu_s / run.seconds))
                    .baseline(bare.or(devices))
                    .note(class),
                Figure::new(format!("load/sleeps of threads {name}"), "/s", Some(thread.sleeps as f64 / run.seconds))
                    .note(format!("{:.2} a message recorded", thread.sleeps as f64 / samples)),
            ]
        })
        .collect()
}
