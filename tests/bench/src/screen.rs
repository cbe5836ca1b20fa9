//! The monitor: what it costs on a terminal, alone and attached, and that it takes nothing from a recording.
//!
//! Each monitor is a real process on a pseudo-terminal. The cost of one within a run is the difference to the same run
//! without a screen.

use std::ffi::OsString;
use std::process::Command;
use std::time::{Duration, Instant};

use rapid::app::mask_path;
use rustix::process::Pid;

use crate::drawn::{self, DEVICES};
use crate::figure::Figure;
use crate::load::{self, Episode};
use crate::mask::Watch;
use crate::process::{Running, cpu_s};
use crate::pty::OnTerminal;
use crate::start::await_mask;
use crate::stats::Sorted;
use crate::{Bench, Failure, beat, many};

/// Upper limit for waiting for a screen: a watchdog, not a figure.
const LIMIT: Duration = Duration::from_secs(100);
/// Time from the first mask until all devices stream, and from a key until its page is drawn regularly.
const SETTLE: Duration = Duration::from_secs(2);
/// Something that each monitor shows first, and that only a picture shows.
const SHOWN: &str = "rapid";
const PICTURE: &str = "\u{2580}";
/// The ends of the two notices about the order of devices, by turns: what both have in the same place is not drawn again.
const NOTICES: [&str; 2] = ["rouble first", "heir bits"];
/// Time between two keys: each meets another phase of the frames.
const KEYS: (u64, u64) = (90, 131);

/// A part of the section.
type Part = fn(&Bench) -> Result<Vec<Figure>, Failure>;

pub(crate) fn measure(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let parts: [(&str, Part); 4] = [
        ("frame", drawn::frames),
        ("terminals", on_terminals),
        ("recording", recording),
        ("memory", |bench| Ok(vec![drawn::day(bench)?])),
    ];
    // What one of them lacks takes nothing from the others.
    let figures = |(name, part): (&str, Part)| {
        part(bench).unwrap_or_else(|error| vec![Figure::of_failure(format!("screen/{name}"), &error)])
    };
    Ok(parts.into_iter().flat_map(figures).collect())
}

/// A run with a screen of its own, or without one.
fn run_of(bench: &Bench, instance: &str, arguments: &[OsString], is_headless: bool) -> Command {
    let mut command = Command::new(&bench.rapid);
    command.args(arguments).args(["--instance", instance]);
    if is_headless {
        command.args(["--headless", "--json"]);
    }
    command
}

/// A monitor that is attached to a run.
fn attach(bench: &Bench, instance: &str) -> Result<OnTerminal, Failure> {
    let mut command = Command::new(&bench.rapid);
    command.args(["monitor", "--instance", instance]);
    let mut monitor = OnTerminal::start(&command)?;
    monitor.await_text(SHOWN, LIMIT)?;
    Ok(monitor)
}

/// Opens the page of the device in this row, and waits for its picture.
fn show_picture(monitor: &mut OnTerminal, row: usize) -> Result<(), Failure> {
    monitor.type_in(&("j".repeat(row) + "\r"))?;
    monitor.await_text(PICTURE, LIMIT)?;
    Ok(())
}

/// Processor time that these processes use within `length`, % of one core.
fn shares(length: Duration, processes: &[Pid]) -> Result<Vec<f64>, Failure> {
    let used = || -> Result<Vec<f64>, Failure> {
        processes.iter().map(|pid| Ok(cpu_s(*pid).ok_or("a process has ended")?)).collect()
    };
    let (before, begun) = (used()?, Instant::now());
    beat::sleep(length);
    let span = begun.elapsed().as_secs_f64();
    Ok(used()?.iter().zip(before).map(|(after, before)| 100.0 * (after - before) / span).collect())
}

/// Bytes a second that a screen prints.
fn rate(monitor: &mut OnTerminal, length: Duration) -> f64 {
    monitor.bytes();
    let begun = Instant::now();
    beat::sleep(length);
    monitor.bytes() as f64 / begun.elapsed().as_secs_f64()
}

/// Times from a key to the bytes with its notice, ms. The key only changes the order of the devices.
fn keys(monitor: &mut OnTerminal, count: u64) -> Result<Sorted, Failure> {
    let mut times = Vec::new();
    for number in 0..count {
        let (least, spread) = KEYS;
        beat::sleep(Duration::from_millis(least + number * 37 % spread));
        let pressed = monitor.type_in("o")?;
        let shown = monitor.await_text(NOTICES[number as usize % NOTICES.len()], LIMIT)?;
        times.push(shown.saturating_duration_since(pressed).as_secs_f64() * 1e3);
    }
    Ok(Sorted::new(times))
}

