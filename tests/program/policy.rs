//! `rapid policy show`: whether a policy suits a rig, and whether its chunks are computed fast enough.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use serde_json::{Value, json};

use crate::infer::paced;
use crate::support::{Place, events};

/// A rig with the wrist camera that the built-in policy observes.
const WRIST: &str = r#"
[rig]
name = "another"

[device.cam_wrist]
vid = "1209"
pid = "7a01"
node = "camera"
bit = 0
[device.cam_wrist.camera]
width = 96
height = 96
fps = 30
"#;

/// An arm of three numbers, and with as many axes.
const ARM: &str = r#"
[device.arm]
vid = "1209"
pid = "7a03"
node = "cat"
bit = 1
[device.arm.process]
kind = "scalars"
channels = 3
[device.arm.action]
names = ["x", "y", "z"]
units = ["m", "m", "m"]
min = [-1, -1, 0]
max = [1, 1, 1]
"#;

fn text(place: &Place, arguments: &[&str]) -> String {
    let output = place.run(&[&["policy", "show"][..], arguments].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// The object that is printed of a policy.
fn show(place: &Place, arguments: &[&str]) -> Value {
    let printed = events(&text(place, &[arguments, &["--json"]].concat()));
    let [shown] = <[Value; 1]>::try_from(printed).expect("one object");
    assert_eq!(shown["event"], "policy_bundle");
    shown
}

/// The pace that follows from the figures beside it.
fn pace(shown: &Value) -> &'static str {
    let number = |key: &str| shown[key].as_f64().expect("a number");
    let ticks = |count: f64| 1e3 * count / number("control_hz");
    let chunk = number("chunk_ms");
    // The first of the actions is past: these policies have action_start = 1.
    let covered = ticks(number("horizon") - 1.0);
    match ticks(number("n_action_steps")).max(chunk) + chunk {
        _ if chunk >= covered => "too_slow",
        until_the_next if until_the_next > covered => "pauses",
        _ => "whole",
    }
}

#[test]
fn the_built_in_policy_suits_the_simulated_task() {
    let place = Place::new();
    let shown = show(&place, &["--sim", "task"]);
    assert_eq!((&shown["policy"], &shown["folder"]), (&"tactile-id".into(), &"inside rapid".into()));
    assert_eq!((&shown["registry"], &shown["unfit"]), (&"sim-task".into(), &json!([])));
    assert!(shown["chunk_ms"].as_f64() > Some(0.0), "{shown}");
    assert_eq!(shown["pace"], pace(&shown), "{shown}");
    let text = text(&place, &["--sim", "task"]);
    assert!(text.contains("sim-task: it has all that the policy wants"), "{text}");
}

#[test]
fn what_a_rig_lacks_or_has_otherwise_is_named_with_its_device() {
    let place = Place::new();
    let other = WRIST.replace("width = 96\nheight = 96", "width = 640\nheight = 480");
    assert_ne!(other, WRIST);
    for (registry, unfit) in [
        (
            WRIST.to_owned(),
            &[
                "modality \"tactile_tip\" is not in devices.toml",
                "modality \"arm\" is not in devices.toml",
                "actuator \"arm\" takes no actions in devices.toml",
            ][..],
        ),
        (
            format!("{other}{ARM}"),
            &[
                "wants images of 96x96 (height x width), but \"cam_wrist\" gives 480x640",
                "modality \"tactile_tip\" is not in devices.toml",
                "slice ends at 4, but \"arm\" gives 3 values",
                "has 4 values, but \"arm\" takes 3",
            ],
        ),
    ] {
        let file = place.write("rig.toml", &registry).display().to_string();
        let arguments = ["--config", &file, "--denoising-steps", "1"];
        let shown = show(&place, &arguments);
        assert_eq!((&shown["registry"], &shown["unfit"]), (&"another".into(), &json!(unfit)));
        let text = text(&place, &arguments);
        assert!(text.contains("another: it does not suit:"), "{text}");
        for reason in unfit {
            assert!(text.contains(reason), "{reason}: {text}");
        }
    }
}

/// Each pace whatever the machine is: actions of 150 s, all of them executed before the next chunk is requested, and of 15 ms.
#[test]
fn the_pace_follows_from_the_time_of_a_chunk_and_the_rate() {
    for (executed, hz, steps, expected, words) in [
        (8, 0.1, "1", "whole", "15 actions cover 150000 ms at 0.1 Hz; on 1 thread of cpu"),
        (15, 0.1, "1", "pauses", "the robot pauses between chunks; try a smaller n_action_steps"),
        (8, 1000.0, "100", "too_slow", "none of them would be executed; try more --threads"),
    ] {
        let place = Place::new();
        let bundle = paced(&place, executed, hz);
        let arguments = [bundle.as_str(), "--sim", "task", "--denoising-steps", steps];
        let shown = show(&place, &arguments);
        assert_eq!((&shown["pace"], pace(&shown)), (&expected.into(), expected), "{shown}");
        assert_eq!(shown["denoising_steps"].to_string(), steps);
        let text = text(&place, &arguments);
        assert!(text.contains(words), "{text}");
    }
}
