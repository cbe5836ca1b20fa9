//! `vbench-cycles [N] [--json]`: unplugs and replugs a camera N times while `rapid` records, and measures how soon the
//! mask and the data follow, and how evenly the mask is published; each figure next to that of the simplest possible
//! program in the same guest. A benchmark: it asserts nothing about its figures.

use std::process::ExitCode;
use std::time::Duration;

use serde_json::Value;
use vbench::emu::log::Moment;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::figure::{Figure, heading};
use vbench::latency::Delays;
use vbench::outcome::{Outcome, json_lines};
use vbench::probe::beat;
use vbench::scenario::Scenario;

const TOPIC: &str = "/rapid/camera/wrist";
const MASK: &str = "/rapid/mask";
const REGISTRY: &str = r#"
[rig]
name = "vbench"

[device.cam_wrist]
vid = "0x046d"
pid = "0x0825"
serial = "CAM00A1"
node = "camera"
topic = "/rapid/camera/wrist"
slot = "top"
bit = 0
[device.cam_wrist.camera]
width = 640
height = 480
fps = 30
format = "MJPG"
"#;
/// Recording with the camera plugged, before the first unplug.
const IDLE_MS: u64 = 10_000;
/// Longer than the cooldown minus the time the kernel takes to create a node, so that no cooldown applies.
const OUT_MS: u64 = 2_200;
const IN_MS: u64 = 1_800;
/// The simple program has no cooldown.
const PLAIN_OUT_MS: u64 = 600;
const PLAIN_IN_MS: u64 = 1_800;
const USAGE: &str = "usage: vbench-cycles [CYCLES] [--json]   (50 cycles by default)";

struct Plan {
    cycles: u64,
    json: bool,
}

fn main() -> ExitCode {
    let Some(plan) = Plan::read(std::env::args().skip(1)) else {
        eprintln!("{USAGE}");
        return ExitCode::from(2);
    };
    match plan.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("vbench-cycles: {error}");
            ExitCode::FAILURE
        }
    }
}

impl Plan {
    fn read(arguments: impl Iterator<Item = String>) -> Option<Self> {
        let mut plan = Self { cycles: 50, json: false };
        for word in arguments {
            match word.as_str() {
                "--json" => plan.json = true,
                number => plan.cycles = number.parse().ok().filter(|cycles| *cycles > 0)?,
            }
        }
        Some(plan)
    }

    fn run(&self) -> Result<(), Box<dyn std::error::Error>> {
        let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
        let outcome = self.scenario().run()?;
        if outcome.code != 0 || !matches!(outcome.rapid_code, Some(0 | 4)) {
            return Err(outcome.diagnosis().into());
        }
        let figures = Seen::read(&outcome)?.figures();
        if self.json {
            figures.iter().for_each(|figure| println!("{}", figure.json()));
            return Ok(());
        }
        println!(
            "{} cycles, out {OUT_MS} ms, in {IN_MS} ms; {:.0} s wall; host load at the start {}; QEMU software emulation, 2 processors",
            self.cycles,
            outcome.wall.as_secs_f64(),
            load.split(' ').next().unwrap_or("?")
        );
        println!("{}", heading());
        figures.iter().for_each(|figure| println!("{figure}"));
        Ok(())
    }

