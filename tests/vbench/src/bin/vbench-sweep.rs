//! `vbench-sweep [9|1] [--json]`: the ablation of the paper's table, three fingers times three sets of modalities, or
//! only the first of the nine configurations, which shows that the tool works. First each is assembled by plugging
//! while one `rapid` records; then each is recorded as an episode by the command that `rapid ablation` prints, until it
//! reports that none is missing. Measures the time that the software takes in each. A benchmark: it asserts nothing
//! about its figures.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use vbench::emu::can::adapter::Protocol;
use vbench::emu::log::Moment;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries;
use vbench::figure::{Figure, heading};
use vbench::latency::Delays;
use vbench::outcome::{Outcome, json_lines};
use vbench::recording::Recording;
use vbench::scenario::Scenario;

/// Target for the software time of one reconfiguration, from the plug on.
const TARGET_MS: f64 = 1_500.0;
/// "Full ablation" of the paper's table of reconfiguration: 9 x 5 s for the quick release, 0 s for discovery.
const PAPER: &str = "the paper counts 45 s of hands for nine, 0 s of software, and some 72 min without its system";
const CAMERA: &str = "/rapid/camera/wrist";
const TACTILE: &str = "/rapid/tactile/tip";
const MOTORS: &str = "/rapid/motors";
const FINGERS: [&str; 3] = ["rigid", "finray", "silicone"];
/// Indexed by their numbers in the emulator.
const ENTRIES: [&str; 3] = ["cam_wrist", "motors", "tactile_tip"];
/// As defined in `rapid ablation`.
const SETS: [Set; 3] = [
    ("vision", &[0], &[CAMERA]),
    ("vision+motors", &[0, 1], &[CAMERA, MOTORS]),
    ("vision+tactile", &[0, 2], &[CAMERA, TACTILE]),
];
const BUS: &str = r#"protocol = "damiao"
silent_after = "400ms"
timeout = "600ms"
motors = [{ name = "grip", slave = 0x05, master = 0x15, type = "DM4310", mode = "position", position = [-1.0, 1.0] }]"#;
/// A configuration is left alone for this long: in this guest checking takes most of the time.
const SETTLE_S: u32 = 5;
/// Pause between two configurations: longer than the cooldown of an entry, and shorter than any manual change.
const HANDS_S: u32 = 3;
const USAGE: &str = "usage: vbench-sweep [9|1] [--json]";

type Failure = Box<dyn std::error::Error>;

/// Every finger with every set, in the order of `rapid ablation`: the sets of one finger are consecutive.
#[derive(Clone, Copy)]
struct Plan {
    fingers: &'static [&'static str],
    sets: &'static [Set],
    json: bool,
}

/// A set of modalities: its name for `rapid ablation`, the numbers of its devices, their topics.
type Set = (&'static str, &'static [usize], &'static [&'static str]);

impl Plan {
    fn read(arguments: impl Iterator<Item = String>) -> Option<Self> {
        let mut plan = Self { fingers: &FINGERS, sets: &SETS, json: false };
        for word in arguments {
            match word.as_str() {
                "--json" => plan.json = true,
                "9" => {}
                "1" => plan = Self { fingers: &FINGERS[..1], sets: &SETS[..1], ..plan },
                _ => return None,
            }
        }
        Some(plan)
    }

    fn configurations(&self) -> usize {
        self.fingers.len() * self.sets.len()
    }

    /// The set of a configuration.
    fn set(&self, place: usize) -> Set {
        self.sets[place % self.sets.len()]
    }

    /// How many of the configurations before this one had the device.
    fn nth(&self, place: usize, device: usize) -> usize {
        (0..place).filter(|before| self.set(*before).1.contains(&device)).count()
    }
}

fn main() -> ExitCode {
    let Some(plan) = Plan::read(std::env::args().skip(1)) else {
        eprintln!("{USAGE}");
        return ExitCode::from(2);
    };
    match run(plan) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("vbench-sweep: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(plan: Plan) -> Result<(), Failure> {
    let outcome = scenario(plan).run()?;
    if outcome.code != 0 {
        return Err(outcome.diagnosis().into());
    }
    let figures = figures(plan, &outcome)?;
    if plan.json {
        figures.iter().for_each(|figure| println!("{}", figure.json()));
        return Ok(());
    }
    println!("{:.0} s wall; QEMU software emulation, 2 processors", outcome.wall.as_secs_f64());
    println!("{}", heading());
    figures.iter().for_each(|figure| println!("{figure}"));
    Ok(())
}

fn scenario(plan: Plan) -> Scenario {
    let mut registry = entries::registry(&[
        entries::camera(ENTRIES[0], CAMERA, 0, Some("CAM1"), (640, 480)),
        entries::can(ENTRIES[1], MOTORS, 1, "1d50:606f", "CAN1", BUS),
        entries::camera(ENTRIES[2], TACTILE, 2, Some("TAC1"), (320, 240)).replace("slot = \"top\"", "slot = \"tip\""),
    ]);
    for finger in plan.fingers {
        registry.push_str(&format!("\n[module.{finger}]\nslot = \"front\"\ntags = [\"finger={finger}\"]\n"));
    }
    let sets: Vec<&str> = plan.sets.iter().map(|(set, ..)| *set).collect();
    let script = format!(
        r#"
# apart DEVICE...: a configuration is taken apart, and a hand takes its time for the next.
apart() {{
  emu unplug "$@"
  wait_for 30 detached "$@" || fail 'still attached'
  udevadm settle
  sleep {HANDS_S}
}}
# next KEY: a field of the next configuration of `rapid ablation`.
next() {{ sed -n 's/.*"event":"next".*/&/p' $out/plan.jsonl | sed -n 's/.*"'"$1"'":\(\[[^]]*\]\|"[^"]*"\).*/\1/p' | tr -d '[]"' | tr ',' ' '; }}
plan() {{
  "${{rapid[@]}}" ablation --finger {fingers} --modality {sets} --episodes 1 --count any --in $out/episodes --json >$out/plan.jsonl \
    || fail 'rapid ablation'
}}
# device ENTRY: its number in the emulator.
device() {{ case $1 in {cam}) echo 0 ;; {motors}) echo 1 ;; {tactile}) echo 2 ;; esac; }}

