//! The module catalogue: listed, added to a registry, taken over by a run and mounted while it runs.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use crate::support::{Episode, Place, Running, until};
use serde_json::Value;

const SCENARIO: &str =
    "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"spare\"\nlike = \"tactile_tip\"\nserial = \"SPARE1\"\n";

/// A run whose first episode has begun: a request for one before that would begin the first.
fn recording() -> (Place, Running) {
    let place = Place::new();
    place.write("devices.toml", include_str!("../../devices.toml"));
    place.write("scenario.toml", SCENARIO);
    let arguments = ["--sim", "scenario.toml", "--headless", "--json", "--record", "--out", "out"];
    let running = place.start(&arguments, "\"event\":\"recording\"");
    (place, running)
}

fn ok(place: &Place, options: &[&str]) -> String {
    let output = place.run(options);
    let (text, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{options:?}: {text}{errors}");
    text.into_owned()
}

fn refused(place: &Place, options: &[&str]) -> String {
    let output = place.run(options);
    assert_eq!(output.status.code(), Some(2), "{options:?}: {}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_type_of_module_is_taken_up_and_mounted_while_the_rig_runs() {
    let (place, running) = recording();
    let sim = ["--sim", "scenario.toml"];
    ok(&place, &[&["register", "--module", "tip_tactile", "--serial", "SPARE1"][..], &sim].concat());
    ok(&place, &["register", "--module", "handheld_adapter"]);
    ok(&place, &["register", "--module", "robot_adapter"]);
    let taken = ok(&place, &["reload"]);
    assert!(taken.contains("[device.tip_tactile] as bit 3") && taken.contains("[module.handheld_adapter]"), "{taken}");
    until("the fingertip", || ok(&place, &["mask"]).contains("0x09"));
    let mut recorded = Vec::new();
    for module in ["handheld_adapter", "robot_adapter", "none"] {
        let planned = ok(&place, &["session", "plan", "--module", module]);
        assert_eq!(planned.contains(&format!("with {module}")), module != "none", "{planned}");
        recorded.push(ok(&place, &["episode", "next"]));
    }
    let unknown = place.run(&["session", "plan", "--module", "tip_sofd"]);
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("no [module.tip_sofd] in the registry"));
    ok(&place, &["episode", "stop"]);
    drop(running);
    let files: Vec<_> = place.episodes("out").into_iter().filter(|name| name.ends_with("mcap")).collect();
    let of = |file: &String| {
        let episode = Episode::read(&place.path("out").join(file));
        let configuration: Value = serde_json::from_str(episode.value("rapid", "configuration")).expect("JSON");
        let tags = episode.value("rapid", "tags").to_owned();
        (configuration["modules"].clone(), tags)
    };
    let found: Vec<_> = files.iter().map(of).collect();
    assert_eq!(found.len(), 4, "{files:?}, {recorded:?}");
    assert_eq!(found[1].0, serde_json::json!(["tip_tactile", "handheld_adapter"]), "{found:?}");
    assert!(found[1].1.contains("handheld") && found[1].1.contains("tactile"), "{found:?}");
    assert_eq!(found[2].0, serde_json::json!(["tip_tactile", "robot_adapter"]), "{found:?}");
    assert_eq!(found[3].0, serde_json::json!(["tip_tactile"]), "{found:?}");
}

#[test]
fn a_type_of_the_user_is_mounted_while_the_rig_runs() {
    let (place, running) = recording();
    // Written during the run: the run never read it.
    let tip = ok(&place, &["modules", "tip_tactile"]).replace("tip_tactile", "tip_thermal");
    let tip = tip.replace("finger=tactile", "finger=thermal");
    let transform = "[module.tip_thermal.transform.tip_thermal]\nposition = [0.0, 0.012, 0.09]\n";
    place.write("thermal.toml", &format!("{tip}\n{transform}"));
    let sim = ["--sim", "scenario.toml", "--serial", "SPARE1"];
    ok(&place, &[&["register", "--module", "./thermal.toml"][..], &sim].concat());
    let taken = ok(&place, &["reload"]);
    assert!(taken.contains("[device.tip_thermal] as bit 3") && taken.contains("[module.tip_thermal]"), "{taken}");
    until("the fingertip", || ok(&place, &["mask"]).contains("0x09"));
    ok(&place, &["episode", "next"]);
    ok(&place, &["episode", "stop"]);
    drop(running);
    let files: Vec<_> = place.episodes("out").into_iter().filter(|name| name.ends_with("mcap")).collect();
    let [before, with] = files.as_slice() else { panic!("{files:?}") };
    let modules = |episode: &Episode| -> Value {
        let text = episode.value("rapid", "configuration");
        serde_json::from_str::<Value>(text).expect("JSON")["modules"].clone()
    };
    let (before, with) = (Episode::read(&place.path("out").join(before)), Episode::read(&place.path("out").join(with)));
    assert_eq!((modules(&before), modules(&with)), (serde_json::json!([]), serde_json::json!(["tip_thermal"])));
    assert!(with.value("rapid", "tags").contains("thermal") && !before.value("rapid", "tags").contains("thermal"));
    assert!(with.channels.iter().any(|topic| topic == "/rapid/camera/tip_thermal"), "{:?}", with.channels);
    // Where its sensor sits is in the episode, at its position.
    let place_of: Vec<_> = with.topic("/tf").collect();
    let [transform] = place_of.as_slice() else { panic!("{} transforms", place_of.len()) };
    let bytes = 0.012_f64.to_le_bytes();
    assert!(transform.data.windows(8).any(|part| part == bytes), "{:?}", transform.data);
    assert_eq!(before.topic("/tf").count(), 0);
}

#[test]
fn the_catalogue_is_listed_and_a_file_describes_a_type_of_the_user() {
    let place = Place::new();
    let rig = include_str!("../../devices.toml");
    place.write("devices.toml", rig);
    let listed = ok(&place, &["modules"]);
    assert_eq!(listed.lines().filter(|line| line.contains(" tip ") || line.contains(" top ")).count(), 5, "{listed}");
    let lines = ok(&place, &["modules", "--json"]);
    assert_eq!(lines.lines().count(), 9, "{lines}");
    // The angled mount carries the camera of the other one.
    let adapter = ["--vid", "2672", "--pid", "0059", "--serial", "C3441325012345"];
    ok(&place, &[&["register", "--module", "wrist_mount"][..], &adapter].concat());
    ok(&place, &["register", "--module", "wrist_mount_angled"]);
    ok(&place, &["check"]);
    assert!(ok(&place, &["modules"]).contains("* wrist_mount_angled"));
    // Each mount has its own place of the camera, and the camera gives pictures.
    let text = std::fs::read_to_string(place.path("devices.toml")).expect("a file");
    for table in ["[module.wrist_mount.transform.gopro]", "[module.wrist_mount_angled.transform.gopro]"] {
        assert!(text.contains(table), "{}", &text[rig.len()..]);
    }
    assert!(text.contains("stream = \"preview\"") && text.contains("rotation = ["), "{}", &text[rig.len()..]);
    // A type of one's own, and twice.
    let tip = ok(&place, &["modules", "tip_tactile"]).replace("tip_tactile", "tip_thermal").replace("320", "160");
    place.write("thermal.toml", &tip);
    let unit = |serial: &'static str| ["--vid", "2bc5", "--pid", "0502", "--serial", serial];
    ok(&place, &[&["register", "--module", "./thermal.toml"][..], &unit("T1")].concat());
    ok(&place, &[&["register", "--module", "thermal.toml", "--name", "thermal_left"][..], &unit("T2")].concat());
    let text = std::fs::read_to_string(place.path("devices.toml")).expect("a file");
    assert!(text.starts_with(rig), "what was there has changed");
    assert!(text.contains("[device.thermal_left.camera]"), "{}", &text[rig.len()..]);
    assert!(text.matches("width = 160").count() == 2, "{}", &text[rig.len()..]);
    assert!(
        text.contains(
            "[module.thermal_left]\nslot = \"tip\"\ntags = [\"finger=tactile\"]\ndevices = [\"thermal_left\"]"
        )
    );
    // What is refused changes nothing.
    place.write("wrong.toml", "[module.a]\nslot = \"side\"\n");
    for (options, why) in [
        (["register", "--module", "wrist_mount"], "[module.wrist_mount] is in the registry already"),
        (["register", "--module=tip_soft", "--bit=9"], "has no sensor that needs an entry"),
        (["register", "--module", "tip_sofd"], "did you mean \"tip_soft\"?"),
        (["register", "--module", "wrong.toml"], "its slot is not one of front"),
        (["register", "--module", "missing.toml"], "missing.toml"),
        (["modules", "--json", "tip_sofd"], "tip_sofd"),
    ] {
        let errors = refused(&place, &options);
        assert!(errors.contains(why), "{options:?}: {errors}");
    }
    assert_eq!(std::fs::read_to_string(place.path("devices.toml")).expect("a file"), text);
}
