//! `rapid calibrate latency`: what comes out is what the simulated camera is late by, and what cannot
//! be measured is reported.

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::process::{Command, Output, Stdio};

use crate::support::terminal::OnTerminal;
use crate::support::{Place, until};

/// Period of the simulated camera's pictures, ms.
const PERIOD_MS: f64 = 1000.0 / 30.0;

/// A place with a folder that looks like one of `/sys/class/leds`.
fn place_with_led() -> Place {
    let place = Place::new();
    std::fs::create_dir(place.path("led")).expect("folder");
    for (file, text) in [("brightness", "3\n"), ("max_brightness", "255\n"), ("trigger", "none [heartbeat] timer\n")] {
        place.write(&format!("led/{file}"), text);
    }
    place
}

/// The registry of a camera whose pictures cost no time to decode: when they come is what is measured, and four programs
/// measure at once.
const SMALL: &str = r#"
[rig]
name = "bench"

[device.cam_wrist]
vid = "046d"
pid = "0825"
node = "camera"
topic = "/rapid/camera/wrist"
bit = 0
[device.cam_wrist.camera]
width = 64
height = 48
fps = 30
"#;

fn scenario(place: &Place, fault: &str) -> String {
    let text = format!("[[device]]\nname = \"cam_wrist\"\n[device.fault]\n{fault}\n");
    place.write("scenario.toml", &text).display().to_string()
}

