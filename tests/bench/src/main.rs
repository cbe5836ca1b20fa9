//! `rapid-bench`: figures of `rapid` on this machine, each with a baseline measured in the same run.
//!
//! One file per section; `stats` computes, `figure` shows, `process` starts and monitors children. A section that
//! cannot be measured gives its reason, and the next one follows.
//!
//! Invariant: no value makes the program fail. Wrong arguments do, and so does a figure that was not measured for any
//! other reason than a missing requirement that it names ([`Absent`]).

mod beat;
mod can;
mod child;
mod control;
mod disarm;
mod drawn;
mod eager;
mod eval;
mod export;
mod feed;
mod figure;
mod frame;
mod heap;
mod infer;
mod load;
mod many;
mod mask;
mod motors;
mod others;
mod picture;
mod policy;
mod process;
mod pty;
mod replug;
mod safety;
mod screen;
mod start;
mod stats;
mod sync;
mod write;

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};
use figure::Figure;
use rapid_devices::driver::can::guard;

/// An error in a section ends it, with its text as the reason.
type Failure = Box<dyn std::error::Error>;

/// Upper limit for waiting for the measured program: a watchdog, not a figure.
const LIMIT: Duration = Duration::from_mins(5);

/// A requirement of a section that this machine lacks, with the remedy.
#[derive(Debug, thiserror::Error)]
#[error("this machine has no {0}")]
struct Absent(String);

/// Figures of rapid on this machine, each beside a baseline measured in the same run. No value passes or fails; a figure
/// that could not be measured does fail, unless it names what the machine lacks.
#[derive(Debug, Parser)]
#[command(
    after_help = "Examples:\n  rapid-bench                     everything, some 30 minutes\n  rapid-bench --quick             \
                        short runs: see that it works\n  rapid-bench --only sync write   two sections\n  rapid-bench --json            \
                        one JSON object a figure and line"
)]
struct Cli {
    /// One JSON object a line: name, unit, value, baseline, target, note, met
    #[arg(long)]
    json: bool,
    /// Short runs, and few: the figures mean little
    #[arg(long)]
    quick: bool,
    /// One run of a second or so of each measurement: shows that it measures, and the figures mean nothing
    #[arg(long)]
    smoke: bool,
    /// Only these sections
    #[arg(long, num_args = 1.., value_name = "SECTION")]
    only: Vec<Section>,
    /// Runs of each measurement, of which the median is shown
    #[arg(long, value_name = "N")]
    runs: Option<usize>,
    /// Length of one run under full load
    #[arg(long, value_name = "SECONDS")]
    load_seconds: Option<u64>,
    /// The program measured; that of RAPID_BIN, or the one beside this, if not given
    #[arg(long, value_name = "FILE")]
    rapid: Option<PathBuf>,
    /// Where episodes are written for the time of the run; a real disk, not memory
    #[arg(long, value_name = "FOLDER")]
    scratch: Option<PathBuf>,
    /// The policy whose figures are taken
    #[arg(long, value_name = "FOLDER", default_value = "models/tactile-id")]
    bundle: PathBuf,
    #[command(subcommand)]
    child: Option<child::Child>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Section {
    Mask,
    Frame,
    Replug,
    Load,
    Many,
    Write,
    Sync,
    Start,
    Screen,
    Policy,
    Picture,
    Infer,
    Control,
    Motors,
    Safety,
    Disarm,
    Can,
    Eval,
    Export,
    Unplug,
    Capture,
    Cycles,
    Sweep,
    Deaf,
}

impl Section {
    /// In this order: measurements that must not be disturbed come before those that leave dirty pages behind.
    const ALL: [Self; 24] = [
        Self::Start,
        Self::Infer,
        Self::Sync,
        Self::Picture,
        Self::Policy,
        Self::Control,
        Self::Motors,
        Self::Safety,
        Self::Disarm,
        Self::Can,
        Self::Eval,
        Self::Frame,
        Self::Replug,
        Self::Unplug,
        Self::Mask,
        Self::Screen,
        Self::Many,
        Self::Load,
        Self::Write,
        Self::Capture,
        Self::Cycles,
        Self::Sweep,
        Self::Deaf,
        Self::Export,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Mask => "mask",
            Self::Frame => "frame",
            Self::Replug => "replug",
            Self::Load => "load",
            Self::Many => "many",
            Self::Write => "write",
            Self::Sync => "sync",
            Self::Start => "start",
            Self::Screen => "screen",
            Self::Policy => "policy",
            Self::Picture => "picture",
            Self::Infer => "infer",
            Self::Control => "control",
            Self::Motors => "motors",
            Self::Safety => "safety",
            Self::Disarm => "disarm",
            Self::Can => "can",
            Self::Eval => "eval",
            Self::Export => "export",
            Self::Unplug => "unplug",
            Self::Capture => "capture",
            Self::Cycles => "cycles",
            Self::Sweep => "sweep",
            Self::Deaf => "deaf",
        }
    }

