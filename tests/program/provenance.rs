//! What a recorded episode holds about its devices, and what `latency` does to its frames: from a run of
//! the binary to the finished file.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use crate::support::{self, Episode, Place};
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
    let arguments =
        ["--config", &registry, "--sim", &scenario, "--headless", "--record", "--duration", "3s", "--out", "out"];
    let output = place.run(&[&arguments[..], &["--task", "place block", "--tag", "finger=soft"]].concat());
    let code = support::recorded_code(&String::from_utf8_lossy(&output.stdout));
    assert_eq!(output.status.code(), code, "{}", String::from_utf8_lossy(&output.stderr));
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

#[test]
fn frames_take_samples_of_a_camera_with_latency_from_later() {
    const PERIOD_NS: i64 = 1_000_000_000 / 30;
    let place = Place::new();
    let episode = recorded(&place);
    let registry = [("cam_top", 0_u32), ("cam_wrist", 4)];
    // Where the sample that a frame names was captured, seen from the frame's moment.
    let offsets = registry.map(|(name, bit)| {
        let captured: std::collections::BTreeMap<u64, u64> = episode
            .topic(&format!("/rapid/camera/{name}"))
            .map(|message| (u64::from(message.sequence), message.log_time))
            .collect();
        let mut offsets = Vec::new();
        for (message, frame) in episode.frames() {
            let slot = frame.modalities.iter().find(|slot| slot.bit == bit).expect("every modality is in every frame");
            let Some(capture) = slot.seq.filter(|_| slot.valid).and_then(|seq| captured.get(&seq)) else { continue };
            offsets.push((message.log_time, capture.cast_signed() - message.log_time.cast_signed()));
        }
        assert!(offsets.len() >= 60, "{name}: {} frames of 3 s at 30 Hz", offsets.len());
        offsets
    });
    let [on_time, late] = &offsets;
    // Nearest to the frame's moment, or to 100 ms after it; the file keeps the capture times.
    for (frames, latency) in [(on_time, 0_i64), (late, 100_000_000)] {
        let near = frames.iter().filter(|(_, offset)| (offset - latency).abs() <= PERIOD_NS / 2 + 1);
        assert!(near.count() * 10 >= frames.len() * 9, "{latency} ns: {frames:?}");
    }
    // Both cameras take their pictures at the same moments: those of a frame are three pictures apart.
    let apart = on_time.iter().filter_map(|(tick, first)| {
        let (_, second) = late.iter().find(|(other, _)| other == tick)?;
        Some(second - first)
    });
    let (three, others): (Vec<i64>, Vec<i64>) = apart.partition(|apart| (apart - 3 * PERIOD_NS).abs() < 1_000);
    assert!(three.len() >= 60 && three.len() >= 9 * others.len(), "{} frames, and {others:?}", three.len());
}
