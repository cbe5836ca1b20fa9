//! Emergency stops and enabling switches: the real binary, a simulated arm, and a pendant on a pseudo terminal.

#![expect(clippy::expect_used, reason = "what fails here fails a test")]

use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::support::{self, Episode, EventMessage, Place, Running, until};
use rustix::fs::OFlags;
use rustix::process::Signal;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::Value;

/// An arm, and a serial line with a switch.
const DEVICES: &str = r#"
[rig]
cooldown = "200ms"
[device.arm]
vid = "2e88"
pid = "4603"
node = "can"
bit = 0
[device.arm.can]
protocol = "damiao"
motors = [{ name = "grip", slave = 5, type = "DMH3510", kp = 0.8, kd = 0.05, position = [-1, 1] }]
[device.buttons]
vid = "1209"
pid = "0001"
node = "serial"
bit = 1
tty = { channels = 2 }
"#;

const RIG: &str = r#"
[stop.pendant]
kind = "emergency"
serial = { path = "PORT", run = "RUN", stop = "STOP", silence = "2s" }
[stop.buttons]
kind = "enabling"
field = { device = "buttons", index = 0, runs_below = 1e9, silence = "2s" }
"#;

/// The device of the switch is pulled out when the episode is some seconds old.
const PULLED: &str = "[[device]]\nname = \"arm\"\n[[device]]\nname = \"buttons\"\n\
                      [[event]]\nat = \"12s\"\nunplug = \"buttons\"\n";

const SILENT: u8 = 0;
const RUN: u8 = 1;
const STOP: u8 = 2;

/// The other end of a serial port, and the path of the port.
pub(crate) fn serial_port() -> (OwnedFd, String) {
    // A run that inherited it would hold its own port open.
    let port: OwnedFd = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a terminal");
    grantpt(&port).expect("a terminal");
    unlockpt(&port).expect("a terminal");
    let path = ptsname(&port, Vec::new()).expect("its name").into_string().expect("UTF-8");
    rustix::fs::fcntl_setfl(&port, OFlags::RDWR | OFlags::NONBLOCK).expect("a flag");
    (port, path)
}

/// A pendant that sends its line 50 times a second.
struct Pendant {
    sends: Arc<AtomicU8>,
    thread: Option<JoinHandle<()>>,
    path: String,
}

const END: u8 = 3;

impl Pendant {
    fn plug() -> Self {
        let (port, path) = serial_port();
        let sends = Arc::new(AtomicU8::new(RUN));
        let thread = std::thread::spawn({
            let sends = Arc::clone(&sends);
            move || loop {
                let line: &[u8] = match sends.load(Ordering::SeqCst) {
                    RUN => b"RUN\n",
                    STOP => b"STOP\n",
                    SILENT => b"",
                    _ => return,
                };
                // A port that no one reads is full some time.
                let _ = rustix::io::write(&port, line);
                std::thread::sleep(Duration::from_millis(20));
            }
        });
        Self { sends, thread: Some(thread), path }
    }

    fn send(&self, word: u8) {
        self.sends.store(word, Ordering::SeqCst);
    }
}

