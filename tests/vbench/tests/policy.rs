//! A policy at the controls of real drivers: two cameras and an arm's line bring a recorded demonstration, and the
//! tactile camera is pulled out and plugged in again while the policy acts.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde_json::Value;
use vbench::check::{assert_whole, episode, only, play, rises_after};
use vbench::emu::feed;
use vbench::emu::frame;
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::outcome::Outcome;
use vbench::programs;
use vbench::proto;
use vbench::recording::{Recording, falls};
use vbench::scenario::Scenario;

const WORKSPACE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
const BUNDLE: &str = "models/tactile-id";
/// The rig that `rapid --sim task` simulates, here with real drivers.
const REGISTRY: &str = include_str!("../../../src/registry/task.toml");
const WRIST: &str = "/rapid/camera/wrist";
const TACTILE: &str = "/rapid/camera/tactile";
const ARM: &str = "/rapid/serial/arm";
const ACTION: &str = "/action";
const WRIST_BIT: u32 = 0;
const TACTILE_BIT: u32 = 1;
const ARM_BIT: u32 = 2;
/// Emulated processors are slow: more steps would take longer than the actions of a chunk last.
const DENOISING_STEPS: &str = "2";
/// The same arithmetic in other instructions.
const TOLERANCE: f64 = 1e-4;

const SCRIPT: &str = r#"
# used MASK: how many chunks were computed with this mask. more_than N MASK: are there more?
used() { grep -F '"event":"chunk"' $out/rapid.jsonl | grep -cF "\"mask\":\"$1\""; }
more_than() { [ "$(used "$2")" -gt "$1" ]; }
# await_used SECONDS N MASK
await_used() { wait_for "$1" more_than "$2" "$3" || fail "not more than $2 chunks with $3, but $(used "$3")"; }
emu plug 0 1 2
wait_for 60 attached 0 1 2 || fail 'not attached'
udevadm settle
rapid_start --infer /tmp/bench/bundle --wait --denoising-steps STEPS --record --out $out/rec \
  --config /tmp/bench/devices.toml --json
await_rapid 60 '"event":"act"' || fail 'the policy does not act'
await_used 30 2 0x07
emu unplug 1
await_used 30 2 0x05
seen=$(used 0x07)
emu plug 1
await_used 30 $((seen + 2)) 0x07
rapid_stop
emu_quit
exit 0
"#;

#[test]
fn a_policy_goes_on_without_the_tactile_camera_and_takes_it_back() {
    let demonstration = demonstration();
    let pictures = |topic| demonstration.topic(topic).map(|message| proto::bytes(&message.data, 2).to_vec()).collect();
    let (wrist, tactile): (Vec<Vec<u8>>, Vec<Vec<u8>>) = (pictures(WRIST), pictures(TACTILE));
    let line = |row: &Vec<f64>| row.iter().map(f64::to_string).collect::<Vec<_>>().join(",") + "\n";
    let arm: Vec<String> = demonstration.rows(ARM).iter().map(line).collect();
    println!("{} pictures, {} pictures, {} lines", wrist.len(), tactile.len(), arm.len());

    let camera = |pid, serial| DeviceSpec::uvc(0x1209, pid).serial(serial).mode(Format::Mjpg, 96, 96, &[10]);
    let mut scenario = Scenario::new("policy")
        .device(camera(0x7a01, "WRIST").feed("/tmp/bench/wrist"))
        .device(camera(0x7a02, "TACTILE").feed("/tmp/bench/tactile"))
        .device(DeviceSpec::acm(0x1209, 0x7a03, 10.0).serial("ARM").feed("/tmp/bench/arm"))
        .registry(REGISTRY)
        .file("wrist", feed::pack(&wrist))
        .file("tactile", feed::pack(&tactile))
        .file("arm", feed::pack(&arm))
        .limit(Duration::from_secs(180))
        .script(&SCRIPT.replace("STEPS", DENOISING_STEPS));
    for file in ["policy.json", "encoder.onnx", "denoiser.onnx"] {
        let contents = std::fs::read(Path::new(WORKSPACE).join(BUNDLE).join(file)).expect("the bundle of this checkout");
        scenario = scenario.file(&format!("bundle/{file}"), contents);
    }
    let outcome = play(scenario);
    for line in &outcome.rapid {
        println!("{line}");
    }
    panic!("not yet");
}

/// A demonstration of the simulated task, recorded here and now.
fn demonstration() -> Recording {
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
