//! A policy at the controls of real drivers: two cameras and an arm's line bring a recorded demonstration, and the
//! tactile camera is pulled out and plugged in again while the policy acts.

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use vbench::check::{ended, episode, only, play, rises_after, takes};
use vbench::emu::feed;
use vbench::emu::frame;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::outcome::Outcome;
use vbench::programs;
use vbench::proto;
use vbench::recording::{Recording, falls};
use vbench::scenario::Scenario;

const BUNDLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/tactile-id");
/// The rig that `rapid --sim task` simulates, here with real drivers. No driver moves an arm that is read over a serial
/// line: a program takes the actions.
const TASK: &str = concat!(
    include_str!("../../../../src/registry/task.toml"),
    include_str!("../../../../src/registry/task_cameras.toml")
);
const MOVER: &str = r#"
[device.mover]
vid = "0x1209"
pid = "0x7a04"
serial = "MOVER"
node = "process_node"
bit = 3
[device.mover.process]
kind = "scalars"
channels = 2
[device.mover.action]
"#;
pub(crate) const WRIST: &str = "/rapid/camera/wrist";
pub(crate) const TACTILE: &str = "/rapid/camera/tactile";
const ARM: &str = "/rapid/serial/arm";
const BITS: [(u32, &str); 4] = [(0, "cam_wrist"), (TACTILE_BIT, "tactile_tip"), (2, "arm"), (3, "mover")];
const TACTILE_BIT: u32 = 1;
/// Of the policy's 10 Hz.
const TICK_NS: u64 = 100_000_000;
/// The same arithmetic in other instructions.
const TOLERANCE: f64 = 1e-4;

/// Functions of scripts that wait for chunks.
pub(crate) const CHUNKS: &str = r#"
# used MASK: how many chunks were computed with this mask and used. await_used N MASK: until there are more than N.
chunks() { read_lines $out/rapid.jsonl; lines_with 1000000 '"event":"chunk"' '"used":true' "\"mask\":\"$1\""; }
used() { chunks $1; echo $found; }
more_than() { chunks "$2"; [ $found -gt "$1" ]; }
await_used() { wait_for 120 more_than "$1" "$2" || fail "$(used "$2") chunks with the mask $2"; }
"#;

const SCRIPT: &str = r#"
emu plug 0 1 2 3
wait_for 120 attached 0 1 2 3 || fail 'not attached'
udevadm settle
rapid_start --infer /tmp/bench/bundle --wait --record --out $out/rec \
  --config /tmp/bench/devices.toml --json
await_rapid 180 '"event":"act"' || fail 'the policy does not act'
await_used 1 0x0f
emu unplug 1
await_used 1 0x0d
seen=$(used 0x0f)
emu plug 1
await_used $((seen + 1)) 0x0f
rapid_stop
emu_quit
exit 0
"#;

#[test]
fn a_policy_continues_without_the_tactile_camera_and_uses_it_again() {
    if crate::lacks_virtual_time() {
        return;
    }
    let demonstration = demonstration();
    let feeds = [(WRIST, pictures(&demonstration, WRIST)), (TACTILE, pictures(&demonstration, TACTILE))];
    let outcome = play(scenario(&demonstration, &feeds));
    ended(&outcome);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    assert_acted_without_a_pause(&outcome);
    let episode = episode(&outcome);
    for (device, (topic, pictures)) in feeds.iter().enumerate() {
        assert_fed(&episode, topic, device, pictures);
    }

    // The bit of the tactile camera goes and comes, and no other.
    let edges = episode.mask_edges();
    let (unplugged, replugged) = (outcome.actions("unplug", 1)[0].real_ns, outcome.actions("plug", 1)[1].real_ns);
    let fell = only(&falls(&edges, TACTILE_BIT));
    let rose = only(&rises_after(&edges, TACTILE_BIT, fell));
    assert!((unplugged..replugged).contains(&fell) && rose > replugged, "{edges:?}");
    takes(&outcome, "unplug to bit", unplugged, fell, 0.0..=2.5);
    takes(&outcome, "plug to bit within the cooldown", replugged, rose, 500.0..=1_400.0);
    for (bit, name) in BITS.iter().filter(|(bit, _)| *bit != TACTILE_BIT) {
        assert!(falls(&edges, *bit).is_empty(), "the bit of {name} fell: {edges:?}");
    }

    // It acts all the time: with the camera, without it, and with it again.
    let ticks: Vec<(u64, u64)> =
        episode.topic("/action").map(|action| (action.sequence.into(), action.log_time)).collect();
    for (when, from, to) in [("before", 0, fell), ("while", fell, rose), ("after", rose, u64::MAX)] {
        let acted = ticks.iter().filter(|(_, time)| (from..to).contains(time)).count();
        println!("{acted} actions {when} the camera was away");
        assert!(acted >= 2, "{acted} actions {when} the camera was away");
    }

    // What each chunk was computed from.
    let chunks = chunks(&outcome);
    let (first_tick, first_time) = ticks[0];
    let tick_at = |time: u64| (time + first_tick * TICK_NS).saturating_sub(first_time).div_ceil(TICK_NS);
    let without = first_asked(&chunks, tick_at(fell), false, &ticks);
    let with = first_asked(&chunks, tick_at(rose), true, &ticks);
    println!("asked without it {} ticks after the bit was cleared", without.saturating_sub(tick_at(fell)));
    println!("asked with it {} ticks after the bit was set", with.saturating_sub(tick_at(rose)));
    let away = without..with;
    for chunk in &chunks {
        println!("{chunk:?}");
        assert_eq!(chunk.mask == 0b1111, chunk.tactile.len() == 2, "{chunk:?}: present without its bit or the reverse");
        assert!(chunk.mask == 0b1111 || (chunk.mask == 0b1101 && chunk.tactile.is_empty()), "{chunk:?}");
        assert_eq!(chunk.others, 4, "{chunk:?}: the wrist camera and the arm are there");
        assert!(!away.contains(&chunk.tick) || chunk.tactile.is_empty(), "{chunk:?}: asked with a camera that is away");
        // None of the pictures from before it was pulled is looked at after it is back.
        let taken = |number| episode.topic(TACTILE).find(|sample| u64::from(sample.sequence) == number);
        if chunk.tick >= away.end {
            let times = chunk.tactile.iter().map(|number| taken(*number).expect("a recorded picture").log_time);
            assert!(times.into_iter().all(|time| time > replugged), "{chunk:?}: an old picture");
        }
    }
    assert!(chunks.iter().filter(|chunk| away.contains(&chunk.tick)).count() >= 2, "chunks without the camera");

    assert_computed_again(&outcome, &episode, chunks.len());
}

