//! Figures that other programs of the project measure: run, and their lines taken over.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::figure::{self, Figure};
use crate::process::Running;
use crate::{Bench, Failure};

/// A guest that boots, plugs and records takes minutes.
const LIMIT: Duration = Duration::from_secs(1800);

/// Our own share of the time from an unplug to its bit.
pub(crate) fn unplug(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let unplugs = bench.choose("200", "20");
    let program = bench.programs.join("examples").join("unplug_latency");
    Ok(run(bench, "unplug", &program, &[unplugs.into()], "cargo build --release --example unplug_latency"))
}

/// Plugging and unplugging on the virtual bench.
pub(crate) fn cycles(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let cycles = bench.choose("50", "2");
    Ok(vbench(bench, "cycles", "vbench-cycles", &[cycles.into()]))
}

/// Nine configurations, one after the other, on the virtual bench.
pub(crate) fn sweep(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    Ok(vbench(bench, "sweep", "vbench-sweep", &[]))
}

/// A child process that does not listen, on the virtual bench.
pub(crate) fn deaf(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    Ok(vbench(bench, "deaf", "vbench-deaf", &[]))
}

fn vbench(bench: &Bench, section: &str, name: &str, arguments: &[OsString]) -> Vec<Figure> {
    run(bench, section, &bench.programs.join(name), arguments, "cargo build --release -p vbench --bins")
}

fn run(bench: &Bench, section: &str, program: &Path, arguments: &[OsString], remedy: &str) -> Vec<Figure> {
    let missing = |why: String| vec![Figure::missing(format!("{section}/all"), why)];
    if !program.is_file() {
        return missing(format!("{} is not there: {remedy}", program.display()));
    }
    let begun = Instant::now();
    let mut told = 0;
    let mut progress = || {
        let seconds = begun.elapsed().as_secs();
        if seconds >= told + 10 {
            told = seconds;
            bench.progress(&format!("{section}: {seconds} s"));
        }
    };
    let rapid: PathBuf = bench.rapid.clone();
    let mut command = Command::new(program);
    command.arg("--json").args(arguments).env("RAPID_BIN", rapid);
    let usage = match Running::start(&mut command).and_then(|running| running.finish(LIMIT, &mut progress)) {
        Ok(usage) => usage,
        Err(error) => return missing(error.to_string()),
    };
    let figures = figure::read(&usage.output);
    if figures.is_empty() || !usage.success {
        let name = program.file_name().unwrap_or_default().to_string_lossy();
        return missing(format!(
            "{name} --json gave {} figures and ended with success: {}",
            figures.len(),
            usage.success
        ));
    }
    figures
}