    /// Closed-loop trials take at least a minute: quick runs include them only if they are named.
    fn is_asked_for(self, cli: &Cli) -> bool {
        if cli.only.is_empty() { !(cli.quick && self == Self::Eval) } else { cli.only.contains(&self) }
    }

    fn measure(self, bench: &Bench) -> Result<Vec<Figure>, Failure> {
        match self {
            Self::Mask => mask::measure(bench),
            Self::Frame => frame::measure(bench),
            Self::Replug => replug::measure(bench),
            Self::Load => load::measure(bench),
            Self::Many => many::measure(bench),
            Self::Write => write::measure(bench),
            Self::Sync => sync::measure(bench),
            Self::Start => start::measure(bench),
            Self::Screen => screen::measure(bench),
            Self::Policy => policy::measure(bench),
            Self::Picture => picture::measure(bench),
            Self::Infer => infer::measure(bench),
            Self::Control => control::measure(bench),
            Self::Motors => motors::measure(bench),
            Self::Safety => safety::measure(bench),
            Self::Disarm => disarm::measure(bench),
            Self::Can => can::measure(bench),
            Self::Eval => eval::measure(bench),
            Self::Export => export::measure(bench),
            Self::Unplug => others::unplug(bench),
            Self::Capture => others::capture(bench),
            Self::Cycles => others::cycles(bench),
            Self::Sweep => others::sweep(bench),
            Self::Deaf => others::deaf(bench),
        }
    }
}

/// Shared by all sections.
#[derive(Debug)]
pub(crate) struct Bench {
    rapid: PathBuf,
    /// Folder of this program and its siblings.
    programs: PathBuf,
    scratch: tempfile::TempDir,
    /// The policy's folder.
    bundle: PathBuf,
    quick: bool,
    smoke: bool,
    runs: usize,
    load: Duration,
}

impl Bench {
    fn new(cli: &Cli) -> io::Result<Self> {
        let programs = std::env::current_exe()?.parent().unwrap_or(Path::new(".")).to_owned();
        let named = || std::env::var_os("RAPID_BIN").map(PathBuf::from);
        let rapid = cli.rapid.clone().or_else(named).unwrap_or_else(|| programs.join("rapid"));
        if !rapid.is_file() {
            let text = format!("{}: no such program: cargo build --release, or name it with --rapid", rapid.display());
            return Err(io::Error::new(io::ErrorKind::NotFound, text));
        }
        let scratch = cli.scratch.clone().unwrap_or_else(|| programs.clone());
        Ok(Self {
            rapid,
            programs,
            bundle: cli.bundle.clone(),
            scratch: tempfile::Builder::new().prefix("rapid-bench-").tempdir_in(scratch)?,
            quick: cli.quick || cli.smoke,
            smoke: cli.smoke,
            runs: cli.runs.unwrap_or(by_length(cli, 5, 2, 1)).max(1),
            load: Duration::from_secs(cli.load_seconds.unwrap_or(by_length(cli, 60, 5, 1))),
        })
    }

    /// Selects by the requested length of the runs.
    fn choose<T>(&self, full: T, quick: T) -> T {
        if self.quick { quick } else { full }
    }

    /// Length of one measurement, in seconds for a full run and for a quick one.
    fn length(&self, full: u64, quick: u64) -> Duration {
        Duration::from_secs(if self.smoke { 1 } else { self.choose(full, quick) })
    }

