//! Time from the start of the program to the first mask, and the size of the program.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rapid::app::mask_path;
use rapid::rig::presence::read_mask;

use crate::beat;
use crate::figure::Figure;
use crate::process::Running;
use crate::stats::Sorted;
use crate::{Bench, Failure, LIMIT};

/// Polling interval.
const LOOK: Duration = Duration::from_micros(100);

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let starts = bench.choose(50, 8);
    let (mut masks, mut versions) = (Vec::new(), Vec::new());
    for start in 0..starts {
        if start % 10 == 0 {
            bench.progress(&format!("start: {start} of {starts}"));
        }
        masks.push(to_mask(bench, &["--sim"])?);
        let begun = Instant::now();
        Command::new(&bench.rapid).arg("--version").stdout(Stdio::null()).status()?;
        versions.push(ms(begun));
    }
    let (masks, versions) = (Sorted::new(masks), Sorted::new(versions));
    let note =
        format!("{starts} starts of `rapid --sim --headless`, looked for every 0.1 ms; baseline: `rapid --version`");
    let mut figures = vec![
        Figure::new("start/first mask, p50", "ms", masks.quantile(0.5))
            .baseline(versions.quantile(0.5))
            .target("< 50")
            .note(note),
        Figure::new("start/first mask, max", "ms", masks.max()).baseline(versions.max()),
    ];
    let bytes = std::fs::metadata(&bench.rapid)?.len() as f64;
    figures.push(Figure::new("start/program size", "MB", Some(bytes / 1e6)).target("< 15").note("without onnxruntime"));
    Ok(figures)
}

/// Time from the start of `rapid` with `options` to its first mask, ms.
pub(crate) fn to_mask(bench: &Bench, options: &[&str]) -> Result<f64, Failure> {
    let instance = format!("bench-start-{}", std::process::id());
    let path = mask_path(Some(&instance));
    let mut command = Command::new(&bench.rapid);
    command.args(options).args(["--headless", "--json", "--instance", &instance]);
    let begun = Instant::now();
    let program = Running::start(&mut command)?;
    await_mask(&path)?;
    let taken = ms(begun);
    program.stop()?;
    Ok(taken)
}

/// Waits until a mask is published at `path`.
pub(crate) fn await_mask(path: &Path) -> Result<(), Failure> {
    let begun = Instant::now();
    while !read_mask(path).is_ok_and(|record| record.sequence >= 1) {
        if begun.elapsed() > LIMIT {
            return Err(format!("no mask within {LIMIT:?}").into());
        }
        beat::sleep(LOOK);
    }
    Ok(())
}

/// Time since `begun`, ms.
pub(crate) fn ms(begun: Instant) -> f64 {
    begun.elapsed().as_secs_f64() * 1e3
}
