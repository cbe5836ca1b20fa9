//! How evenly the mask is published, as seen by a reader of `/dev/shm`, compared with a bare thread at the same time.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rapid::app::mask_path;
use rapid::rig::presence::read_mask;

use crate::beat::{self, Beat};
use crate::figure::Figure;
use crate::load;
use crate::process::{Running, Usage};
use crate::start::await_mask;
use crate::stats::{Sorted, median, steps};
use crate::{Bench, Failure};

/// Polling interval of the reader: four times per period, so that it misses nothing unless it is delayed itself.
const LOOK: Duration = Duration::from_micros(500);
/// Time from the first mask until the program has started.
const SETTLE: Duration = Duration::from_secs(1);

/// Observations of a reader.
#[derive(Debug, Default)]
pub(crate) struct Seen {
    /// Intervals between consecutive publications, by their own stamps, ms.
    pub(crate) intervals: Sorted,
    /// Publications that the reader missed.
    unseen: u64,
    baseline: Sorted,
    baseline_fifo: bool,
    /// Share of a core that the bare thread used, %.
    pub(crate) baseline_cpu: f64,
    /// The mask's thread runs under FIFO.
    fifo: bool,
}

/// A running reader and a bare loop.
#[derive(Debug)]
pub(crate) struct Watch {
    stop: Arc<AtomicBool>,
    reader: JoinHandle<Vec<(u64, u64)>>,
    beat: Beat,
}

impl Watch {
    /// Starts to poll the mask at `path`.
    pub(crate) fn start(path: &Path) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let reader = std::thread::spawn({
            let (stop, path) = (Arc::clone(&stop), path.to_owned());
            move || {
                // A delayed reader misses publications: it has the publisher's priority, and does almost nothing.
                beat::use_fifo();
                let mut seen: Vec<(u64, u64)> = Vec::with_capacity(1 << 16);
                while !stop.load(Ordering::Relaxed) {
                    if let Ok(record) = read_mask(&path)
                        && seen.last().is_none_or(|(sequence, _)| *sequence != record.sequence)
                    {
                        seen.push((record.sequence, record.realtime_ns));
                    }
                    beat::sleep(LOOK);
                }
                seen
            }
        });
        Self { stop, reader, beat: Beat::start() }
    }

    /// Ends it. `usage` is that of the measured program.
    pub(crate) fn end(self) -> Seen {
        self.stop.store(true, Ordering::Relaxed);
        let numbered = self.reader.join().unwrap_or_default();
        let (intervals, unseen) = steps(&numbered);
        let intervals = Sorted::new(intervals.into_iter().map(|ns| ns as f64 / 1e6));
        let beaten = self.beat.end();
        let baseline = Sorted::new(beaten.intervals());
        Seen { intervals, unseen, baseline, baseline_fifo: beaten.fifo, baseline_cpu: beaten.cpu, fifo: false }
    }
}

impl Seen {
    /// Adds the kernel's figures of the program's threads.
    #[must_use]
    pub(crate) fn of(mut self, usage: &Usage) -> Self {
        self.fifo = usage.threads.iter().any(|thread| thread.name == "mask" && thread.policy == 1);
        self
    }
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let length = bench.length(20, 2);
    let mut idle = Vec::new();
    for run in 0..bench.runs {
        bench.progress(&format!("mask, idle: run {} of {}, {} s each", run + 1, bench.runs, length.as_secs()));
        let instance = format!("bench-mask-{}", std::process::id());
        let mut command = Command::new(&bench.rapid);
        command.args(["--headless", "--json", "--instance", &instance]);
        command.args(load::scenario(bench, "idle")?);
        let program = Running::start(&mut command)?;
        await_mask(&mask_path(Some(&instance)))?;
        beat::sleep(SETTLE);
        let watch = Watch::start(&mask_path(Some(&instance)));
        let begun = Instant::now();
        while begun.elapsed() < length {
            beat::sleep(Duration::from_millis(50));
        }
        let seen = watch.end();
        let usage = program.stop()?;
        idle.push(seen.of(&usage));
    }
    Ok(figures("mask/idle", &idle))
}

/// Percentiles of the interval over all runs of one kind.
pub(crate) fn figures(name: &str, runs: &[Seen]) -> Vec<Figure> {
    let of = |share: f64, sorted: fn(&Seen) -> &Sorted| {
        median(&runs.iter().filter_map(|seen| sorted(seen).quantile(share)).collect::<Vec<_>>())
    };
    let class = |fifo: bool| if fifo { "SCHED_FIFO 40" } else { "ordinary scheduling" };
    let all = |test: fn(&Seen) -> bool| class(runs.iter().all(test));
    let unseen: u64 = runs.iter().map(|seen| seen.unseen).sum();
    let count: usize = runs.iter().map(|seen| seen.intervals.len()).sum();
    let note = format!(
        "{count} intervals, {unseen} publications not seen; mask thread {}; baseline: a thread with clock_nanosleep, \
         at the same time, {}",
        all(|seen| seen.fifo),
        all(|seen| seen.baseline_fifo)
    );
    [("p50", 0.5), ("p95", 0.95), ("p99", 0.99), ("max", 1.0)]
        .into_iter()
        .map(|(label, share)| {
            let figure = Figure::new(format!("{name}, interval {label}"), "ms", of(share, |seen| &seen.intervals))
                .baseline(of(share, |seen| &seen.baseline));
            if label == "p50" { figure.note(&note) } else { figure }
        })
        .collect()
}
