//! Accidents while a machine records: its clock is set, its disk fills up, its folder is moved or removed.

use std::path::PathBuf;

use vbench::check::{assert_lines, assert_whole, play, unexpected};
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::{camera, registry, scalars};
use vbench::outcome::{Outcome, json_lines};
use vbench::recording::Recording;
use vbench::scenario::Scenario;

const WRIST: &str = "/rapid/camera/wrist";
const TOF: &str = "/rapid/tof";

const SCRIPT: &str = r#"
config=/tmp/bench/devices.toml
record() {
  rapid_start --headless --record --out $1 --config $config --json
  await_rapid 60 '"event":"recording"' || fail 'not recording'
  for device in cam_wrist tof; do
    await_rapid 60 '"event":"state"' "\"device\":\"$device\"" '"state":"streaming"' || fail "$device does not stream"
  done
  grown $1/*.partial
}
larger_than() { [ "$(stat -c %s "$2")" -gt "$1" ]; }
# Some pictures more than now.
grown() { wait_for 60 larger_than $(($(stat -c %s "$1") + 500000)) "$1" || fail "$1 does not grow"; }
# wait_for goes by the clock, which is set here.
patiently() { for _ in $(seq 3000); do "$@" && return; pause 0.1; done; return 1; }
steps() { has_lines $1 $out/rapid.jsonl '"event":"clock_step"'; }
kept() { cp $out/rapid.jsonl $out/$1.jsonl; cp $out/rapid.rc $out/$1.rc; cp -r $2 $out/$1; }
refused() { "${rapid[@]}" --headless --record --duration 1s --out $2 --config $config >$out/$1.txt 2>&1; echo $? >$out/$1.rc; }
emu plug 0 1
wait_for 60 attached 0 1 || fail 'not attached'
udevadm settle

record /tmp/clock
date -s '1 hour' >/dev/null
patiently steps 1 || fail 'the step forward is not reported'
date -s '3 hours ago' >/dev/null
patiently steps 2 || fail 'the step back is not reported'
sleep 1
rapid_stop
date -s '2 hours' >/dev/null
kept clock /tmp/clock

record /tmp/moved
mv /tmp/moved /tmp/elsewhere
grown /tmp/elsewhere/*.partial
rapid_stop
kept moved /tmp/elsewhere

record /tmp/removed
rm -r /tmp/removed
await_rapid 60 removed || fail 'the removal is not reported'
sleep 1
rapid_stop
kept removed /tmp/removed

mkdir /tmp/small
mount -t tmpfs -o size=24m small /tmp/small
record /tmp/small/rec
head -c 18M /dev/zero >/tmp/small/fill 2>/dev/null
ended() { ! kill -0 $rapid_pid; }
wait_for 60 ended || fail 'a run on a full disk does not end'
rapid_wait
kept full /tmp/small/rec
refused next /tmp/small/rec
mount -o remount,ro /tmp/small
refused read_only /tmp/small/rec
emu_quit
exit 0
"#;

#[test]
fn an_episode_survives_clock_steps_a_full_disk_and_a_removed_folder() {
    let outcome = play(
        Scenario::new("accidents")
            .device(DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 640, 480, &[30]))
            .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
            .registry(&registry(&[
                camera("cam_wrist", WRIST, 0, Some("CAM00A1"), (640, 480)),
                scalars("tof", TOF, 1, "2e8a:000a", "TOF1"),
            ]))
            .script(SCRIPT),
    );
    assert_eq!(outcome.code, 0, "{}", outcome.log);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());

    clock(&outcome);
    for name in ["moved", "removed"] {
        assert_eq!(outcome.file(&format!("{name}.rc")).trim(), "0", "{name}");
        whole(&outcome, name);
    }
    full(&outcome);
}

/// Both steps are reported, and the times of the episode know nothing of them.
fn clock(outcome: &Outcome) {
    assert_eq!(outcome.file("clock.rc").trim(), "0");
    let printed = json_lines(&outcome.file("clock.jsonl"));
    let steps: Vec<f64> = printed
        .iter()
        .filter(|line| line["event"] == "clock_step")
        .filter_map(|line| line["seconds"].as_f64())
        .collect();
    println!("the clock was set by {steps:?} s");
    // `date` counts from the moment at which it was started.
    assert!(steps.len() == 2 && (steps[0] - 3600.0).abs() < 60.0 && (steps[1] + 10_800.0).abs() < 60.0, "{steps:?}");
    let episode = whole(outcome, "clock");
    let times: Vec<u64> = episode.topic("/rapid/mask").map(|message| message.log_time).collect();
    let longest = times.windows(2).map(|pair| pair[1].checked_sub(pair[0]).expect("a time that goes back")).max();
    println!("longest time between two masks: {longest:?} ns");
    assert!(longest.is_some_and(|longest| longest < 60_000_000_000), "{longest:?}");
}

/// Another program takes the last byte: warned of beforehand, closed whole, the next refused, and so is one on a disk that takes no bytes.
fn full(outcome: &Outcome) {
    let printed = json_lines(&outcome.file("full.jsonl"));
    assert!(printed.iter().any(|line| line["event"] == "disk_low"), "nearly full is not reported");
    let ended = printed.iter().find(|line| line["event"] == "episode").expect("the episode's end");
    println!("{ended}");
    let reasons = unexpected(outcome, ended);
    assert!(reasons.len() == 1 && reasons[0].contains("No space left on device"), "{ended}");
    assert_eq!(ended["verdict"], "SUSPECT", "{ended}");
    assert_eq!(outcome.file("full.rc").trim(), "1");
    whole(outcome, "full");
    for (name, words) in [("next", "the disk is full"), ("read_only", "Read-only file system")] {
        let text = outcome.file(&format!("{name}.txt"));
        println!("{text}");
        assert_ne!(outcome.file(&format!("{name}.rc")).trim(), "0", "{text}");
        assert!(text.contains(words), "{words} not in: {text}");
    }
}

/// The one finished file of a folder: no picture and no line of it is missing.
fn whole(outcome: &Outcome, folder: &str) -> Recording {
    let files = std::fs::read_dir(outcome.share.join("out").join(folder)).expect("the folder").flatten();
    let files: Vec<PathBuf> = files.map(|entry| entry.path()).collect();
    assert!(files.len() == 1 && files[0].extension().is_some_and(|end| end == "mcap"), "{folder}: {files:?}");
    let episode = Recording::open(&files[0]).unwrap_or_else(|error| panic!("{error}"));
    assert_whole(&episode, WRIST, ..);
    assert_lines(&episode, TOF);
    episode
}