/// A chunk of actions, and what the policy saw.
#[derive(Debug)]
struct Chunk {
    tick: u64,
    mask: u64,
    /// The tick at which it was taken, from which on the next one could be asked for.
    taken: u64,
    /// Numbers of the tactile pictures.
    tactile: Vec<u64>,
    /// How many samples there are of all others.
    others: usize,
}

fn chunks(outcome: &Outcome) -> Vec<Chunk> {
    let read = |line: &Value| {
        let number = |key: &str| line[key].as_u64().unwrap_or_else(|| panic!("no {key}: {line}"));
        let seqs = |modality: &str| -> Vec<u64> {
            let samples = line["samples"].as_array().into_iter().flatten();
            samples
                .filter(|of| of["modality"] == modality)
                .flat_map(|of| of["seqs"].as_array())
                .flatten()
                .filter_map(Value::as_u64)
                .collect()
        };
        let mask = line["mask"].as_str().and_then(|mask| u64::from_str_radix(mask.strip_prefix("0x")?, 16).ok());
        let latency_ms = line["latency_ms"].as_f64().expect("a latency");
        Chunk {
            tick: number("tick"),
            mask: mask.expect("a mask"),
            taken: number("tick") + (latency_ms * 1e6 / TICK_NS as f64).ceil() as u64,
            tactile: seqs("tactile_tip"),
            others: seqs("cam_wrist").len() + seqs("arm").len(),
        }
    };
    outcome.rapid.iter().filter(|line| line["event"] == "chunk").map(read).collect()
}

/// The tick at which the first chunk was asked for with the camera there or not, after its bit changed; `changed` is the
/// first tick after that. It must be asked for within one control step, or one of the moment when the policy was done with
/// what it was asked before. Ticks that a busy guest left out do not count.
fn first_asked(chunks: &[Chunk], changed: u64, there: bool, ticks: &[(u64, u64)]) -> u64 {
    let found = chunks.iter().position(|chunk| chunk.tick + 1 >= changed && chunk.tactile.is_empty() != there);
    let found = found.expect("a chunk after the change");
    let free = chunks[..found].last().map_or(0, |chunk| chunk.taken).max(changed);
    let (asked, steps) =
        (chunks[found].tick, |from: u64, to: u64| ticks.iter().filter(|(tick, _)| (from..to).contains(tick)).count());
    assert!(steps(free, asked) <= 1, "asked at tick {asked}, changed by {changed}, the policy free from {free} on");
    asked
}

/// The recording of the guest's run, computed again here.
fn assert_computed_again(outcome: &Outcome, episode: &Recording, chunks: usize) {
    let (file, bundle) = (episode.path.to_str().expect("a plain name"), outcome.share.join("in/bundle"));
    let bundle = bundle.to_str().expect("a plain name");
    let printed = rapid(&["--json", "replay", file, "--infer", bundle]);
    let found: Value = serde_json::from_str(printed.trim()).unwrap_or_else(|error| panic!("{error}: {printed}"));
    println!("{found}");
    assert_eq!((&found["kind"], &found["policy_hash"]), (&"again".into(), &found["recorded_policy_hash"]), "{found}");
    assert_eq!((&found["chunks"], &found["compared"]), (&chunks.into(), &chunks.into()), "{found}");
    let actions = &found["actions"];
    let recorded = episode.topic("/action").count();
    assert_eq!((&actions["recorded"], &actions["compared"]), (&recorded.into(), &recorded.into()), "{found}");
    for difference in [&found["difference"], &actions["difference"]] {
        assert!(difference["largest"].as_f64().is_some_and(|largest| largest <= TOLERANCE), "{found}");
    }
}

