//! `vbench-cycles [N] [OUT_MS] [IN_MS]`: pulls and replugs a camera N times while `rapid` records, and prints how soon the
//! mask and the data follow, and how evenly the mask is published. A benchmark: it prints figures and asserts nothing
//! about them.

use std::process::ExitCode;
use std::time::Duration;

use serde_json::Value;
use vbench::emu::log::Moment;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::latency::Delays;
use vbench::outcome::Outcome;
use vbench::recording::{falls, rises};
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
/// Recording before the first unplug and after the last plug.
const MARGIN_MS: u64 = 5_000;

struct Plan {
    cycles: u64,
    out_ms: u64,
    in_ms: u64,
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("vbench-cycles: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), Box<dyn std::error::Error>> {
    let mut numbers = std::env::args().skip(1).map(|word| word.parse::<u64>());
    let plan = Plan {
        cycles: numbers.next().transpose()?.unwrap_or(20),
        out_ms: numbers.next().transpose()?.unwrap_or(3_000),
        in_ms: numbers.next().transpose()?.unwrap_or(5_000),
    };
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let outcome = plan.scenario().run()?;
    if outcome.rapid_code != Some(0) {
        return Err(outcome.diagnosis().into());
    }
    println!(
        "{} cycles, out {} ms, in {} ms; {:.0} s wall; host load at the start {}; QEMU software emulation, 2 processors",
        plan.cycles,
        plan.out_ms,
        plan.in_ms,
        outcome.wall.as_secs_f64(),
        load.split(' ').next().unwrap_or("?")
    );
    report(&outcome)
}

impl Plan {
    fn scenario(&self) -> Scenario {
        let period_ms = self.out_ms + self.in_ms;
        let seconds = (2 * MARGIN_MS + self.cycles * period_ms).div_ceil(1_000);
        let camera = DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 640, 480, &[30]);
        let start = Scenario::new("cycles")
            .device(camera)
            .registry(REGISTRY)
            .record(u32::try_from(seconds).unwrap_or(u32::MAX), &["cam_wrist"])
            .limit(Duration::from_secs(seconds + 120))
            .watch_mask();
        (0..self.cycles).fold(start, |scenario, cycle| {
            let out = MARGIN_MS + cycle * period_ms;
            scenario.at(out, "unplug 0").at(out + self.out_ms, "plug 0")
        })
    }
}

fn report(outcome: &Outcome) -> Result<(), Box<dyn std::error::Error>> {
    let episode = outcome.episode()?;
    let edges = episode.mask_edges();
    // The first plug was before the recording, the last unplug is the emulator's own at its end.
    let plugs = outcome.actions("plug", 0).split_off(1);
    let mut unplugs = outcome.actions("unplug", 0);
    unplugs.truncate(plugs.len());
    let mono = |moments: &[Moment]| moments.iter().map(|moment| moment.mono_ns).collect::<Vec<_>>();
    let real = |moments: &[Moment]| moments.iter().map(|moment| moment.real_ns).collect::<Vec<_>>();
    let mut samples: Vec<u64> = episode.topic(TOPIC).map(|message| message.log_time).collect();
    samples.sort_unstable();
    let mut published: Vec<u64> = episode.topic(MASK).map(|message| message.log_time).collect();
    published.sort_unstable();

    let rows = [
        ("unplug -> bit 0, shared memory", Delays::between(&mono(&unplugs), &seen(outcome, false))),
        ("unplug -> bit 0, mask channel", Delays::between(&real(&unplugs), &falls(&edges, 0))),
        ("plug -> first recorded sample", Delays::between(&real(&plugs), &samples)),
        ("plug -> bit 1, shared memory", Delays::between(&mono(&plugs), &seen(outcome, true))),
        ("plug -> bit 1, mask channel", Delays::between(&real(&plugs), &rises(&edges, 0))),
        ("mask, one message to the next", Delays::apart(&published)),
    ];
    for (what, delays) in rows {
        println!("{what:<32} {delays}");
    }
    println!("{:<32} 1000-1800 ms, on its authors' hardware", "paper, USB -> visualization");
    Ok(())
}

/// When the sampler saw bit 0 take this value, CLOCK_MONOTONIC.
fn seen(outcome: &Outcome, set: bool) -> Vec<u64> {
    let is_set = |line: &Value| {
        let mask = line["mask"].as_str().and_then(|mask| u64::from_str_radix(mask.trim_start_matches("0x"), 16).ok());
        mask.map(|mask| mask & 1 == 1)
    };
    let changes = outcome.mask.iter().filter(|line| is_set(line) == Some(set));
    changes.filter_map(|line| line["mono_ns"].as_u64()).collect()
}