    fn scenario(&self) -> Scenario {
        let seconds = (IDLE_MS + self.cycles * (OUT_MS + IN_MS)).div_ceil(1_000);
        let plain_seconds = (self.cycles * (PLAIN_OUT_MS + PLAIN_IN_MS)).div_ceil(1_000) + 30;
        let camera = DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 640, 480, &[30]);
        let script = format!(
            r#"
emu plug 0
wait_for 60 attached 0 || fail 'not attached'
udevadm settle
chrt -f 40 "${{usbemu[@]}}" --beat 2000 $out/beat.bin & watchers=$!
"${{usbemu[@]}}" --watch-mask >$out/mask.jsonl & watchers+=" $!"
"${{usbemu[@]}}" --watch-uevents >$out/uevents.jsonl & watchers+=" $!"
rapid_start --headless --record --out $out/rec --config /tmp/bench/devices.toml --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
await_rapid 60 '"event":"state"' '"device":"cam_wrist"' '"state":"streaming"' || fail 'cam_wrist does not stream'
emu t0
{}
emu_done {seconds}
# After the last plug, however slow the machine is.
wait_for 60 states 2 cam_wrist streaming || fail 'cam_wrist does not stream again'
wait_for 60 is streaming published cam_wrist || fail 'cam_wrist does not stream in the end'
rapid_stop
kill $watchers
emu unplug 0
wait_for 30 detached 0 || fail 'still attached'
udevadm settle
"${{usbemu[@]}}" --first-frames >$out/plain.jsonl & plain_pid=$!
emu t0
{}
emu_done {plain_seconds}
kill $plain_pid
emu_quit
exit 0
"#,
            self.timeline(IDLE_MS, OUT_MS, IN_MS, ["unplug 0", "plug 0"]),
            self.timeline(500, PLAIN_IN_MS, PLAIN_OUT_MS, ["plug 0", "unplug 0"]),
        );
        let limit = Duration::from_secs(seconds + plain_seconds + 180);
        Scenario::new("cycles").emulated().device(camera).registry(REGISTRY).script(&script).limit(limit)
    }

    /// The emulator's commands: two per cycle, the second `between_ms` after the first, the next cycle `rest_ms` later.
    fn timeline(&self, start_ms: u64, between_ms: u64, rest_ms: u64, [first, second]: [&str; 2]) -> String {
        let cycle = |number: u64| {
            let at = start_ms + number * (between_ms + rest_ms);
            format!("emu at {at} {first}\nemu at {} {second}\n", at + between_ms)
        };
        (0..self.cycles).map(cycle).collect()
    }
}

/// The records of all observers, on CLOCK_MONOTONIC, ns, in order.
struct Seen {
    unplugs: Vec<u64>,
    plugs: Vec<u64>,
    /// Those of the simple program's part.
    plain_plugs: Vec<u64>,
    bit_cleared: Vec<u64>,
    bit_set: Vec<u64>,
    uevents: Vec<Value>,
    attached: Vec<u64>,
    waited: usize,
    stream_on: Vec<u64>,
    captured: Vec<u64>,
    received: Vec<u64>,
    plain: Vec<Value>,
    published: Vec<u64>,
    beats: Vec<u64>,
}

impl Seen {
    fn read(outcome: &Outcome) -> Result<Self, Box<dyn std::error::Error>> {
        let episode = outcome.episode()?;
        let starts: Vec<Moment> = outcome.origins();
        let [start, plain_start] = starts[..] else { return Err("the timeline has not two starts".into()) };
        // Both clocks were read at the same moment, and the guest's wall clock is never set.
        let shift = start.real_ns - start.mono_ns;
        let within = |time: &u64| (start.mono_ns..plain_start.mono_ns).contains(time);
        let acts =
            |action| outcome.actions(action, 0).iter().map(|moment| moment.mono_ns).filter(within).collect::<Vec<_>>();
        let plugs = acts("plug");
        let mut unplugs = acts("unplug");
        unplugs.truncate(plugs.len());
        let mut recorded: Vec<(u64, u64)> =
            episode.topic(TOPIC).map(|message| (message.log_time - shift, message.publish_time - shift)).collect();
        recorded.sort_unstable();
        let mut published: Vec<u64> = episode.topic(MASK).map(|message| message.log_time - shift).collect();
        published.sort_unstable();
        let attached = outcome.rapid.iter().filter(|line| line["event"] == "attach");
        Ok(Self {
            unplugs,
            plugs,
            plain_plugs: outcome
                .actions("plug", 0)
                .iter()
                .map(|m| m.mono_ns)
                .filter(|time| *time >= plain_start.mono_ns)
                .collect(),
            bit_cleared: bit(outcome, false),
            bit_set: bit(outcome, true),
            uevents: json_lines(&outcome.file("uevents.jsonl")),
            attached: attached.filter_map(|line| line["stamp"].as_u64()).collect(),
            waited: outcome.states("cam_wrist").iter().filter(|state| **state == "backoff").count(),
            stream_on: outcome.actions("stream_on", 0).iter().map(|moment| moment.mono_ns).collect(),
            captured: recorded.iter().map(|times| times.0).collect(),
            received: recorded.iter().map(|times| times.1).collect(),
            plain: json_lines(&outcome.file("plain.jsonl")),
            published,
            beats: beat::read(&std::fs::read(outcome.share.join("out/beat.bin"))?),
        })
    }