impl Drop for Pendant {
    fn drop(&mut self) {
        self.send(END);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Every stop and actuator that was reported, as `NAME WORD`.
fn words(events: &[Value]) -> Vec<String> {
    let word = |event: &Value| match event["event"].as_str()? {
        "stop" => Some(format!("{} {}", event["stop"].as_str()?, event["state"].as_str()?)),
        "actuator" => Some(format!("{} {}", event["device"].as_str()?, event["arming"].as_str()?)),
        _ => None,
    };
    events.iter().filter_map(word).collect()
}

/// Waits until the last word of this name is the one given.
fn last(running: &Running, name: &str, state: &str) {
    let expected = format!("{name} {state}");
    until(&expected, || {
        let all = words(&running.reported());
        all.iter().rfind(|word| word.starts_with(&format!("{name} "))).is_some_and(|word| *word == expected)
    });
}

fn arm(place: &Place) -> (Option<i32>, String) {
    let output = place.run(&["arm"]);
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn an_arm_needs_every_input_and_a_stop_is_an_order_and_an_event_of_the_episode() {
    let place = Place::new();
    let pendant = Pendant::plug();
    place.write("devices.toml", &(DEVICES.to_owned() + &RIG.replace("PORT", &pendant.path)));
    place.write("sim.toml", PULLED);
    pendant.send(STOP);
    let arguments = ["--sim", "sim.toml", "--config", "devices.toml", "--headless", "--json", "--arm", "--record"];
    // What comes before the episode begins is not of it.
    let running = place.start(&[&arguments[..], &["--out", "out"]].concat(), "\"event\":\"recording\"");
    last(&running, "pendant", "stopped");
    last(&running, "buttons", "runs");
    // Neither `--arm` nor an order arms it while the pendant is pressed.
    let (code, why) = arm(&place);
    assert_eq!(code, Some(3), "{why}");
    assert!(why.contains("emergency stop pendant is pressed: release it, then arm again"), "{why}");
    assert!(!words(&running.reported()).contains(&"arm armed".to_owned()), "{:?}", running.reported());

    pendant.send(RUN);
    last(&running, "pendant", "runs");
    assert!(!words(&running.reported()).contains(&"arm armed".to_owned()), "{:?}", running.reported());
    assert_eq!(arm(&place), (Some(0), String::new()));
    last(&running, "arm", "armed");

    pendant.send(STOP);
    last(&running, "arm", "faulted");
    let reported = running.reported();
    let fault = reported.iter().rfind(|event| event["event"] == "actuator").expect("the fault");
    assert_eq!(fault["text"], "emergency stop pendant pressed: simulated motors are stopped");
    let pressed = reported.iter().rfind(|event| event["event"] == "stop").expect("the stop");
    let took = |event: &Value| event["stamp"].as_u64().expect("a stamp");
    assert!(took(fault).saturating_sub(took(pressed)) < 500_000_000, "{pressed} {fault}");

    // Silent: it is lost.
    pendant.send(RUN);
    last(&running, "pendant", "runs");
    assert_eq!(arm(&place).0, Some(0));
    last(&running, "arm", "armed");
    pendant.send(SILENT);
    last(&running, "arm", "faulted");
    last(&running, "pendant", "lost");
    assert!(arm(&place).1.contains("pendant is lost"));

    // The device of the switch is pulled out: that disarms.
    pendant.send(RUN);
    last(&running, "pendant", "runs");
    if words(&running.reported()).last().is_none_or(|word| word != "buttons lost") {
        let (code, why) = arm(&place);
        assert!(code == Some(0) || why.contains("buttons is lost"), "{why}");
    }
    last(&running, "buttons", "lost");
    assert!(arm(&place).1.contains("enabling switch buttons is lost"), "{}", arm(&place).1);

    running.signal(Signal::INT);
    let (_, output, stderr) = running.end();
    let reported = support::events(&output);
    let last_words = words(&reported);
    assert!(!last_words.ends_with(&["pendant lost".to_owned()]), "an input closed at the end is reported: {stderr}");
    let file = place.files("out").into_iter().find(|name| Path::new(name).extension().is_some_and(|e| e == "mcap"));
    let episode = Episode::read(&place.path("out").join(file.expect("an episode")));
    let recorded: Vec<Value> = episode
        .topic("/rapid/event")
        .map(|message| serde_json::from_str(&message.decode::<EventMessage>().json).expect("JSON"))
        .collect();
    let recorded = words(&recorded);
    // Their state when it began stands first.
    assert!(
        recorded.iter().take(2).all(|word| word.starts_with("pendant ") || word.starts_with("buttons ")),
        "{recorded:?}"
    );
    for word in ["pendant stopped", "pendant runs", "arm armed", "arm faulted", "pendant lost", "buttons lost"] {
        assert!(recorded.iter().any(|is| is == word), "{word} not in {recorded:?}");
    }
}

/// An input of each kind that is not there.
const MISSING: &str = r#"
[stop.field]
kind = "enabling"
field = { device = "buttons", index = 0, runs_below = 1.0 }
[stop.key]
kind = "enabling"
key = { device = "no such pedal", code = "KEY_B" }
[stop.line]
kind = "emergency"
gpio = { chip = "/dev/no-such-chip", line = 0, runs_while = "low" }
[stop.port]
kind = "emergency"
serial = { path = "/dev/serial/by-id/none", run = "RUN", stop = "STOP" }
"#;

#[test]
fn an_input_that_was_never_found_is_reported_with_its_cause() {
    let place = Place::new();
    place.write("devices.toml", &(DEVICES.to_owned() + MISSING));
    place.write("sim.toml", "[[device]]\nname = \"arm\"\n");
    let arguments = ["--sim", "sim.toml", "--config", "devices.toml", "--headless", "--json"];
    let running = place.start(&arguments, "\"streaming\"");
    for (name, cause) in [
        ("field", "no sample of buttons has come"),
        ("key", "no input device is called \"no such pedal\" and has KEY_B"),
        ("line", "/dev/no-such-chip is not plugged in"),
        ("port", "/dev/serial/by-id/none is not plugged in"),
    ] {
        last(&running, name, "lost");
        let reported = running.reported();
        let causes: Vec<_> =
            reported.iter().filter(|event| event["event"] == "stop" && event["stop"] == name).collect();
        let [only] = causes.as_slice() else { panic!("{name} is reported once: {causes:?}") };
        assert!(only["detail"].as_str().is_some_and(|detail| detail.starts_with(cause)), "{only}");
    }
}