cd /tmp/bench
sha256sum devices.toml >$out/before
"${{usbemu[@]}}" --watch-uevents >$out/uevents.jsonl & watcher=$!
rapid_start --headless --record --out $out/rec --json
await_rapid 60 '"event":"recording"' || fail 'not recording'
{calls}
rapid_stop
kill $watcher
plan
while has_line $out/plan.jsonl '"event":"next"'; do
  episode=$((${{episode:-0}} + 1))
  [ $episode -le {wanted} ] || fail 'rapid ablation wants more episodes than configurations'
  devices=()
  for entry in $(next plug); do devices+=("$(device $entry)"); done
  emu plug "${{devices[@]}}"
  wait_for 30 attached "${{devices[@]}}" || fail 'not attached'
  udevadm settle
  command=$(next command)
  mark "command-$episode"
  rapid_start ${{command#rapid }} --headless --duration 3s --json
  rapid_wait
  case $(cat $out/rapid.rc) in 0|4) ;; *) fail "$command: $(tail -n 3 $out/rapid.log)" ;; esac
  apart "${{devices[@]}}"
  plan
done
sha256sum -c $out/before || fail 'devices.toml was changed'
emu_quit
exit 0
"#,
        cam = ENTRIES[0],
        motors = ENTRIES[1],
        tactile = ENTRIES[2],
        calls = calls(plan),
        fingers = plan.fingers.join(","),
        sets = sets.join(","),
        wanted = plan.configurations(),
    );
    let camera =
        |serial, width, height| DeviceSpec::uvc(0x046d, 0x0825).serial(serial).mode(Format::Mjpg, width, height, &[30]);
    Scenario::new("sweep")
        .emulated()
        .device(camera("CAM1", 640, 480))
        .device(DeviceSpec::can(Protocol::GsUsb).serial("CAN1").motor(0x05, 0x15, "DM4310"))
        .device(camera("TAC1", 320, 240))
        .registry(&registry)
        .script(&script)
}

/// The part of the script that assembles each configuration once; the outer loop is over the fingers.
fn calls(plan: Plan) -> String {
    let mut script = String::new();
    for place in 0..plan.configurations() {
        let (_, devices, _) = plan.set(place);
        let numbers = devices.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ");
        script.push_str(&format!("emu plug {numbers}\nsleep {SETTLE_S}\n"));
        for device in devices {
            let (entry, nth) = (ENTRIES[*device], plan.nth(place, *device) + 1);
            script.push_str(&format!("wait_for 60 states {nth} {entry} streaming || fail '{entry} does not stream'\n"));
        }
        script.push_str(&format!("apart {numbers}\n"));
    }
    script
}