    fn figures(&self) -> Vec<Figure> {
        let mut all = self.unplug_figures();
        all.extend(self.replug_figures());
        all.extend(self.mask_figures());
        all
    }

    fn unplug_figures(&self) -> Vec<Figure> {
        let ours = Delays::between(&self.unplugs, &self.bit_cleared);
        let bare = Delays::between(&self.unplugs, &self.uevents("kernel", "remove", "video4linux"));
        let usb = Delays::between(&self.unplugs, &self.uevents("kernel", "remove", "usb"));
        let note = format!(
            "cable pulled -> bit 0 in shared memory, {}; baseline: the kernel's event in a bare listener (its usb one: p50 {:.1} ms); \
             the paper's detection: 50-100 ms",
            ours.count(),
            usb.quantile(0.5).unwrap_or(f64::NAN)
        );
        let figure = |(name, share, target): (&str, f64, Option<f64>)| {
            let figure = Figure::new(format!("unplug_to_bit_{name}"), "ms", ours.quantile(share));
            Figure { target, ..figure.baseline(bare.quantile(share)) }
        };
        let shares = [("p50", 0.5, Some(30.0)), ("p95", 0.95, Some(90.0)), ("p99", 0.99, None)];
        shares
            .map(figure)
            .into_iter()
            .enumerate()
            .map(|(place, figure)| if place == 0 { figure.note(&note) } else { figure })
            .collect()
    }

    fn replug_figures(&self) -> Vec<Figure> {
        let nodes = self.uevents("udev", "add", "video4linux");
        let reported = self.firsts(&nodes);
        let from_node = Delays::between(&reported, &self.received);
        let from_plug = Delays::between(&self.plugs, &self.received);
        let plain = |key| self.plain.iter().filter_map(|line| line[key].as_u64()).collect::<Vec<_>>();
        let plain_from_node = Delays::between(&plain("reported_ns"), &plain("mono_ns"));
        let plain_streaming = Delays::between(&plain("reported_ns"), &plain("streaming_ns"));
        let plain_from_plug = Delays::between(&self.plain_plugs, &plain("mono_ns"));
        let cooled = if self.waited == 0 {
            "no cooldown applied".into()
        } else {
            format!("{} waited for the cooldown", self.waited)
        };
        let mut all = Vec::new();
        for (name, share) in [("p50", 0.5), ("p95", 0.95)] {
            all.push(
                Figure::new(format!("node_to_first_sample_{name}"), "ms", from_node.quantile(share))
                    .baseline(plain_from_node.quantile(share))
                    .target(60.0)
                    .note(format!(
                        "udev has processed the node -> first recorded sample received, {}, {cooled}; baseline: event of udev, open, \
                         STREAMON, first frame, nothing else",
                        from_node.count()
                    )),
            );
            all.push(
                Figure::new(format!("plug_to_first_sample_{name}"), "ms", from_plug.quantile(share))
                    .baseline(plain_from_plug.quantile(share))
                    .target(1_500.0)
                    .note("from the plug itself; target: the paper's chain, 50-100 ms + 100-200 ms + 0.8-1.5 s"),
            );
        }
        let kernel_nodes = self.uevents("kernel", "add", "video4linux");
        let stages = [
            (
                "stage_kernel_node",
                Delays::between(&self.plugs, &kernel_nodes),
                None,
                "plug -> the kernel has made the node",
            ),
            ("stage_udev", Delays::between(&self.firsts(&kernel_nodes), &nodes), None, "-> udev has processed it"),
            (
                "stage_told",
                Delays::beside(&self.firsts(&kernel_nodes), &reported, &self.attached),
                None,
                "-> rapid has matched it to its entry; below 0 it was notified before the listener of the bench",
            ),
            (
                "stage_open",
                Delays::between(&self.firsts(&self.attached), &self.stream_on),
                plain_streaming.quantile(0.5),
                "-> the camera is set to stream: open, format, rate, buffers, STREAMON",
            ),
            (
                "stage_first_frame",
                Delays::between(&self.firsts(&self.stream_on), &self.captured),
                Delays::between(&plain("streaming_ns"), &plain("mono_ns")).quantile(0.5),
                "-> the first picture begins to arrive; a 30 fps camera takes up to 33 ms for it; baseline: until it has arrived",
            ),
            (
                "stage_transfer",
                Delays::between(&self.firsts(&self.captured), &self.received),
                None,
                "-> it has arrived whole and is published",
            ),
            (
                "stage_bit",
                Delays::between(&self.firsts(&self.received), &self.bit_set),
                None,
                "-> bit 1 in shared memory, as a sampler sees it",
            ),
        ];
        all.extend(stages.into_iter().map(|(name, delays, baseline, note)| {
            Figure::new(format!("{name}_p50"), "ms", delays.quantile(0.5))
                .baseline(baseline)
                .note(format!("{note}; p95 {:.1}", delays.quantile(0.95).unwrap_or(f64::NAN)))
        }));
        all
    }

