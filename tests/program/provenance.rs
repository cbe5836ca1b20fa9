//! What a recorded episode holds about its devices, and what `latency` does to its frames: from a run of
//! the binary to the finished file.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use crate::support::{self, Episode, Place, until};
use rustix::process::Signal;
use serde_json::{Value, json};

/// Two equal cameras, of which one is configured as late by three of its pictures, and a serial line.
const REGISTRY: &str = r#"
[rig]
name = "bench-7"

[device.cam_wrist]
vid = "046d"
pid = "0825"
serial = "CAM00A1"
node = "camera"
latency = "100ms"
bit = 4
[device.cam_wrist.camera]
width = 64
height = 48
fps = 30
[device.cam_wrist.camera.controls]
auto_exposure = 1
exposure_time_absolute = 150

[device.cam_top]
vid = "046d"
pid = "0826"
port = "1-2.3"
node = "camera"
bit = 0
[device.cam_top.camera]
width = 64
height = 48
fps = 30

[device.motor_state]
vid = "2e8a"
pid = "000a"
node = "serial"
bit = 2
[device.motor_state.tty]
baud = 115200
channels = 3
"#;

fn recorded(place: &Place) -> Episode {
    let registry = place.write("rig.toml", REGISTRY).display().to_string();
    let scenario = "[[device]]\nname = \"cam_wrist\"\nfirmware = \"2.07\"\n[[device]]\nname = \"cam_top\"\n\
                    serial = \"\"\n[[device]]\nname = \"motor_state\"\nserial = \"MOT-9\"\n";
    let scenario = place.write("play.toml", scenario).display().to_string();
    let arguments = ["--config", &registry, "--sim", &scenario, "--headless", "--json", "--record", "--out", "out"];
    let arguments = [&arguments[..], &["--task", "place block", "--tag", "finger=soft"]].concat();
    let running = place.start(&arguments, "\"event\":\"recording\"");
    let streaming = || running.reported().iter().filter(|event| event["state"] == "streaming").count();
    until("all three are streaming", || streaming() == 3);
    let begun = place.published();
    until("two seconds", || place.published() > begun + 1000);
    running.signal(Signal::INT);
    let (code, output, errors) = running.end();
    assert_eq!(code, support::recorded_code(&output), "{errors}");
    let files = place.files("out");
    let [file] = files.as_slice() else { panic!("{files:?}") };
    Episode::read(&place.path("out").join(file))
}

