//! Devices of mixed kinds: the cost of 4, 8 and 16 of them, recorded by the real program, and their effect on the mask.

use std::ffi::OsString;
use std::fmt::Write as _;
use std::process::Command;
use std::time::Duration;

use rapid::app::mask_path;

use crate::figure::Figure;
use crate::load::{Episode, kind};
use crate::mask::{self, Seen, Watch};
use crate::process::Running;
use crate::stats::median;
use crate::{Bench, Failure};

/// Numbers of devices, with equal shares of each kind. The smallest is the baseline of the others.
const COUNTS: [usize; 3] = [4, 8, 16];
const SLACK: Duration = Duration::from_secs(60);

/// Entries of the kinds, in turn: a camera, a serial line, a CAN bus, a device on the network.
const KINDS: [&str; 4] = [
    "node = \"camera\"\n[device.NAME.camera]\nwidth = 640\nheight = 480\nfps = 30\n",
    "node = \"serial\"\n[device.NAME.tty]\nbaud = 115200\nparse = \"csv\"\nchannels = 6\n",
    "node = \"can\"\n[device.NAME.can]\nprotocol = \"raw\"\n",
    "node = \"lan\"\n[device.NAME.lan]\nprotocol = \"iphone\"\nstream = \"pose\"\nhost = \"192.0.2.HOST\"\nprobe_port = 5555\nport = PORT\n",
];

/// One run.
struct Run {
    /// Share of one core, %.
    cpu: f64,
    episode: Episode,
    seen: Seen,
}

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let (length, runs) = (bench.length(20, 3).as_secs(), bench.choose(bench.runs.min(3), 1));
    let none = (0..runs).map(|_| one(bench, 0, length)).collect::<Result<Vec<_>, _>>()?;
    let share = |runs: &[Run]| median(&runs.iter().map(|run| run.cpu).collect::<Vec<_>>());
    let idle = share(&none).unwrap_or_default();
    let mut figures = vec![Figure::new("many/0 devices, cpu of one core", "%", Some(idle)).note(format!(
        "{length} s, mask and recorder alone; devices below are simulated: of each four a camera of 640x480 at 30 Hz, a serial \
         line, a CAN bus and the pose of a phone at 100 Hz"
    ))];
    let mut each = None;
    for count in COUNTS {
        let mut all = Vec::new();
        for run in 0..runs {
            bench.progress(&format!("many: {count} devices, run {} of {runs}, {length} s", run + 1));
            all.push(one(bench, count, length)?);
        }
        let cpu = share(&all).unwrap_or_default();
        let linear = each.map(|each: f64| idle + each * count as f64);
        each = each.or(Some((cpu - idle) / count as f64));
        let lost: f64 = all.iter().map(|run| run.episode.dropped + run.episode.lost).sum();
        let figure = Figure::new(format!("many/{count} devices, cpu of one core"), "%", Some(cpu)).baseline(linear);
        figures.push(if linear.is_some() {
            figure.note("baseline: as many times the cost of one of four")
        } else {
            figure
        });
        figures.push(
            Figure::new(format!("many/{count} devices, samples lost or dropped"), "", Some(lost))
                .target("= 0")
                .note(format!("of {:.0} messages", all.iter().map(|run| run.episode.messages).sum::<f64>())),
        );
        if Some(&count) == COUNTS.last() {
            let seen: Vec<Seen> = all.into_iter().map(|run| run.seen).collect();
            figures.extend(mask::figures(&format!("many/{count} devices, mask"), &seen));
        }
    }
    Ok(figures)
}

fn one(bench: &Bench, count: usize, length: u64) -> Result<Run, Failure> {
    let out = tempfile::Builder::new().prefix("many").tempdir_in(bench.scratch.path())?;
    let instance = format!("bench-many-{}", std::process::id());
    let mut command = Command::new(&bench.rapid);
    command.args(["--headless", "--json", "--record", "--instance", &instance]);
    command.arg("--duration").arg(format!("{length}s")).arg("--out").arg(out.path()).args(scenario(bench, count)?);
    let mut program = Running::start(&mut command)?;
    program.wait_for(SLACK, |line| kind(line).as_deref() == Some("recording"))?;
    program.mark();
    let watch = Watch::start(&mask_path(Some(&instance)));
    let usage = program.finish(Duration::from_secs(length) + SLACK, || {})?;
    let seen = watch.end().of(&usage);
    if !usage.success {
        return Err(format!("rapid ended with an error: {}", usage.output).into());
    }
    let episode = Episode::inspect(bench, out.path())?;
    Ok(Run { cpu: 100.0 * (usage.cpu_s - usage.cpu_before_mark_s) / episode.seconds, episode, seen })
}

/// A registry of this many devices, whose names are `d0`, `d1`, ...
pub(crate) fn registry(count: usize) -> Result<String, Failure> {
    let mut registry = "[rig]\nname = \"many\"\n".to_owned();
    for number in 0..count {
        let (name, table) = (format!("d{number}"), KINDS[number % KINDS.len()]);
        write!(registry, "\n[device.{name}]\nbit = {number}\n")?;
        if !table.contains("HOST") {
            write!(registry, "vid = \"1209\"\npid = \"{number:04x}\"\n")?;
        }
        registry.push_str(
            &table
                .replace("NAME", &name)
                .replace("HOST", &(number + 1).to_string())
                .replace("PORT", &(5_600 + number).to_string()),
        );
    }
    Ok(registry)
}

/// Options that make `rapid` play this many devices.
pub(crate) fn scenario(bench: &Bench, count: usize) -> Result<Vec<OsString>, Failure> {
    let folder = bench.scratch.path();
    let mut played = String::new();
    for number in 0..count.max(1) {
        write!(played, "[[device]]\nname = \"d{number}\"\nplugged = {}\n", count > 0)?;
    }
    let (config, scenario) = (folder.join("many.devices.toml"), folder.join("many.toml"));
    std::fs::write(&config, registry(count.max(1))?)?;
    std::fs::write(&scenario, played)?;
    Ok(vec!["--config".into(), config.into(), "--sim".into(), scenario.into()])
}
