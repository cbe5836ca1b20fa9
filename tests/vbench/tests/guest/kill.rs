//! `kill -9` while `rapid` records a camera and a sensor: the next start makes the episode whole, and reports it.

use std::path::PathBuf;

use vbench::check::{assert_lines, assert_whole, ended, play, takes};
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::{camera, registry, scalars};
use vbench::outcome::{Outcome, json_lines};
use vbench::recording::Recording;
use vbench::scenario::Scenario;

const WRIST: &str = "/rapid/camera/wrist";
const TOF: &str = "/rapid/tof";

const SCRIPT: &str = r#"
record() { rapid_start --headless --record --out $out/rec --config /tmp/bench/devices.toml --json "$@"; }
streaming() {
  await_rapid 60 '"event":"recording"' || fail 'not recording'
  for device in cam_wrist tof; do
    await_rapid 60 '"event":"state"' "\"device\":\"$device\"" '"state":"streaming"' || fail "$device does not stream"
  done
}
larger_than() { [ "$(stat -c %s "$2")" -gt "$1" ]; }
emu plug 0 1
wait_for 60 attached 0 1 || fail 'not attached'
udevadm settle
record
streaming
partial=$(echo $out/rec/*.partial)
# Some seconds of the episode, and then the moment just before more of it would be written.
for _ in 1 2 3 4 5 6 7 8; do
  wait_for 60 larger_than "$(stat -c %s "$partial")" "$partial" || fail 'the file does not grow'
done
sleep 0.3
date +%s%N >$out/killed
kill -9 $rapid_pid
wait $rapid_pid
stat -c '%n %s' $out/rec/* >$out/left
record
streaming
# A repair leaves the processors to everything else, and the end of a run interrupts it.
await_rapid 60 '"event":"recovered"' || fail 'not repaired'
sleep 3
rapid_stop
ls $out/rec >$out/files
emu_quit
exit 0
"#;

#[test]
fn a_killed_recording_is_repaired_at_the_next_start() {
    let outcome = play(
        Scenario::new("kill")
            .device(DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 640, 480, &[30]))
            .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
            .registry(&registry(&[
                camera("cam_wrist", WRIST, 0, Some("CAM00A1"), (640, 480)),
                scalars("tof", TOF, 1, "2e8a:000a", "TOF1"),
            ]))
            .script(SCRIPT),
    );
    ended(&outcome);
    assert!(outcome.emulator_errors().is_empty(), "{:?}", outcome.emulator_errors());
    let left = outcome.file("left");
    assert!(left.lines().count() == 1 && left.contains("_001.mcap.partial "), "{left}");
    let files = outcome.file("files");
    let files: Vec<&str> = files.lines().collect();
    assert!(files.len() == 2 && files[0].ends_with("_001.mcap") && files[1].ends_with("_002.mcap"), "{files:?}");

    let printed = json_lines(&outcome.file("rapid.jsonl"));
    let recovered = printed.iter().find(|line| line["event"] == "recovered").expect("a word on the repaired episode");
    println!("{}", recovered["text"]);
    assert!(recovered["file"].as_str().expect("name").ends_with(files[0]), "{recovered}");

    let episode = open(&outcome, files[0]);
    assert_eq!(recovered["messages"], episode.messages.len());
    assert_whole(&episode, WRIST, ..);
    assert_lines(&episode, TOF);

    // What was published until the kill is there but for its last second: here, what came since the file last grew, which the
    // script's poll saw within 100 ms.
    let killed: u64 = outcome.file("killed").trim().parse().expect("a number");
    let last = episode.topic("/rapid/mask").map(|message| message.log_time).max().expect("a mask");
    takes(&outcome, "lost by a kill -9", last, killed, 300.0..=420.0);

    // The emulator counts the frames it sent, on across runs: those of the second run come after.
    let next = open(&outcome, files[1]);
    let (sent, kept) = (next.numbers(WRIST, ..)[0], episode.numbers(WRIST, ..));
    let kept = *kept.last().expect("a frame");
    assert!(sent > kept, "frame {sent} comes after {kept}");
    println!("frames sent between the last one kept and the next episode: {}", sent - kept - 1);
}

fn open(outcome: &Outcome, name: &str) -> Recording {
    let path: PathBuf = outcome.share.join("out/rec").join(name);
    Recording::open(&path).unwrap_or_else(|error| panic!("{error}"))
}