fn printed(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn the_latency_of_a_simulated_camera_is_measured() {
    let runs: Vec<_> = [0, 35, 120, 410]
        .into_iter()
        .map(|late_ms: u32| {
            let place = place_with_led();
            let registry = place.write("devices.toml", SMALL).display().to_string();
            let scenario = scenario(&place, &format!("latency = \"{late_ms}ms\""));
            let arguments = ["calibrate", "latency", "--config", &registry, "--sim", &scenario, "--led", "./led"];
            let arguments = [&arguments[..], &["--duration", "8s", "--json"]].concat();
            (late_ms, place.command(&arguments).spawn().expect("rapid runs"), place)
        })
        .collect();
    for (late_ms, run, place) in runs {
        let output = run.wait_with_output().expect("end");
        assert_eq!(output.status.code(), Some(0), "{}", printed(&output));
        let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one object");
        let number = |key: &str| found[key].as_f64().unwrap_or_else(|| panic!("no {key}: {found}"));
        let (error, uncertainty) = (number("latency_ms") - f64::from(late_ms), number("uncertainty_ms"));
        assert!(uncertainty > 0.0 && uncertainty < PERIOD_MS / 2.0, "{found}");
        // Twice what holds 95 times of 100.
        assert!(error.abs() <= 2.0 * uncertainty, "{error} ms off: {found}");
        let line = humantime::parse_duration(found["latency"].as_str().expect("text")).expect("with its unit");
        assert!((line.as_secs_f64() * 1e3 - number("latency_ms").max(0.0)).abs() <= 0.5, "{found}");
        assert_eq!((&found["device"], &found["light"]), (&"cam_wrist".into(), &"led".into()));
        // The LED is as it was.
        for (file, text) in [("brightness", "3"), ("trigger", "heartbeat")] {
            assert_eq!(std::fs::read_to_string(place.path(&format!("led/{file}"))).expect(file), text);
        }
    }
}

#[test]
fn pictures_that_do_not_follow_the_light_give_no_latency() {
    let place = place_with_led();
    let scenario = scenario(&place, "freeze_at = \"0s\"");
    let output = place.run(&["calibrate", "latency", "--sim", &scenario, "--led", "./led", "--duration", "5s"]);
    assert_eq!(output.status.code(), Some(1), "{}", printed(&output));
    assert!(
        printed(&output).contains("[device.cam_wrist] the pictures do not change with the light"),
        "{}",
        printed(&output)
    );
    assert!(!String::from_utf8_lossy(&output.stdout).contains("latency ="));
}

#[test]
fn unmeasurable_setups_are_reported_before_flashing() {
    let place = place_with_led();
    let away = place.write("away.toml", "[[device]]\nname = \"cam_wrist\"\nplugged = false\n").display().to_string();
    let led = ["--led", "./led"];
    for (arguments, code, expected) in [
        (&["--sim"][..], 2, "several cameras are plugged in: name one of cam_wrist, tactile_tip with --device"),
        (&["--sim", "--device", "cam"], 2, "--device cam: no such entry; cameras are cam_wrist, tactile_tip"),
        (&["--sim", "--device", "motor_state"], 2, "[device.motor_state] is not a camera"),
        (&["--sim", &away, "--device", "cam_wrist"], 1, "[device.cam_wrist] is not plugged in (`rapid devices`"),
        (&["--sim", &away], 1, "no camera of the registry is plugged in"),
        (&["--sim", "--device", "cam_wrist", "--led", "./none"], 1, "./none/brightness: "),
        (&["--sim", "--device", "cam_wrist", "--duration", "1s"], 2, "must be between 5s and 10m"),
    ] {
        let light = if arguments.contains(&"--led") { &[][..] } else { &led[..] };
        let output = place.run(&[&["calibrate", "latency"], arguments, light].concat());
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {}", printed(&output));
        assert!(printed(&output).contains(expected), "{arguments:?}: {}", printed(&output));
    }
    assert_eq!(std::fs::read_to_string(place.path("led/brightness")).expect("brightness"), "3\n", "not touched");
}

#[test]
fn without_a_terminal_it_names_the_alternatives() {
    let place = Place::new();
    let command = place.command(&["calibrate", "latency", "--sim", "--device", "cam_wrist"]);
    // A session of its own has none, whatever the test was started on.
    let mut session = Command::new("setsid");
    session.arg("--wait").arg(command.get_program()).args(command.get_args());
    let output = session.current_dir(place.folder.path()).stdin(Stdio::null()).output().expect("setsid");
    assert_eq!(output.status.code(), Some(2), "{}", printed(&output));
    assert!(
        printed(&output).contains("there is no terminal to flash") && printed(&output).contains("--led"),
        "{}",
        printed(&output)
    );
}

#[test]
fn the_terminal_flashes_and_is_given_back_with_the_result() {
    let place = Place::new();
    let scenario = scenario(&place, "latency = \"60ms\"");
    let mut run = OnTerminal::start(&place, &["calibrate", "latency", "--sim", &scenario, "--duration", "5s"], "");
    let flashing = run.read_until("48;2;255;255;255");
    assert!(flashing.contains("\x1b[?1049h") && flashing.contains("48;2;0;0;0"), "{flashing:?}");
    assert!(!run.echoes());
    let shown = run.read_until("latency = \"");
    let (_, after) = shown.rsplit_once("\x1b[?1049l").expect("left before the result");
    assert!(after.contains("cam_wrist: latency ") && after.contains("under [device.cam_wrist]"), "{after}");
    until("the end", || run.child.try_wait().expect("wait").is_some_and(|status| status.success()));
    assert!(run.echoes());
}

#[test]
fn an_interrupt_gives_the_terminal_back() {
    for (key, signal) in [(Some("\x03"), None), (Some("q"), None), (None, Some(rustix::process::Signal::TERM))] {
        let place = Place::new();
        let mut run = OnTerminal::start(&place, &["calibrate", "latency", "--sim", "--device", "cam_wrist"], "");
        run.read_until("ctrl-C ends");
        if let Some(key) = key {
            run.type_in(key);
        }
        if let Some(signal) = signal {
            let pid = rustix::process::Pid::from_raw(run.child.id().cast_signed()).expect("pid");
            rustix::process::kill_process(pid, signal).expect("signal");
        }
        let shown = run.read_until("interrupted: nothing was measured");
        assert!(shown.contains("\x1b[?1049l") && shown.contains("\x1b[?25h"), "{key:?}: {shown:?}");
        let mut code = None;
        until("the end", || {
            code = run.child.try_wait().expect("wait").map(|status| status.code());
            code.is_some()
        });
        assert_eq!((code, run.echoes()), (Some(Some(1)), true), "{key:?}");
    }
}
