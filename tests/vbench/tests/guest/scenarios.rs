//! `rapid` on the virtual bench, and first the bench against itself.
//!
//! Wall-clock times in a recording are compared with the emulator's: both run in one guest, on one clock.

use vbench::check::{
    assert_lines, assert_whole, episode, first_sample, only, play, recorded, recorded_with, rises_after, takes,
};
use vbench::emu::spec::{DeviceSpec, Format};
use vbench::entries::{camera, registry, scalars};
use vbench::outcome::Outcome;
use vbench::recording::{Edge, falls, missing};
use vbench::scenario::Scenario;

/// Two cameras of different formats, both serial kinds, a chip with lines, a virtual CAN bus: nodes, udev properties, frames, and the
/// way back.
#[test]
fn bench_shows_the_guest_real_devices() {
    let script = r#"
emu plug 0 1 2 3 4
wait_for 60 attached 0 1 2 3 4 || fail 'not attached'
wait_for 30 test -e /dev/video2 -a -e /dev/ttyACM0 -a -e /dev/ttyUSB0 -a -c /dev/gpiochip0 || fail "not all nodes: $(ls /dev)"
udevadm settle
modprobe vcan
ip link add vcan0 type vcan && ip link set vcan0 up || fail 'no vcan'
for node in video0 video1 video2 ttyACM0 ttyUSB0; do
  echo "$node $(property /dev/$node ID_SERIAL_SHORT) $(property /dev/$node ID_VENDOR_ID):$(property /dev/$node ID_MODEL_ID) $(property /dev/$node ID_V4L_CAPABILITIES)"
done >$out/nodes
"${usbemu[@]}" --read /dev/video0 90 >$out/mjpg.json
# It gives up after 15 s, in which the others are read.
emu silent 0 1
emu_done 10
"${usbemu[@]}" --read /dev/video0 5 2>$out/silent.err &
silent=$!
"${usbemu[@]}" --read /dev/video2 45 >$out/yuyv.json
for tty in ttyACM0 ttyUSB0; do
  stty -F /dev/$tty raw -echo
  timeout 120 head -n 50 /dev/$tty >$out/$tty.csv
done
wait $silent
emu silent 0 0
"${usbemu[@]}" --read /dev/video0 5 >$out/again.json
emu unplug 0 1 2 3 4
wait_for 30 detached 0 1 2 3 4 || fail 'still attached'
udevadm settle
ls /dev | grep -E '^(video|ttyACM|ttyUSB|gpiochip)' >$out/left
emu port 0 6
emu plug 0
wait_for 30 attached 6 || fail 'not in the other port'
emu_quit
exit 0
"#;
    let outcome = play(
        Scenario::new("self")
            .device(DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").mode(Format::Mjpg, 640, 480, &[30]))
            .device(DeviceSpec::uvc(0x046d, 0x0825).mode(Format::Yuyv, 320, 240, &[15]))
            .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
            .device(DeviceSpec::ftdi(0x0403, 0x6001, 50.0).serial("FT1"))
            .device(DeviceSpec::gpio().serial("GPIO1"))
            .script(script),
    );
    assert_eq!(outcome.code, 0, "{}", outcome.log);
    assert!(outcome.emulator_errors().is_empty());

    let nodes = outcome.file("nodes");
    // The second node of a camera is for metadata.
    for line in [
        "video0 CAM00A1 046d:0825 :capture:",
        "video1 CAM00A1 046d:0825 :",
        "ttyACM0 TOF1 2e8a:000a ",
        "ttyUSB0 FT1 0403:6001 ",
    ] {
        assert!(nodes.lines().any(|found| found == line), "{line} not in:\n{nodes}");
    }
    // A device without a serial descriptor has no short serial either.
    assert!(nodes.lines().any(|found| found == "video2  046d:0825 :capture:"), "{nodes}");

    // The second stream of the first camera is the silent one.
    let (mjpg, yuyv) = (outcome.streams(0, 1), outcome.streams(1, 1));
    for (name, format, fps, stream) in [
        ("mjpg.json", "MJPG", 30.0, mjpg[0]),
        ("yuyv.json", "YUYV", 15.0, yuyv[0]),
        ("again.json", "MJPG", 30.0, mjpg[2]),
    ] {
        let read: serde_json::Value = serde_json::from_str(&outcome.file(name)).unwrap();
        println!("{name}: {read}, {stream:?}");
        assert_eq!(read["format"], format);
        assert_eq!([&read["damaged"], &read["holes"], &read["repeats"]], [0, 0, 0], "{read}");
        // A frame is sent at its beat or within one after it; what a busy machine delays more is skipped and counted.
        let beats = read["sent_in_ns"].as_f64().unwrap() * fps / 1e9;
        let intervals = read["frames"].as_u64().unwrap() - 1;
        assert!(intervals < stream.sent, "{stream:?}");
        let most = (intervals + stream.skipped + 1) as f64;
        assert!(beats > intervals as f64 - 1.0, "{intervals} frames within {beats} beats: faster than {fps} fps");
        assert!(beats < most, "{intervals} frames took {beats} beats, of which {} were skipped", stream.skipped);
    }
    assert!(outcome.file("silent.err").contains("no frame within 15 s"), "{}", outcome.file("silent.err"));

    for tty in ["ttyACM0.csv", "ttyUSB0.csv"] {
        let text = outcome.file(tty);
        // The first line may have been cut by opening the port.
        let numbers: Vec<u64> =
            text.lines().skip(1).map(|line| line.split(',').next().unwrap().parse().unwrap()).collect();
        assert_eq!(numbers.len(), 49);
        assert_eq!(missing(numbers), 0, "{tty}");
    }
    assert_eq!(outcome.file("left"), "", "nodes outlived their devices");
    assert_eq!((outcome.actions("plug", 0).len(), outcome.actions("unplug", 0).len()), (2, 2));
}

const NONE: [u64; 0] = [];
const WRIST: &str = "/rapid/camera/wrist";
const SIDE: &str = "/rapid/camera/side";
const TOF: &str = "/rapid/tof";

/// Two cameras and a distance sensor; the second camera is out for 3 s, from when its absence is known, and then the first one is
/// silent for a while: what stops sending without leaving is stalled, not absent. The mask shows plugs, not data.
#[test]
fn an_unplug_clears_one_bit_and_a_silence_none() {
    let registry = registry(&[
        camera("cam_wrist", WRIST, 0, Some("CAM00A1"), (640, 480)),
        camera("cam_side", SIDE, 1, Some("CAM00B2"), (320, 240)),
        scalars("tof", TOF, 2, "2e8a:000a", "TOF1"),
    ]);
    let scenario = Scenario::new("unplug")
        .device(vga("CAM00A1"))
        .device(DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00B2").mode(Format::Mjpg, 320, 240, &[30]))
        .device(DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1"))
        .registry(&registry)
        .record(2, &["cam_wrist", "cam_side", "tof"])
        .at(2_000, "unplug 1")
        .when("states 1 cam_side absent")
        .at(3_000, "plug 1")
        .when("states 2 cam_side streaming")
        .at(1_000, "silent 0 1")
        .when("states 1 cam_wrist stalled")
        .at(1_000, "silent 0 0")
        .until("states 2 cam_wrist streaming");
    let outcome = recorded_with(scenario, |reason| reason.starts_with("cam_wrist: no sample for 1."));
    let episode = episode(&outcome);
    let edges = episode.mask_edges();
    let unplugged = outcome.actions("unplug", 1)[0].real_ns;
    let replugged = outcome.actions("plug", 1)[1].real_ns;

    assert_eq!(falls(&edges, 0), NONE, "the wrist camera stayed plugged, silent or not");
    assert_eq!(falls(&edges, 2), NONE, "the sensor stayed plugged");
    assert_eq!(outcome.actions("stream_on", 0).len(), 1, "the wrist camera was started once");
    assert_eq!(outcome.actions("stream_off", 0).len(), 1, "the wrist camera was stopped once, at the end");
    assert_whole(&episode, WRIST, ..);
    assert_lines(&episode, TOF);

    let fell = only(&falls(&edges, 1));
    assert!(fell >= unplugged, "the bit fell {} ms before the unplug", (unplugged - fell) / 1_000_000);
    takes(&outcome, "unplug to bit", unplugged, fell, 0.0..=2.5);
    assert!(fell < replugged, "the bit fell only after the replug");
    let rose = only(&rises_after(&edges, 1, fell));
    assert!(rose >= replugged, "the bit rose before the replug");
    takes(&outcome, "plug to bit", replugged, rose, 530.0..=590.0);
    takes(&outcome, "plug to first picture", replugged, first_sample(&episode, SIDE, fell), 530.0..=590.0);

    assert_eq!(episode.channels(SIDE).len(), 1, "the camera came back on another channel");
    assert_whole(&episode, SIDE, ..fell);
    assert_whole(&episode, SIDE, replugged..);
    assert_eq!(episode.numbers(SIDE, fell..replugged), NONE, "frames of a camera that was not there");

    assert_stalled(&outcome);
    assert_read_alike(&episode.path, &edges);
}

/// The wrist camera was stalled and streamed again, without a new start.
fn assert_stalled(outcome: &Outcome) {
    let states = outcome.states("cam_wrist");
    let from = states.iter().position(|state| *state == "streaming").expect("streaming at first");
    assert_eq!(states[from..], ["streaming", "stalled", "streaming"]);
    let stalled = outcome.rapid.iter().find(|line| line["state"] == "stalled" && line["device"] == "cam_wrist");
    let stalled = stalled.and_then(|line| line["stamp"].as_u64()).expect("a stamp");
    takes(outcome, "silence to stalled", outcome.actions("silent", 0)[0].mono_ns, stalled, 450.0..=550.0);
}

/// A reader that shares no code with us, Python's mcap, finds these edges of the mask at these times. Which mask the
/// episode begins with is not compared: on a slow machine it begins before all devices are there.
fn assert_read_alike(episode: &std::path::Path, edges: &[Edge]) {
    let read = independent_reader(episode);
    println!("read by Python: {}", read["mask_edges"]);
    let number = |mask: &serde_json::Value, field: &str| mask[field].as_f64().expect("a number");
    let masks = read["mask_edges"].as_array().expect("a list");
    let read: Vec<(u32, bool, f64)> = masks
        .windows(2)
        .flat_map(|pair| {
            let [before, after] = [0, 1].map(|place| pair[place]["mask"].as_u64().expect("a mask"));
            let changed = (0..u64::BITS).filter(move |bit| (before ^ after) >> bit & 1 == 1);
            changed.map(move |bit| (bit, after >> bit & 1 == 1, number(&pair[1], "at")))
        })
        .collect();
    let which = |bits: &[(u32, bool, f64)]| bits.iter().map(|edge| (edge.0, edge.1)).collect::<Vec<_>>();
    let ours: Vec<(u32, bool, f64)> =
        edges.iter().map(|edge| (edge.bit, edge.rises, (edge.log_time - edges[0].log_time) as f64 / 1e9)).collect();
    assert_eq!(which(&read), which(&ours));
    for (theirs, ours) in read.iter().zip(&ours) {
        let at = theirs.2 - read[0].2;
        assert!(
            (at - ours.2).abs() < 1e-6,
            "bit {} changed {at} s after the first change instead of {} s",
            ours.0,
            ours.2
        );
    }
}

/// What `tests/python/read_episode.py` reads in an episode, run by the Python of `make setup`.
fn independent_reader(episode: &std::path::Path) -> serde_json::Value {
    let home = || std::path::PathBuf::from(std::env::var_os("HOME").expect("a home directory"));
    let cache = || std::env::var_os("XDG_CACHE_HOME").map_or_else(|| home().join(".cache"), Into::into);
    let python = std::env::var_os("RAPID_PYTHON").map_or_else(|| cache().join("rapid/venv/bin/python"), Into::into);
    let script = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../python/read_episode.py");
    let read = std::process::Command::new(&python).arg(script).arg(episode).output();
    let read = read.unwrap_or_else(|error| panic!("{}: {error}; run `make setup`", python.display()));
    assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));
    serde_json::from_slice(&read.stdout).expect("JSON")
}

/// A camera is gone for 0.3 s, first back in its port, then in another: both times it streams again as the same modality.
#[test]
fn a_quick_replug_is_not_lost() {
    let outcome = recorded(
        Scenario::new("replug")
            .device(vga("CAM00A1"))
            .registry(&registry(&[camera("cam_wrist", WRIST, 0, Some("CAM00A1"), (640, 480))]))
            .record(2, &["cam_wrist"])
            .at(2_000, "unplug 0")
            .at(2_300, "plug 0")
            .when("states 2 cam_wrist streaming")
            .at(1_000, "unplug 0")
            .at(1_000, "port 0 5")
            .at(1_300, "plug 0")
            .until("states 3 cam_wrist streaming"),
    );
    let episode = episode(&outcome);
    let edges = episode.mask_edges();
    let plugs = outcome.actions("plug", 0);
    let unplugs = outcome.actions("unplug", 0);
    let fell = falls(&edges, 0);
    assert_eq!(fell.len(), 2, "two unplugs, two falling edges: {edges:?}");
    for ((fell, unplugged), replugged) in fell.iter().zip(&unplugs).zip(&plugs[1..]) {
        assert!(*fell >= unplugged.real_ns);
        let rose = *rises_after(&edges, 0, *fell).first().expect("the bit came back");
        assert!(rose >= replugged.real_ns);
        takes(&outcome, "unplug to bit", unplugged.real_ns, *fell, 0.0..=2.5);
        // The rest of the cooldown of 2 s, and the camera's start.
        takes(&outcome, "plug to bit within the cooldown", replugged.real_ns, rose, 1_700.0..=1_770.0);
    }
    assert_eq!(episode.channels(WRIST).len(), 1);
    assert_whole(&episode, WRIST, ..unplugs[0].real_ns);
    assert_whole(&episode, WRIST, plugs[1].real_ns..unplugs[1].real_ns);
    assert_whole(&episode, WRIST, plugs[2].real_ns..);
}

/// Two units that differ by their ports alone fill two entries; each keeps its own when the other leaves, and gets it back.
#[test]
fn identical_units_keep_their_entries() {
    let registry =
        registry(&[camera("cam_left", WRIST, 0, None, (640, 480)), camera("cam_right", SIDE, 1, None, (640, 480))]);
    let outcome = recorded(
        Scenario::new("equal")
            .device(vga(""))
            .device(vga(""))
            .registry(&registry)
            .record(6, &["cam_left", "cam_right"])
            .at(2_000, "unplug 1")
            // Which entry the unit has is not known here.
            .when("eval 'is absent published cam_left || is absent published cam_right'")
            .at(3_000, "plug 1")
            .until("eval 'is streaming published cam_left && is streaming published cam_right'"),
    );
    let episode = episode(&outcome);
    let edges = episode.mask_edges();
    let unit = |topic| {
        let mut units: Vec<usize> =
            episode.frames(topic).iter().filter_map(|frame| frame.id).map(|id| id.device()).collect();
        units.dedup();
        units
    };
    let (left, right) = (unit(WRIST), unit(SIDE));
    assert!(left.len() == 1 && right.len() == 1 && left != right, "an entry changed its unit: {left:?} {right:?}");
    let (moved, stayed) = if right == [1] { ((1, SIDE), (0, WRIST)) } else { ((0, WRIST), (1, SIDE)) };

    assert_eq!(falls(&edges, stayed.0), NONE, "the unit that stayed lost its bit");
    assert_whole(&episode, stayed.1, ..);
    let fell = only(&falls(&edges, moved.0));
    let replugged = outcome.actions("plug", 1)[1].real_ns;
    assert!(fell >= outcome.actions("unplug", 1)[0].real_ns && fell < replugged);
    assert!(only(&rises_after(&edges, moved.0, fell)) >= replugged);
    assert_whole(&episode, moved.1, ..fell);
    assert_whole(&episode, moved.1, replugged..);
}

fn vga(serial: &str) -> DeviceSpec {
    DeviceSpec::uvc(0x046d, 0x0825).serial(serial).mode(Format::Mjpg, 640, 480, &[30])
}