/// Nothing went wrong, and no action came too late.
fn assert_acted_without_a_pause(outcome: &Outcome) {
    let events = |event: &'static str| outcome.rapid.iter().filter(move |line| line["event"] == event);
    // At its first step the first actions are being computed.
    let holds: Vec<&Value> = events("hold").map(|hold| &hold["reason"]).collect();
    assert_eq!(holds, ["the next actions are still being computed"]);
    assert_eq!(events("log").filter(|line| line["level"] == "error").collect::<Vec<_>>(), Vec::<&Value>::new());
    let end = events("policy_end").next().expect("the policy's end");
    println!("{end}");
    assert_eq!([&end["held"], &end["late"], &end["unused"]], [1, 0, 0], "{end}");
}

/// The pictures of a camera are those it was given, in their order and whole.
fn assert_fed(episode: &Recording, topic: &str, device: usize, pictures: &[Vec<u8>]) {
    let mut expected = Vec::new();
    let first = frame::first_number(device);
    let mut count = 0;
    for message in episode.topic(topic) {
        let data = proto::bytes(&message.data, 2);
        let id = frame::identity(data).unwrap_or_else(|| panic!("{topic}: a damaged picture"));
        frame::stamp_jpeg(&pictures[(id.number - first) as usize % pictures.len()], id, &mut expected);
        assert!(data.starts_with(&expected), "{topic}: picture {} is not the one that was given", id.number);
        count += 1;
    }
    println!("{topic}: {count} pictures, as given");
    assert!(count > 0, "{topic}: no picture");
}

fn scenario(demonstration: &Recording, feeds: &[(&str, Vec<Vec<u8>>); 2]) -> Scenario {
    let camera = |pid, serial| DeviceSpec::uvc(0x1209, pid).serial(serial).mode(Format::Mjpg, 96, 96, &[10]);
    let line = |row: &Vec<f64>| row.iter().map(f64::to_string).collect::<Vec<_>>().join(",") + "\n";
    let scenario = Scenario::new("policy")
        .device(camera(0x7a01, "WRIST").feed("/tmp/bench/wrist"))
        .device(camera(0x7a02, "TACTILE").feed("/tmp/bench/tactile"))
        .device(DeviceSpec::acm(0x1209, 0x7a03, 10.0).serial("ARM").feed("/tmp/bench/arm"))
        .device(DeviceSpec::acm(0x1209, 0x7a04, 10.0).serial("MOVER"))
        .registry(&TASK.replace("[device.arm.action]", MOVER.trim()))
        .example("process_node")
        .file("wrist", feed::pack(&feeds[0].1))
        .file("tactile", feed::pack(&feeds[1].1))
        .file("arm", feed::pack(demonstration.rows(ARM).iter().map(line)))
        .script(&[CHUNKS, SCRIPT].concat());
    bundle(scenario, |policy| {
        policy["action"]["actuator"] = "mover".into();
    })
}

/// The scenario with the policy of the repository in its folder `bundle`, changed like this.
pub(crate) fn bundle(scenario: Scenario, change: impl Fn(&mut Value)) -> Scenario {
    ["policy.json", "encoder.onnx", "denoiser.onnx"].into_iter().fold(scenario, |scenario, name| {
        let file = Path::new(BUNDLE).join(name);
        let mut contents = std::fs::read(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        if name == "policy.json" {
            let mut policy: Value = serde_json::from_slice(&contents).expect("JSON");
            change(&mut policy);
            contents = policy.to_string().into();
        }
        scenario.file(&format!("bundle/{name}"), contents)
    })
}

pub(crate) fn pictures(recording: &Recording, topic: &str) -> Vec<Vec<u8>> {
    let pictures: Vec<_> = recording.topic(topic).map(|message| proto::bytes(&message.data, 2).to_vec()).collect();
    assert!(pictures.len() > 50, "{topic}: {} pictures in the demonstration", pictures.len());
    pictures
}

/// A demonstration of the simulated task, recorded here and now.
pub(crate) fn demonstration() -> Recording {
    let folder = std::env::temp_dir().join(format!("vbench-demonstration-{}", std::process::id()));
    let out = folder.to_str().expect("a plain name");
    rapid(&["--sim", "task", "--expert", "--record", "--episodes", "1", "--seed", "1000", "--out", out]);
    let files = std::fs::read_dir(&folder).expect("the folder").flatten().map(|entry| entry.path());
    let file = files.filter(|file| file.extension().is_some_and(|end| end == "mcap")).min().expect("an episode");
    let recording = Recording::open(&file).unwrap_or_else(|error| panic!("{error}"));
    std::fs::remove_dir_all(folder).expect("our own folder");
    recording
}

/// What the `rapid` under test prints here, on the host.
fn rapid(arguments: &[&str]) -> String {
    let program = programs::rapid().unwrap_or_else(|error| panic!("{error}"));
    let ended = Command::new(program).args(arguments).output().expect("it starts");
    assert!(ended.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&ended.stderr));
    String::from_utf8_lossy(&ended.stdout).into_owned()
}