#[test]
fn an_episode_names_unit_driver_format_controls_latency_registry_and_software() {
    let place = Place::new();
    let episode = recorded(&place);
    let printed = |key| episode.value("rapid", key);
    let json = |record, key| -> Value { serde_json::from_str(episode.value(record, key)).expect("JSON") };
    assert_eq!(printed("software"), format!("rapid {}", env!("CARGO_PKG_VERSION")));
    assert_eq!((printed("rig"), printed("task"), printed("registry")), ("bench-7", "place block", REGISTRY));
    assert_eq!(json("rapid", "tags"), json!({"finger": "soft"}));
    assert_eq!(json("rapid", "layout"), json!({"cam_top": 0, "motor_state": 2, "cam_wrist": 4}));
    let latencies: Vec<_> =
        json("rapid", "modalities").as_array().expect("a list").iter().map(|one| one["latency_ns"].clone()).collect();
    assert_eq!(latencies, [0, 0, 100_000_000]);

    // A device that was slow to start is in the end's record alone.
    let serials = json!({"cam_wrist": "CAM00A1", "cam_top": null, "motor_state": "MOT-9"});
    assert_eq!(json("rapid/summary", "serials"), serials);
    let provenance = json("rapid/summary", "provenance");
    let driver = json!({"name": "rapid-sim", "version": env!("CARGO_PKG_VERSION")});
    for (name, expected) in [
        (
            "cam_wrist",
            json!({
                "node": "sim:cam_wrist", "vid": "046d", "pid": "0825", "serial": "CAM00A1", "firmware": "2.07",
                "manufacturer": "rapid", "product": "simulated cam_wrist", "driver": driver,
                "format": {"fourcc": "MJPG", "width": 64, "height": 48, "fps": 30.0},
                "controls": {"auto_exposure": 1, "exposure_time_absolute": 150}, "latency_ns": 100_000_000,
            }),
        ),
        (
            "cam_top",
            json!({
                "node": "sim:cam_top", "vid": "046d", "pid": "0826", "serial": null, "port": "1-2.3", "driver": driver,
                "format": {"fourcc": "MJPG", "width": 64, "height": 48, "fps": 30.0}, "controls": {}, "latency_ns": 0,
            }),
        ),
        (
            "motor_state",
            json!({
                "serial": "MOT-9", "driver": driver, "format": {"channels": 3, "hz": 100.0}, "controls": {},
                "latency_ns": 0,
            }),
        ),
    ] {
        let epochs = provenance[name].as_array().unwrap_or_else(|| panic!("no {name}: {provenance}"));
        let [epoch] = epochs.as_slice() else { panic!("one epoch of {name}: {provenance}") };
        for (key, value) in expected.as_object().expect("an object") {
            assert_eq!(epoch.get(key), Some(value), "{key} of {name}: {epoch}");
        }
        assert!(epoch["epoch"].as_u64().is_some() && epoch["from_s"].as_f64().is_some(), "{epoch}");
        assert_eq!(epoch["to_s"], Value::Null, "it ran to the end");
    }
}

/// A picture of the file: its number, and when it was captured and received, wall clock, ns.
struct Picture {
    seq: u64,
    captured: u64,
    received: u64,
}

#[test]
fn frames_take_samples_of_a_camera_with_latency_from_later() {
    const LATENCY_NS: u64 = 100_000_000;
    /// The recorder waits so long for samples of a frame, at least.
    const WAITS_NS: u64 = 100_000_000;
    let place = Place::new();
    let episode = recorded(&place);
    let mut taken = [Vec::new(), Vec::new()];
    for (taken, (name, bit, latency)) in taken.iter_mut().zip([("cam_top", 0, 0), ("cam_wrist", 4, LATENCY_NS)]) {
        let pictures: Vec<Picture> = episode
            .topic(&format!("/rapid/camera/{name}"))
            .map(|picture| Picture {
                seq: picture.sequence.into(),
                captured: picture.log_time,
                received: picture.publish_time,
            })
            .collect();
        for (message, frame) in episode.frames() {
            let slot = frame.modalities.iter().find(|slot| slot.bit == bit).expect("every modality is in every frame");
            let Some(seq) = slot.seq.filter(|_| slot.valid) else { continue };
            // Nearest to the frame's moment, or to 100 ms after it; the file keeps the capture times.
            let wanted = message.log_time + latency;
            let nearest = pictures.iter().min_by_key(|picture| picture.captured.abs_diff(wanted)).expect("a picture");
            // One that a busy machine delivered too late for it is in no frame.
            if nearest.seq != seq && nearest.received > wanted + WAITS_NS {
                continue;
            }
            let chosen = pictures.iter().find(|picture| picture.seq == seq).expect("it is in the file");
            assert_eq!(
                chosen.captured.abs_diff(wanted),
                nearest.captured.abs_diff(wanted),
                "{name}: frame at {}: picture {seq}, and {} is the nearest",
                message.log_time,
                nearest.seq
            );
            taken.push((message.log_time, chosen.captured));
        }
        assert!(!taken.is_empty(), "no frame has a picture of {name}");
    }
    // What is late shows the same moment in a picture of later.
    let [on_time, late] = &taken;
    let both =
        on_time.iter().filter_map(|(tick, first)| Some((first, late.iter().find(|(other, _)| other == tick)?.1)));
    assert!(both.clone().count() > 0 && both.clone().all(|(first, second)| second > *first), "no frame has both");
}
