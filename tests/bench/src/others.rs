//! Figures measured by other programs of the project: runs them and adopts their lines.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use vbench::guest::{GuestError, Image};

use crate::figure::{self, Figure};
use crate::process::Running;
use crate::{Absent, Bench, Failure};

/// A guest that boots, plugs and records takes minutes.
const LIMIT: Duration = Duration::from_secs(1800);

/// The program's share of the time from an unplug to its bit.
pub(crate) fn unplug(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let unplugs = bench.choose("200", "20");
    let program = bench.programs.join("examples").join("unplug_latency");
    run(bench, &program, &[unplugs.into()], "cargo build --release --example unplug_latency")
}

/// Plugging and unplugging on the virtual bench.
pub(crate) fn cycles(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let cycles = if bench.smoke { "1" } else { bench.choose("50", "2") };
    vbench(bench, "vbench-cycles", &[cycles.into()])
}

/// A camera through nokhwa and through the driver, on the virtual bench.
pub(crate) fn capture(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let frames = if bench.smoke { "10" } else { bench.choose("600", "60") };
    vbench(bench, "vbench-capture", &[frames.into()])
}

/// Nine configurations, one after the other, on the virtual bench; only the first of them for a smoke run.
pub(crate) fn sweep(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let configurations = if bench.smoke { "1" } else { "9" };
    vbench(bench, "vbench-sweep", &[configurations.into()])
}

/// A child process that ignores SIGTERM, on the virtual bench.
pub(crate) fn deaf(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    vbench(bench, "vbench-deaf", &[])
}

fn vbench(bench: &Bench, name: &str, arguments: &[OsString]) -> Result<Vec<Figure>, Failure> {
    match Image::emulated() {
        Err(error @ GuestError::NoImage(_)) => return Err(Absent(format!("guest image: {error}")).into()),
        located => located?,
    };
    run(bench, &bench.programs.join(name), arguments, "cargo build --release -p vbench --bins")
}

fn run(bench: &Bench, program: &Path, arguments: &[OsString], remedy: &str) -> Result<Vec<Figure>, Failure> {
    let name = program.file_name().unwrap_or_default().to_string_lossy();
    if !program.is_file() {
        return Err(format!("{} is not there: {remedy}", program.display()).into());
    }
    let begun = Instant::now();
    let mut reported = 0;
    let mut progress = || {
        let seconds = begun.elapsed().as_secs();
        if seconds >= reported + 10 {
            reported = seconds;
            bench.progress(&format!("{name}: {seconds} s"));
        }
    };
    let rapid: PathBuf = bench.rapid.clone();
    let mut command = Command::new(program);
    command.arg("--json").args(arguments).env("RAPID_BIN", rapid);
    let usage = Running::start(&mut command)?.finish(LIMIT, &mut progress)?;
    let figures = figure::read(&usage.output);
    if figures.is_empty() || !usage.success {
        let (count, success) = (figures.len(), usage.success);
        return Err(format!("{name} --json gave {count} figures and ended with success: {success}").into());
    }
    Ok(figures)
}
