//! Registering from the command line: the file as it was with an entry more, or as it was.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::path::Path;
use std::process::Output;

use crate::support::{Place, events};

const RIG: &str = include_str!("../../devices.toml");

/// A device that no entry means, and one that names itself as no device should.
const SCENARIO: &str = r#"
[[device]]
name = "cam_wrist"

[[device]]
name = "spare"
like = "tactile_tip"
serial = "SPARE1"
product = "Tactile \"GET\"\n[device.evil]\nvid = \"dead\"\u001b[31m"

[[device]]
name = "hostile"
like = "motor_state"
vid = "dead"
serial = "x\"\nMODE=\"0777"
"#;

fn place() -> Place {
    let place = Place::new();
    place.write("devices.toml", RIG);
    place.write("scenario.toml", SCENARIO);
    place
}

fn text(place: &Place) -> String {
    std::fs::read_to_string(place.path("devices.toml")).expect("devices.toml")
}

#[track_caller]
fn ok(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[track_caller]
fn refused(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(2), "{}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn adding_and_removing_an_entry_changes_no_byte_of_the_others() {
    let place = place();
    let add = ["register", "--sim", "scenario.toml", "--serial", "SPARE1", "--name", "tactile_left", "--slot", "tip"];
    let dry = ok(&place.run(&[&add[..], &["--dry-run"]].concat()));
    assert_eq!(text(&place), RIG);
    assert!(dry.contains("[device.tactile_left]"), "{dry}");
    let printed = ok(&place.run(&[&add[..], &["--test"]].concat()));
    assert!(printed.contains("Test: simulated camera, MJPG 320x240"), "{printed}");
    let new = text(&place);
    let entry = new.strip_prefix(RIG).expect("the old text is the beginning of the new one");
    assert_eq!(
        entry,
        "\n# Tactile \"GET\" [device.evil] vid = \"dead\" [31m\n[device.tactile_left]\nvid = \"2bc5\"\npid = \"0501\"\n\
         serial = \"SPARE1\"\nnode = \"camera\"\nslot = \"tip\"\nbit = 3\n\n[device.tactile_left.camera]\nwidth = 320\n\
         height = 240\nfps = 30\nformat = \"MJPG\"\n"
    );
    ok(&place.run(&["check"]));
    assert_eq!(place.files("udev/descriptors").len(), 4);
    assert!(std::fs::read_to_string(place.path("udev/99-rapid.rules")).expect("rules").contains("rapid/tactile_left"));
    let listed = ok(&place.run(&["devices", "--sim", "scenario.toml"]));
    assert!(listed.contains("[device.tactile_left]"), "{listed}");

    ok(&place.run(&["unregister", "tactile_left"]));
    assert_eq!(text(&place), RIG);
    assert_eq!(place.files("udev/descriptors").len(), 3);
    assert!(refused(&place.run(&["unregister", "tactile_left"])).contains("no entry [device.tactile_left]"));
    assert_eq!(place.files("").iter().filter(|name| name.contains(".tmp")).count(), 0);
}

#[test]
fn the_text_of_a_device_adds_no_rule_and_no_line() {
    let place = place();
    let by_port = ["register", "--sim", "scenario.toml", "--vid", "dead", "--name", "arm"];
    ok(&place.run(&by_port));
    let new = text(&place);
    assert!(!new.contains("MODE=\"0777"), "its serial number cannot be written, and is not");
    let by_identity = ["register", "--vid", "dead", "--pid", "000a", "--serial", "x\"\nMODE=\"0777", "--name", "other"];
    let error = refused(&place.run(&[&by_identity[..], &["--node", "camera"]].concat()));
    assert!(error.contains("control characters") && error.contains("nothing was written"), "{error}");
    let one_line = ["register", "--vid", "1", "--pid", "2", "--serial", "x\", MODE=\"0777", "--name", "other"];
    ok(&place.run(&[&one_line[..], &["--node", "camera"]].concat()));
    let rules = std::fs::read_to_string(place.path("udev/99-rapid.rules")).expect("rules");
    assert!(!rules.contains("0777"), "{rules}");
    for name in ["Cam", "../x", "a b", "x]\n[device.y", "", "é"] {
        let error = refused(&place.run(&["register", "--vid", "1", "--pid", "3", "--node", "camera", "--name", name]));
        assert!(error.contains("cannot be a modality's name"), "{name:?}: {error}");
    }
    assert!(Path::new(&place.path("udev/descriptors/other.yaml")).exists());
}

#[test]
fn json_lists_candidates_and_registered_devices() {
    let place = place();
    let listed = events(&ok(&place.run(&["register", "--json", "--sim", "scenario.toml"])));
    assert_eq!(listed.len(), 2);
    assert_eq!((&listed[0]["serial"], &listed[0]["node"]), (&"SPARE1".into(), &"camera".into()));
    let add = ["register", "--json", "--sim", "scenario.toml", "--serial", "SPARE1", "--name", "spare"];
    let added = events(&ok(&place.run(&add)));
    assert_eq!(
        (&added[0]["event"], &added[0]["name"], &added[0]["bit"]),
        (&"registered".into(), &"spare".into(), &3.into())
    );
    assert!(text(&place).ends_with(added[0]["entry"].as_str().expect("text")));
    let gone = events(&ok(&place.run(&["unregister", "--json", "spare"])));
    assert_eq!(gone[0]["event"], "unregistered");
}

#[test]
fn the_first_entry_creates_the_file() {
    let place = Place::new();
    ok(&place.run(&["register", "--vid", "046d", "--pid", "0825", "--name", "cam", "--node", "camera"]));
    let new = text(&place);
    assert!(new.starts_with("# The devices of this rig") && new.contains("[device.cam]\nvid = \"046d\""), "{new}");
    ok(&place.run(&["check"]));
    let error = refused(&place.run(&["unregister", "cam"]));
    assert!(error.contains("no device is registered"), "{error}");
    assert_eq!(text(&place), new);
}

#[test]
fn an_invalid_registry_is_not_added_to() {
    let place = Place::new();
    for wrong in ["[device.cam]\nnode = \"camrea\"\n", "[device.cam\n", "[[device]]\nname = \"a\"\n"] {
        place.write("devices.toml", wrong);
        refused(&place.run(&["register", "--vid", "1", "--pid", "2", "--name", "cam2", "--node", "camera"]));
        assert_eq!(text(&place), wrong);
    }
}
