//! The binary as a user runs it: signals, bad input, exit codes, on simulated devices.

use crate::support::terminal::OnTerminal;
use crate::support::{self, Episode, Place, events};
use rustix::process::Signal;

const RECORD: [&str; 6] = ["--sim", "--headless", "--json", "--record", "--out", "out"];

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn a_recording_of_a_given_duration_ends_by_itself_with_one_whole_file() {
    let place = Place::new();
    let output =
        place.run(&[&RECORD[..], &["--duration", "2s", "--task", "Place block!", "--tag", "finger=soft"]].concat());
    assert_eq!(output.status.code(), support::recorded_code(&text(&output.stdout)), "{}", text(&output.stderr));
    let files = place.files("out");
    assert_eq!(files.len(), 1, "{files:?}");
    assert!(files[0].ends_with("_place-block_001.mcap"), "{files:?}");
    let events = events(&text(&output.stdout));
    let ended = events.iter().find(|event| event["event"] == "episode").expect("an episode event");
    assert_eq!((&ended["dropped"], &ended["error"]), (&0.into(), &serde_json::Value::Null));
    let episode = Episode::read(&place.path("out").join(&files[0]));
    for topic in ["/rapid/camera/wrist", "/rapid/camera/tactile", "/rapid/serial/motor", "/rapid/mask", "/rapid/frame"]
    {
        assert!(episode.topic(topic).count() > 0, "no message of {topic}");
    }
    assert!(episode.topic("/rapid/frame").count() >= 59, "30 Hz for 2 s");
    let rapid = episode.metadata.iter().find(|metadata| metadata.name == "rapid").expect("metadata");
    assert_eq!(rapid.metadata["task"], "Place block!");
    assert_eq!(rapid.metadata["tags"], r#"{"finger":"soft"}"#);
    assert_eq!(rapid.metadata["layout"], r#"{"cam_wrist":0,"motor_state":2,"tactile_tip":1}"#);
}

#[test]
fn every_signal_that_asks_to_end_finishes_the_file_and_clears_the_mask() {
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        let place = Place::new();
        let mut running = place.start(&RECORD, "\"event\":\"recording\"");
        running.wait_for("\"streaming\"");
        assert!(place.mask_file().exists(), "{signal:?}");
        running.signal(signal);
        let (code, output, errors) = running.end();
        assert_eq!(code, support::recorded_code(&output), "{signal:?}: {errors}");
        assert!(output.contains("\"event\":\"episode\""), "{signal:?}: {output}");
        let files = place.files("out");
        assert!(files.len() == 1 && files[0].ends_with("_001.mcap"), "{signal:?}: {files:?}");
        Episode::read(&place.path("out").join(&files[0]));
        assert!(!place.mask_file().exists(), "{signal:?}");
    }
}

#[test]
fn a_killed_run_leaves_a_partial_file_which_the_next_run_repairs() {
    let place = Place::new();
    let running = place.start(&RECORD, "\"event\":\"recording\"");
    running.signal(Signal::KILL);
    let (code, ..) = running.end();
    assert_eq!(code, None);
    assert!(place.files("out")[0].ends_with(".mcap.partial"));
    assert!(place.mask_file().exists());
    let output = place.run(&[&RECORD[..], &["--duration", "1s"]].concat());
    assert_eq!(output.status.code(), support::recorded_code(&text(&output.stdout)), "{}", text(&output.stderr));
    let files = place.files("out");
    assert!(files.len() == 2 && !files.iter().any(|name| name.ends_with(".partial")), "{files:?}");
    assert!(!place.mask_file().exists());
}

#[test]
fn a_second_rapid_on_the_same_rig_names_the_first() {
    let place = Place::new();
    let running = place.start(&["--sim", "--headless", "--json"], "\"streaming\"");
    let second = place.run(&["--sim", "--headless"]);
    assert_eq!(second.status.code(), Some(1));
    let printed = text(&second.stderr);
    assert!(printed.contains(&format!("(pid {})", running.pid())), "{printed}");
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
}

#[test]
fn an_output_folder_that_cannot_be_created_is_reported_before_recording() {
    let place = Place::new();
    let output = place.run(&["--sim", "--headless", "--record", "--out", "no/such/folder", "--duration", "1s"]);
    assert_eq!(output.status.code(), Some(2), "{}", text(&output.stderr));
    let printed = text(&output.stderr);
    assert!(printed.contains("no/such/folder: no such folder"), "{printed}");
    assert!(!place.mask_file().exists());
    place.write("file", "");
    let output = place.run(&["--sim", "--headless", "--record", "--out", "file", "--duration", "1s"]);
    assert_eq!(output.status.code(), Some(2), "{}", text(&output.stderr));
    assert_eq!(text(&output.stdout), "", "no device is started");
    assert!(text(&output.stderr).contains("file: not a folder; choose another with --out"), "{}", text(&output.stderr));
}

#[test]
fn plugged_devices_are_reported_with_any_registry() {
    let place = Place::new();
    let simulated = place.run(&["devices", "--sim"]);
    assert_eq!(simulated.status.code(), Some(0), "{}", text(&simulated.stderr));
    let listed = text(&simulated.stdout);
    assert!(listed.contains("[device.tactile_tip]") && listed.contains("sim:tactile_tip"), "{listed}");
    place.write(
        "stranger.toml",
        "[[device]]\nname = \"cam_wrist\"\n[[device]]\nname = \"other\"\nlike = \"cam_wrist\"\nserial = \"CAM00B7\"\n",
    );
    let stranger = text(&place.run(&["--sim=stranger.toml", "devices"]).stdout);
    assert!(stranger.contains("its serial is \"CAM00A1\" and this unit reports \"CAM00B7\""), "{stranger}");
    place.write("wrong.toml", "[device.cam]\nvid = \"046d\"\npid = \"0825\"\nnode = \"camra\"\n");
    let wrong = place.run(&["devices", "--config", "wrong.toml"]);
    assert_eq!(wrong.status.code(), Some(2));
    assert!(!wrong.stdout.is_empty(), "the list comes first");
    assert!(text(&wrong.stderr).contains("did you mean \"camera\"?"), "{}", text(&wrong.stderr));
}

#[test]
fn a_file_that_is_not_an_episode_is_a_bad_argument_and_named_once() {
    let place = Place::new();
    place.write("no.mcap", "hello");
    for arguments in [["inspect", "none.mcap"], ["inspect", "no.mcap"], ["replay", "none.mcap"], ["replay", "no.mcap"]]
    {
        let output = place.run(&arguments);
        let printed = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {printed}");
        assert_eq!(printed.matches(arguments[1]).count(), 1, "{printed}");
    }
}

#[test]
fn bad_arguments_and_configurations_exit_with_2_and_a_fix() {
    let place = Place::new();
    place.write("empty.toml", "");
    place.write("typo.toml", "[device.cam]\nvid = \"046d\"\npid = \"0825\"\nnode = \"camra\"\n");
    let cases: [(&[&str], &str); 7] = [
        (&["--headless"], "no devices.toml: looked for devices.toml"),
        (&["--config", "missing.toml", "--headless"], "missing.toml"),
        (&["--config", "empty.toml", "--headless"], "empty.toml"),
        (&["--config", "typo.toml", "--headless"], "camera"),
        (&["--sim", "--duration", "30"], "30s"),
        (&["--sim", "--tag", "soft"], "finger=soft"),
        (&["--sim", "missing-scenario.toml", "--headless"], "missing-scenario.toml"),
    ];
    for (arguments, expected) in cases {
        let output = place.run(arguments);
        let printed = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {printed}");
        assert!(printed.contains(expected), "{arguments:?}: {printed}");
    }
}

#[test]
fn check_prints_every_entry_or_every_problem() {
    let place = Place::new();
    let builtin = place.write("devices.toml", rapid_registry::BUILTIN);
    let good = place.run(&["check"]);
    assert_eq!(good.status.code(), Some(0), "{}", text(&good.stderr));
    assert!(text(&good.stdout).ends_with("devices.toml: 3 devices, ok\n"), "{}", text(&good.stdout));
    let broken = rapid_registry::BUILTIN.replace("vid =", "vdi =");
    std::fs::write(builtin, broken).expect("write");
    let bad = place.run(&["check"]);
    assert_eq!(bad.status.code(), Some(2));
    assert_eq!(text(&bad.stdout).matches("unknown key").count(), 3, "{}", text(&bad.stdout));
}

#[test]
fn the_mask_can_be_read_while_a_rig_runs_and_is_an_error_otherwise() {
    let place = Place::new();
    let none = place.run(&["mask"]);
    assert_eq!(none.status.code(), Some(1));
    assert!(
        text(&none.stderr).contains("no rapid of this name (--instance) runs on this machine"),
        "{}",
        text(&none.stderr)
    );
    let mut running = place.start(&["--sim", "--headless", "--json"], "\"mask\":\"0x07\"");
    running.wait_for("\"mask\":\"0x05\"");
    let output = place.run(&["mask", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let mask = &events(&text(&output.stdout))[0];
    assert_eq!(mask["device_count"], 3, "{mask}");
    let json = std::fs::read_to_string(format!("{}.json", place.mask_file().display())).expect("JSON file");
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!(json["pid"], running.pid());
    assert_eq!(json["devices"][1]["name"], "tactile_tip");
    running.signal(Signal::INT);
    assert_eq!(running.end().0, Some(0));
}

#[test]
fn a_closed_reader_does_not_end_the_recording() {
    let place = Place::new();
    let mut child = place.command(&[&RECORD[..], &["--duration", "2s"]].concat()).spawn().expect("rapid runs");
    drop(child.stdout.take());
    let status = child.wait().expect("wait");
    // What became of the episode has no reader.
    assert!(matches!(status.code(), Some(0 | 4)), "{status}");
    let files = place.files("out");
    assert!(files.len() == 1 && files[0].ends_with("_001.mcap"), "{files:?}");
    Episode::read(&place.path("out").join(&files[0]));
}

#[test]
fn help_and_completions_are_printed() {
    let place = Place::new();
    let help = text(&place.run(&["--help"]).stdout);
    assert!(help.contains("Examples:") && help.contains("rapid --sim"), "{help}");
    for shell in ["bash", "zsh", "fish"] {
        let output = place.run(&["completions", shell]);
        assert_eq!(output.status.code(), Some(0));
        assert!(text(&output.stdout).contains("inspect"), "{shell}");
    }
}

/// The error of `rapid mask` without a run, on a terminal.
#[test]
fn the_environment_and_the_terminal_decide_about_colours() {
    type Row<'a> = (&'a [(&'a str, &'a str)], bool, bool);
    let place = Place::new();
    let coloured = "\x1b[1m\x1b[31merror:\x1b[0m";
    let forced = ("CLICOLOR_FORCE", "1");
    let table: [Row<'_>; 9] = [
        (&[], true, false),
        (&[("NO_COLOR", "1")], false, false),
        (&[("NO_COLOR", "")], true, false),
        (&[("CLICOLOR", "0")], false, false),
        (&[("TERM", "dumb")], false, false),
        (&[forced, ("CLICOLOR", "0"), ("TERM", "dumb")], true, true),
        (&[forced, ("NO_COLOR", "1")], false, false),
        (&[("CLICOLOR_FORCE", "0")], true, false),
        (&[("CLICOLOR_FORCE", "0"), ("CLICOLOR", "0")], false, false),
    ];
    for (environment, on_terminal, in_pipe) in table {
        let shown = OnTerminal::start_in(&place, &["mask"], environment).read_to_end();
        assert_eq!(
            (shown.contains("error:"), shown.contains(coloured)),
            (true, on_terminal),
            "{environment:?}: {shown:?}"
        );
        let mut command = place.command(&["mask"]);
        command.env_remove("NO_COLOR").env_remove("CLICOLOR").env_remove("CLICOLOR_FORCE");
        let output = command.envs(environment.iter().copied()).output().expect("rapid runs");
        let shown = text(&output.stderr);
        assert_eq!((shown.contains("error:"), shown.contains(coloured)), (true, in_pipe), "{environment:?}: {shown:?}");
    }
}