/// Times from a character to its echo by `cat`, ms: what a terminal and another process cost anyway.
fn echoes(count: u64) -> Result<Sorted, Failure> {
    let mut cat = OnTerminal::start(Command::new("sh").args(["-c", "stty raw -echo; echo ready; exec cat"]))?;
    cat.await_text("ready", LIMIT)?;
    let mut times = Vec::new();
    for _ in 0..count {
        beat::sleep(Duration::from_millis(KEYS.0));
        let pressed = cat.type_in("o")?;
        times.push(cat.await_text("o", LIMIT)?.saturating_duration_since(pressed).as_secs_f64() * 1e3);
    }
    Ok(Sorted::new(times))
}

/// What is measured of one screen.
struct Seen {
    cpu: f64,
    bytes: f64,
    keys: Sorted,
}

fn on_terminals(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    let (length, presses) = (bench.length(10, 4), if bench.smoke { 4 } else { bench.choose(100, 20) });
    let rig = many::scenario(bench, DEVICES)?;
    bench.progress("screen: a run without one, and monitors attached to it");
    let (attached, pictures, headless) = attached(bench, &rig, length, presses)?;
    bench.progress("screen: the monitor of a run itself");
    let own = own(bench, &rig, length, presses)?;
    bench.progress("screen: the monitor of a run without a device");
    let idle = own_bytes(bench, &many::scenario(bench, 0)?, length)?;
    let echo = echoes(presses)?;
    let seconds = length.as_secs();
    let mut figures = vec![
        Figure::new("screen/cpu of the own monitor", "% of a core", Some(own.cpu - headless)).target("< 3").note(format!(
            "{seconds} s, {DEVICES} simulated devices: the run with its monitor on a terminal {:.1} %, the same run without {headless:.1} %",
            own.cpu
        )),
        Figure::new("screen/cpu of an attached monitor", "% of a core", Some(attached.cpu)).target("< 3"),
        pictures,
        Figure::new("screen/bytes of an idle screen", "kB/s", Some(idle / 1e3))
            .target("< 2")
            .note("own monitor, no device plugged in"),
        Figure::new("screen/bytes of a screen with 16 devices", "kB/s", Some(own.bytes / 1e3))
            .note(format!("rates and ages change four times a second; attached: {:.1} kB/s", attached.bytes / 1e3)),
    ];
    for (name, times) in [("own", own.keys), ("attached", attached.keys)] {
        let figure = |label: &str, share: f64| {
            Figure::new(format!("screen/key to its notice, {name} monitor, {label}"), "ms", times.quantile(share))
                .baseline(echo.quantile(share))
                .target("< 50")
        };
        let note = format!("{presses} keys; baseline: `cat` on a terminal");
        figures.extend([figure("p50", 0.5).note(note), figure("max", 1.0)]);
    }
    Ok(figures)
}

/// One monitor attached to a run without a screen; two with pictures; and what the run alone costs.
fn attached(bench: &Bench, rig: &[OsString], length: Duration, presses: u64) -> Result<(Seen, Figure, f64), Failure> {
    let instance = format!("bench-screen-{}", std::process::id());
    let run = Running::start(&mut run_of(bench, &instance, rig, true))?;
    await_mask(&mask_path(Some(&instance)))?;
    beat::sleep(SETTLE);
    let alone = shares(length, &[run.pid()])?[0];
    let mut first = attach(bench, &instance)?;
    beat::sleep(SETTLE);
    first.bytes();
    let [with_one, one] = shares(length, &[run.pid(), first.pid()])?[..] else { return Err("no shares".into()) };
    let bytes = rate(&mut first, length);
    let keys = keys(&mut first, presses)?;
    let mut second = attach(bench, &instance)?;
    // The first has the devices by trouble or by bit: all stream, so the order is the same. Each fourth is a camera.
    show_picture(&mut first, 0)?;
    show_picture(&mut second, 4)?;
    beat::sleep(SETTLE);
    let [with_two, a, b] = shares(length, &[run.pid(), first.pid(), second.pid()])?[..] else {
        return Err("no shares".into());
    };
    let printed = rate(&mut first, length);
    first.end(true, LIMIT)?;
    second.end(true, LIMIT)?;
    run.stop()?;
    let pictures = Figure::new("screen/cpu of two attached monitors with pictures", "% of a core", Some(a + b + with_two - alone))
        .baseline(Some(one + with_one - alone))
        .target("< 15")
        .note(format!(
            "pictures of 640x480 as half blocks, five a second: the monitors {a:.1} and {b:.1} %, the run {with_two:.1} %, alone \
             {alone:.1} %; {:.0} kB/s each; baseline: one monitor without a picture, the run then {with_one:.1} %",
            printed / 1e3
        ));
    Ok((Seen { cpu: one, bytes, keys }, pictures, alone))
}