fn figures(plan: Plan, outcome: &Outcome) -> Result<Vec<Figure>, Failure> {
    let wanted = plan.configurations();
    let hot = outcome.episode()?;
    let nodes = nodes(outcome);
    let hot =
        (0..wanted).map(|place| plugged(plan, outcome, &hot, &nodes, place)).collect::<Result<Vec<Plugged>, _>>()?;
    let plug: Vec<f64> = hot.iter().map(|one| one.all_ms).collect();
    let system = Delays::of(hot.iter().map(|one| one.nodes_ms).collect());
    let files = episodes(outcome)?;
    if files.len() != wanted {
        return Err(format!("{} episodes of {wanted} configurations", files.len()).into());
    }
    let start = files.iter().enumerate().map(|(place, file)| started(plan, outcome, place, file));
    let start = start.collect::<Result<Vec<f64>, _>>()?;
    let done = json_lines(&outcome.file("plan.jsonl"));
    let done = done.iter().filter(|line| line["event"] == "configuration" && line["done"] == true).count();
    let worst = |set: usize| plug.iter().skip(set).step_by(plan.sets.len()).copied().fold(0.0, f64::max);
    let total = (plug.iter().sum::<f64>() + start.iter().sum::<f64>()) / 1e3;
    let (plugs, starts) = (Delays::of(plug.clone()), Delays::of(start));
    let mut figures = vec![
        Figure::new("sweep_plug_to_all_samples_p50", "ms", plugs.quantile(0.5))
            .baseline(system.quantile(0.5))
            .target(TARGET_MS)
            .note(
                "from the last plug of a configuration to the first recorded sample of its slowest modality, \
             one program throughout; baseline: until the guest's kernel and udev have made the last node",
            ),
        Figure::new("sweep_plug_to_all_samples_max", "ms", plugs.quantile(1.0))
            .baseline(system.quantile(1.0))
            .target(TARGET_MS),
    ];
    for (place, (set, ..)) in plan.sets.iter().enumerate() {
        let name = format!("sweep_{}_max", set.replace('+', "_"));
        figures
            .push(Figure::new(name, "ms", Some(worst(place))).target(TARGET_MS).note("the slowest of three fingers"));
    }
    figures.extend([
        Figure::new("sweep_command_to_all_samples_p50", "ms", starts.quantile(0.5))
            .note("from the command that `rapid ablation` gives to the first recorded sample of the slowest modality"),
        Figure::new("sweep_total", "s", Some(total)).note(format!("both of these waits, of all {wanted}; {PAPER}")),
        Figure::new("sweep_configurations_done", "", Some(done as f64))
            .note(format!("of {wanted}, as `rapid ablation` counts them; devices.toml is the same before and after")),
    ]);
    Ok(figures)
}

/// Times from the last plug of a configuration, ms.
struct Plugged {
    /// To the last node that udev has made ready for opening.
    nodes_ms: f64,
    /// To the first sample of the slowest modality.
    all_ms: f64,
}

/// When udev was done with an added camera or network interface, ns of the wall clock.
fn nodes(outcome: &Outcome) -> Vec<u64> {
    let is_ready = |line: &serde_json::Value| {
        let is_node = line["subsystem"] == "net" || line["captures"] == true;
        line["by"] == "udev" && line["event"] == "add" && is_node
    };
    let printed = json_lines(&outcome.file("uevents.jsonl"));
    printed.iter().filter(|line| is_ready(line)).filter_map(|line| line["real_ns"].as_u64()).collect()
}

fn plugged(
    plan: Plan,
    outcome: &Outcome,
    episode: &Recording,
    nodes: &[u64],
    place: usize,
) -> Result<Plugged, Failure> {
    let (set, devices, topics) = plan.set(place);
    let moments = |action: &str| -> Vec<u64> {
        let nth = |device: &usize| outcome.actions(action, *device).get(plan.nth(place, *device)).copied();
        devices.iter().filter_map(nth).map(|moment: Moment| moment.real_ns).collect()
    };
    let plug = moments("plug").into_iter().max().ok_or("a plug is missing")?;
    let first = |topic: &&str| {
        let received = episode.topic(topic).map(|message| message.publish_time);
        received.filter(|received| *received >= plug).min()
    };
    // Events after it was taken apart do not belong to this configuration.
    let limit = moments("unplug").into_iter().min().ok_or("an unplug is missing")?;
    let last = topics.iter().map(first).max().flatten().filter(|last| *last < limit);
    let all = topics.iter().all(|topic| first(topic).is_some());
    let last = last.filter(|_| all).ok_or_else(|| format!("configuration {place}, {set}: a modality sent nothing"))?;
    let ready = nodes.iter().copied().filter(|node| (plug..last).contains(node)).max();
    let ready = ready.ok_or_else(|| format!("configuration {place}, {set}: no node"))?;
    Ok(Plugged { nodes_ms: ms(ready, plug), all_ms: ms(last, plug) })
}

/// Time from the command of an episode to the first sample of its slowest modality, ms.
fn started(plan: Plan, outcome: &Outcome, place: usize, file: &Path) -> Result<f64, Failure> {
    let word = format!("command-{}", place + 1);
    let line = outcome.emu.iter().find(|line| line["action"] == "say" && line["word"] == word.as_str());
    let begun = line.and_then(|line| line["real_ns"].as_u64()).ok_or("a command is missing")?;
    let episode = Recording::open(file)?;
    let mut last = 0;
    for topic in plan.set(place).2 {
        let received = episode.topic(topic).map(|message| message.publish_time).min();
        last = last.max(received.ok_or_else(|| format!("{}: no sample of {topic}", file.display()))?);
    }
    Ok(ms(last, begun))
}

fn ms(later: u64, earlier: u64) -> f64 {
    later.saturating_sub(earlier) as f64 / 1e6
}

/// The episodes, in the order they were recorded.
fn episodes(outcome: &Outcome) -> Result<Vec<PathBuf>, Failure> {
    let folder = std::fs::read_dir(outcome.share.join("out/episodes"))?;
    let mut files: Vec<PathBuf> = folder.flatten().map(|entry| entry.path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "mcap"));
    files.sort();
    Ok(files)
}