    fn mask_figures(&self) -> Vec<Figure> {
        let (Some(first), Some(last)) = (self.unplugs.first(), self.plugs.last()) else { return Vec::new() };
        let spans = [("idle", first - IDLE_MS * 1_000_000, *first), ("cycling", *first, last + IN_MS * 1_000_000)];
        let mut all = Vec::new();
        for (when, from, to) in spans {
            let cut = |moments: &[u64]| {
                Delays::apart(&moments.iter().copied().filter(|time| (from..to).contains(time)).collect::<Vec<_>>())
            };
            let (ours, bare) = (cut(&self.published), cut(&self.beats));
            for (name, share) in [("p50", 0.5), ("p95", 0.95), ("p99", 0.99), ("max", 1.0)] {
                let figure = Figure::new(format!("mask_interval_{when}_{name}"), "ms", ours.quantile(share))
                    .baseline(bare.quantile(share));
                all.push(match name {
                    "p50" => figure.target(2.0).note(format!(
                        "from one published mask to the next, {}; baseline: a bare clock_nanosleep loop, SCHED_FIFO as well, at the same time",
                        ours.count()
                    )),
                    _ => figure,
                });
            }
        }
        all
    }

    /// The first of `moments` after each plug and before the next plug.
    fn firsts(&self, moments: &[u64]) -> Vec<u64> {
        let ends = self.plugs.iter().skip(1).copied().chain([u64::MAX]);
        let within = |(plug, end): (&u64, u64)| moments.iter().copied().find(|moment| (*plug..end).contains(moment));
        self.plugs.iter().zip(ends).filter_map(within).collect()
    }

    fn uevents(&self, by: &str, event: &str, subsystem: &str) -> Vec<u64> {
        let wanted = |line: &&Value| {
            // udev identifies which of a camera's nodes captures; it is the first that the kernel creates.
            line["by"] == by
                && line["event"] == event
                && line["subsystem"] == subsystem
                && (by == "kernel" || event == "remove" || line["captures"] == true)
        };
        self.uevents.iter().filter(wanted).filter_map(|line| line["mono_ns"].as_u64()).collect()
    }
}

/// When the sampler saw bit 0 change to this value.
fn bit(outcome: &Outcome, set: bool) -> Vec<u64> {
    let is_set = |line: &Value| {
        let mask = line["mask"].as_str().and_then(|mask| u64::from_str_radix(mask.trim_start_matches("0x"), 16).ok());
        mask.map(|mask| mask & 1 == 1)
    };
    let changes = outcome.mask.iter().filter(|line| is_set(line) == Some(set));
    changes.filter_map(|line| line["mono_ns"].as_u64()).collect()
}