/// The monitor of a run itself; its processor time is that of the whole run.
fn own(bench: &Bench, rig: &[OsString], length: Duration, presses: u64) -> Result<Seen, Failure> {
    let mut run = started(bench, rig)?;
    beat::sleep(SETTLE);
    let cpu = shares(length, &[run.pid()])?[0];
    let bytes = rate(&mut run, length);
    let keys = keys(&mut run, presses)?;
    run.end(true, LIMIT)?;
    Ok(Seen { cpu, bytes, keys })
}

fn own_bytes(bench: &Bench, rig: &[OsString], length: Duration) -> Result<f64, Failure> {
    let mut run = started(bench, rig)?;
    beat::sleep(SETTLE);
    let bytes = rate(&mut run, length);
    run.end(true, LIMIT)?;
    Ok(bytes)
}

fn started(bench: &Bench, rig: &[OsString]) -> Result<OnTerminal, Failure> {
    let instance = format!("bench-screen-{}", std::process::id());
    let mut run = OnTerminal::start(&run_of(bench, &instance, rig, false))?;
    run.await_text(SHOWN, LIMIT)?;
    await_mask(&mask_path(Some(&instance)))?;
    Ok(run)
}

/// A recording of the full load: with its monitor, two more and pictures, or without any.
fn recorded(bench: &Bench, with_screens: bool) -> Result<(Episode, Sorted), Failure> {
    let out = tempfile::Builder::new().prefix("screen").tempdir_in(bench.scratch.path())?;
    let instance = format!("bench-screen-{}", std::process::id());
    // Attaching takes a part of it.
    let length = bench.length(30, 8) + SETTLE * 4;
    let mut arguments = load::scenario(bench, "load")?;
    arguments.extend(["--record".into(), "--duration".into(), format!("{}s", length.as_secs()).into()]);
    arguments.extend(["--out".into(), out.path().into()]);
    let command = |is_headless| run_of(bench, &instance, &arguments, is_headless);
    let mask = mask_path(Some(&instance));
    let intervals = |begun: Instant| {
        let watch = Watch::start(&mask);
        // Without the end, when the run has no mask any more.
        beat::sleep(length.saturating_sub(begun.elapsed() + SETTLE / 2));
        watch.end()
    };
    let seen = if with_screens {
        let mut run = OnTerminal::start(&command(false))?;
        let begun = Instant::now();
        await_mask(&mask)?;
        // A key before that would be a line's end to the terminal.
        run.await_text(SHOWN, LIMIT)?;
        show_picture(&mut run, 0)?;
        let mut others = [attach(bench, &instance)?, attach(bench, &instance)?];
        for (place, monitor) in others.iter_mut().enumerate() {
            show_picture(monitor, place + 1)?;
        }
        let seen = intervals(begun);
        // They are still there: a monitor that has ended would cost nothing.
        for monitor in others {
            monitor.end(true, LIMIT)?;
        }
        run.end(false, LIMIT)?;
        seen
    } else {
        let run = Running::start(&mut command(true))?;
        let begun = Instant::now();
        await_mask(&mask)?;
        beat::sleep(SETTLE);
        let seen = intervals(begun);
        let usage = run.finish(LIMIT, || {})?;
        if !usage.success {
            return Err(format!("rapid ended with an error: {}", usage.output).into());
        }
        seen
    };
    Ok((Episode::inspect(bench, out.path())?, seen.intervals))
}

fn recording(bench: &Bench) -> Result<Vec<Figure>, Failure> {
    bench.progress("screen: the full load recorded without a screen");
    let (bare, without) = recorded(bench, false)?;
    bench.progress("screen: the full load recorded with three monitors and their pictures");
    let (episode, with) = recorded(bench, true)?;
    let ratio = with.quantile(0.99).zip(without.quantile(0.99)).map(|(with, without)| with / without);
    Ok(vec![
        Figure::new("screen/samples dropped with three monitors", "", Some(episode.dropped))
            .baseline(Some(bare.dropped))
            .target("= 0")
            .note(format!(
                "of {:.0} messages: the full load recorded with its own monitor and two attached, each with the picture of a \
                 camera; baseline: without a screen",
                episode.messages
            )),
        Figure::new("screen/samples not read in time with three monitors", "", Some(episode.lost)).baseline(Some(bare.lost)),
        Figure::new("screen/mask with three monitors, interval p99", "ms", with.quantile(0.99))
            .baseline(without.quantile(0.99))
            .note(format!("{} and {} intervals", with.len(), without.len())),
        Figure::new("screen/mask with three monitors, p99 against the baseline", "", ratio).target("< 1.2"),
    ])
}
