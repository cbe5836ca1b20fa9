//! `vbench-capture [FRAMES] [--json]`: the cost of capturing a camera through nokhwa and through the driver of `rapid`
//! (`examples/capture.rs`), one after the other in the same guest, and when each returns control while the camera is
//! silent for 10 s and when it is unplugged. A benchmark: it asserts nothing about its figures.

use std::process::ExitCode;

use serde_json::Value;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::figure::{Figure, heading};
use vbench::outcome::{Outcome, json_lines};
use vbench::scenario::Scenario;

const USAGE: &str = "usage: vbench-capture [FRAMES] [--json]   (300 pictures by default)";
const SILENCE_S: u64 = 10;

fn main() -> ExitCode {
    let (mut frames, mut json) = (300_u64, false);
    for word in std::env::args().skip(1) {
        match (word.as_str(), word.parse()) {
            ("--json", _) => json = true,
            (_, Ok(number)) if number > 0 => frames = number,
            _ => {
                eprintln!("{USAGE}");
                return ExitCode::from(2);
            }
        }
    }
    match measure(frames) {
        Ok(figures) if json => figures.iter().for_each(|figure| println!("{}", figure.json())),
        Ok(figures) => {
            println!("{}", heading());
            figures.iter().for_each(|figure| println!("{figure}"));
        }
        Err(error) => {
            eprintln!("vbench-capture: {error}");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}

fn measure(frames: u64) -> Result<Vec<Figure>, Box<dyn std::error::Error>> {
    let camera = DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 640, 480, &[30]);
    let read = |reader: &str| {
        format!(
            r#"
emu plug 0
wait_for 60 attached 0 || fail 'not attached'
udevadm settle
/tmp/bench/capture {reader} /dev/video0 {frames} >$out/{reader}.jsonl 2>$out/{reader}.err & reader_pid=$!
wait_for 120 has_line $out/{reader}.jsonl frames || fail "no pictures by {reader}: $(cat $out/{reader}.err)"
emu silent 0 1
emu sleep {SILENCE_S}000
emu silent 0 0
emu sleep 1000
emu unplug 0
wait_for 60 has_line $out/{reader}.jsonl ended_ns || fail "{reader} did not end"
wait $reader_pid
wait_for 30 detached 0 || fail 'still attached'
udevadm settle
"#
        )
    };
    let script = format!("{}{}emu_quit\nexit 0\n", read("nokhwa"), read("rapid"));
    let scenario = Scenario::new("capture").emulated().device(camera).example("capture").script(&script);
    let outcome = scenario.run()?;
    if outcome.code != 0 {
        return Err(outcome.diagnosis().into());
    }
    figures(&outcome)
}

fn figures(outcome: &Outcome) -> Result<Vec<Figure>, Box<dyn std::error::Error>> {
    let unplugs = outcome.actions("unplug", 0);
    let read = |reader: &str, unplug: usize| {
        let mut lines = json_lines(&outcome.file(&format!("{reader}.jsonl"))).into_iter();
        let (Some(costs), Some(end)) = (lines.next(), lines.next()) else {
            return Err(format!("{reader} printed too little"));
        };
        let unplugged = unplugs.get(unplug).ok_or("no unplug")?.mono_ns;
        let ended = end["ended_ns"].as_u64().unwrap_or(0).checked_sub(unplugged);
        Ok((costs, end, ended))
    };
    let (theirs, their_end, their_ended) = read("nokhwa", 0)?;
    let (ours, our_end, our_ended) = read("rapid", 1)?;
    let number = |line: &Value, key: &str, scale: f64| line[key].as_f64().map(|value| value / scale);
    let figure = |name: &str, unit, key: &str, scale: f64, [ours, theirs]: [&Value; 2], note: &str| {
        let figure = Figure::new(format!("capture/{name}"), unit, number(ours, key, scale));
        figure.baseline(number(theirs, key, scale)).note(note)
    };
    let (costs, ends) = ([&ours, &theirs], [&our_end, &their_end]);
    let ms = |ns: Option<u64>| ns.map(|ns| ns as f64 / 1e6);
    let note = "baseline: the same camera through nokhwa";
    Ok(vec![
        figure(
            "cpu",
            "us",
            "cpu_us",
            1.0,
            costs,
            "processor time per picture; baseline: the same camera through nokhwa",
        ),
        figure("delivered", "kB", "bytes", 1e3, costs, "handed over per picture"),
        figure("picture", "kB", "picture", 1e3, costs, "of which the picture is, up to its end marker"),
        figure("late p50", "ms", "late_p50_us", 1e3, costs, "from the camera's sending to the reader"),
        figure("late p99", "ms", "late_p99_us", 1e3, costs, note),
        figure(
            "silence",
            "ms",
            "longest_us",
            1e3,
            ends,
            "longest wait for control while the camera is silent for 10 s",
        ),
        Figure::new("capture/unplug", "ms", ms(our_ended))
            .baseline(ms(their_ended))
            .note("from the unplug to an error"),
    ])
}