    /// Reports the progress of a long measurement on standard error.
    fn progress(&self, text: &str) {
        let mut out = io::stderr();
        let _ = if out.is_terminal() { write!(out, "\r\x1b[K{text}") } else { writeln!(out, "{text}") };
        let _ = out.flush();
    }

    fn progress_done(&self) {
        let mut out = io::stderr();
        if out.is_terminal() {
            let _ = write!(out, "\r\x1b[K");
        }
    }
}

/// Selects by the requested length of the runs.
fn by_length<T>(cli: &Cli, full: T, quick: T, smoke: T) -> T {
    match (cli.smoke, cli.quick) {
        (true, _) => smoke,
        (false, true) => quick,
        (false, false) => full,
    }
}

fn main() -> ExitCode {
    let mut args = std::env::args_os();
    if args.next().is_some_and(|name| name == guard::NAME) {
        // Motors driven by this program have their guard started from it.
        return guard::run(args);
    }
    let cli = Cli::parse();
    let done = match &cli.child {
        Some(child) => child.run().map(|()| Vec::new()),
        None => run(&cli),
    };
    match done {
        Ok(unmeasured) if unmeasured.is_empty() => ExitCode::SUCCESS,
        Ok(unmeasured) => {
            let _ = writeln!(io::stderr(), "rapid-bench: not measured:\n  {}", unmeasured.join("\n  "));
            ExitCode::FAILURE
        }
        Err(error) => {
            let _ = writeln!(io::stderr(), "rapid-bench: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Runs the sections; returns one line per figure that should have been measured but was not.
fn run(cli: &Cli) -> Result<Vec<String>, Failure> {
    let bench = Bench::new(cli)?;
    let sections: Vec<Section> = Section::ALL.into_iter().filter(|section| section.is_asked_for(cli)).collect();
    show(cli, "host", &host(&bench, "at the beginning"))?;
    let mut unmeasured = Vec::new();
    for (place, section) in sections.iter().enumerate() {
        let name = section.name();
        bench.progress(&format!("{}/{} {name} ...", place + 1, sections.len()));
        let begun = Instant::now();
        let load = process::host_load(Duration::ZERO).map_or(0.0, |(average, _)| average);
        let figures = match section.measure(&bench) {
            Ok(figures) if figures.is_empty() => vec![Figure::missing(format!("{name}/all"), "it gave no figures")],
            Ok(figures) => figures,
            Err(error) => vec![Figure::of_failure(format!("{name}/all"), &error)],
        };
        bench.progress_done();
        let title = format!("{name}   ({:.0} s, load average before {load:.2})", begun.elapsed().as_secs_f64());
        show(cli, &title, &figures)?;
        unmeasured.extend(figures.iter().filter(|figure| figure.is_unmeasured()).map(|figure| {
            format!("{}: {}", figure.name, if figure.note.is_empty() { "it has no value" } else { &figure.note })
        }));
    }
    show(cli, "host", &host(&bench, "at the end"))?;
    Ok(unmeasured)
}

fn show(cli: &Cli, title: &str, figures: &[Figure]) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    if cli.json {
        for figure in figures {
            writeln!(out, "{}", serde_json::to_string(figure)?)?;
        }
    } else {
        writeln!(out, "{}", figure::table(title, figures))?;
    }
    Ok(out.flush()?)
}

/// The load of the machine, which affects every figure.
fn host(bench: &Bench, when: &str) -> Vec<Figure> {
    let processors = std::thread::available_parallelism().map_or(0, usize::from);
    let kernel = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let length = bench.choose("full runs", "short runs: figures mean little");
    let load = process::host_load(Duration::from_secs(1));
    let note = format!("{processors} processors, Linux {}, {length}, medians of {} runs", kernel.trim(), bench.runs);
    vec![
        Figure::new(format!("host/load average {when}"), "", load.map(|(average, _)| average)).note(note),
        Figure::new(format!("host/busy {when}"), "%", load.map(|(_, busy)| busy))
            .note("of all processors over one second in which the bench itself slept"),
    ]
}
