//! Buttons: the real binary, with a box of buttons on a pseudo terminal, and a field of a simulated stream.

use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::stops::serial_port;
use crate::support::terminal::OnTerminal;
use crate::support::{Place, Running, logged, until};
use serde_json::Value;

/// A stream whose first number is that of the sample, 100 a second.
const DEVICES: &str = r#"
[device.grip]
vid = "1209"
pid = "0001"
node = "serial"
bit = 0
tty = { channels = 2 }
"#;

const BOX: &str = r#"
[button.hello]
serial = { path = "PORT", line = "hello" }
press = "mark"
[button.pedal]
serial = { path = "PORT", line = "go" }
press = "toggle"
[button.lever]
serial = { path = "PORT", pressed = "down", released = "up" }
press = "start"
hold = "stop"
hold_after = "2s"
[button.twice]
serial = { path = "PORT", line = "again" }
press = "success"
double = "discard"
"#;

const SIM: &str = "[[device]]\nname = \"grip\"\n";

/// A box of buttons, plugged in at `path`.
fn plug(path: &Path) -> OwnedFd {
    let (port, name) = serial_port();
    let _ = std::fs::remove_file(path);
    std::os::unix::fs::symlink(name, path).unwrap();
    port
}

fn send(port: &OwnedFd, lines: &str) {
    assert_eq!(rustix::io::write(port, lines.as_bytes()), Ok(lines.len()));
}

/// Sends the line of a button that changes nothing until it is answered: then the port is read.
fn greet(running: &Running, port: &OwnedFd) {
    let answers = || logged(&running.reported(), "hello: ").len();
    let before = answers();
    until("the port is read", || {
        // One that is not open yet may be full. Lines that follow each other closely are one press.
        let _ = rustix::io::write(port, b"hello\n");
        std::thread::sleep(std::time::Duration::from_millis(100));
        answers() > before
    });
    next_press();
}

/// A press within 400 ms of the last one counts as its repeat.
fn next_press() {
    std::thread::sleep(std::time::Duration::from_secs(1));
}

fn count(running: &Running, event: &str) -> usize {
    running.reported().iter().filter(|reported| reported["event"] == event).count()
}

/// Waits for a line of the log with these words.
fn wait_for(running: &Running, words: &str) -> Value {
    let has = |event: &Value| event["text"].as_str().is_some_and(|text| text.contains(words));
    until(words, || running.reported().iter().any(has));
    running.reported().into_iter().rfind(|event| has(event)).unwrap()
}

fn seconds(stamp: &Value) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "of a test")]
    let seconds = stamp["stamp"].as_u64().unwrap() as f64 / 1e9;
    seconds
}

#[test]
fn a_box_of_buttons_begins_ends_marks_and_discards_episodes_and_is_found_again() {
    let place = Place::new();
    let path = place.path("port");
    let port = plug(&path);
    place.write("devices.toml", &(DEVICES.to_owned() + &BOX.replace("PORT", &path.display().to_string())));
    place.write("sim.toml", SIM);
    let arguments = ["--sim", "sim.toml", "--config", "devices.toml", "--headless", "--json", "--out", "out"];
    let running = place.start(&arguments, "\"streaming\"");
    greet(&running, &port);
    assert!(!logged(&running.reported(), "hello: refused: no episode is being recorded").is_empty());

    // Twice in a moment is once: the mark is of the episode that has begun.
    send(&port, "go\ngo\nhello\n");
    wait_for(&running, "hello: marked at 0.");
    wait_for(&running, "pedal: begin episode");
    assert_eq!((count(&running, "recording"), count(&running, "episode")), (1, 0));
    next_press();
    send(&port, "go\n");
    wait_for(&running, "pedal: end episode");
    until("it has ended", || count(&running, "episode") == 1);

    // A short press of the lever, and one that is held: the episode ends when it was pressed.
    send(&port, "down\nup\n");
    until("the second has begun", || count(&running, "recording") == 2);
    send(&port, "down\n");
    let decided = wait_for(&running, "lever: end episode");
    until("it has ended", || count(&running, "episode") == 2);
    send(&port, "up\n");
    let reported = running.reported();
    let last = |event: &str| reported.iter().rfind(|reported| reported["event"] == event).unwrap();
    let after_the_end = seconds(&decided) - seconds(last("recording")) - last("episode")["seconds"].as_f64().unwrap();
    assert!(after_the_end > 1.5, "decided {after_the_end} s after the end of the episode: {decided}");

    send(&port, "again\n");
    wait_for(&running, "twice: label success");
    // On a busy machine the two may be read as one press, or as two that are far apart: then they label once more.
    let decided = || logged(&running.reported(), "twice: ").len();
    until("it is discarded", || {
        // Presses of the round before are decided.
        let mut before = None;
        while before != Some(decided()) {
            before = Some(decided());
            next_press();
        }
        send(&port, "again\n");
        std::thread::sleep(std::time::Duration::from_millis(100));
        send(&port, "again\n");
        until("what the presses mean is decided", || Some(decided()) > before);
        let is_double = !logged(&running.reported(), "twice: discard episode").is_empty();
        if is_double {
            until("it is discarded", || count(&running, "discarded") == 1);
        }
        is_double
    });

    // Unplugged, and plugged in again: a line of the log each, and the episode continues.
    send(&port, "go\n");
    until("the third has begun", || count(&running, "recording") == 3);
    drop(port);
    wait_for(&running, "button hello, pedal, lever, twice is lost");
    let port = plug(&path);
    wait_for(&running, "button hello, pedal, lever, twice is back");
    greet(&running, &port);
    assert_eq!(count(&running, "episode"), 2, "the third continues");
    send(&port, "go\n");
    until("it has ended", || count(&running, "episode") == 3);
    assert_eq!(logged(&running.reported(), "is lost").len(), 1);
    running.signal(rustix::process::Signal::INT);
    let (code, output, stderr) = running.end();
    assert_eq!(code, Some(0), "{output}{stderr}");
}

/// One is pressed when its sample has number 800, long after it is watched, on a busy machine too; another from the first sample on;
/// a third is not there.
const GRIP: &str = r#"
[button.grip]
field = { device = "grip", index = 0, pressed_above = 800, released_below = 100 }
press = "start"
[button.later]
field = { device = "grip", index = 0, pressed_above = 1400 }
press = "mark"
[button.always]
field = { device = "grip", index = 0, pressed_below = 1e9 }
press = "discard"
hold = "stop"
hold_after = "200ms"
[button.none]
key = { device = "no such pedal", code = "KEY_B" }
press = "redo"
"#;

#[test]
fn a_field_of_a_stream_begins_an_episode_and_one_that_is_pressed_at_the_start_does_nothing() {
    let place = Place::new();
    place.write("devices.toml", &(DEVICES.to_owned() + GRIP));
    // It is unplugged while it is pressed, and still is when it returns.
    let events = "[[event]]\nat = \"10s\"\nunplug = \"grip\"\n[[event]]\nat = \"11s\"\nplug = \"grip\"\n";
    place.write("sim.toml", &(SIM.to_owned() + events));
    let arguments = ["--sim", "sim.toml", "--config", "devices.toml", "--headless", "--json", "--out", "out"];
    let running = place.start(&arguments, "\"streaming\"");
    wait_for(&running, "button none is lost: no input device is called \"no such pedal\" and has KEY_B");
    wait_for(&running, "grip: begin episode");
    until("an episode has begun", || count(&running, "recording") == 1);
    wait_for(&running, "button grip is lost");
    wait_for(&running, "button grip is back");
    wait_for(&running, "later: marked at");
    running.signal(rustix::process::Signal::INT);
    let (_, output, stderr) = running.end();
    let reported = crate::support::events(&output);
    assert!(logged(&reported, "always: ").is_empty(), "{output}");
    assert_eq!(
        logged(&reported, "grip: begin episode").len() + logged(&reported, "grip: refused").len(),
        1,
        "{output}"
    );
    assert!(logged(&reported, "button none is lost").len() == 1, "reported once: {output}");
    let losses = logged(&reported, "button grip is lost").len();
    assert_eq!(losses, 1, "an input that is closed at the end is reported: {output}{stderr}");
}

/// Raises a flag when it is dropped.
struct Raised<'a>(&'a AtomicBool);

impl Drop for Raised<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn a_button_works_in_the_monitor() {
    let place = Place::new();
    let (port, name) = serial_port();
    let button = format!("[button.begin]\nserial = {{ path = \"{name}\", line = \"begin\" }}\npress = \"start\"\n");
    place.write("devices.toml", &(DEVICES.to_owned() + &button));
    place.write("sim.toml", SIM);
    let mut run = OnTerminal::start(&place, &["--sim", "sim.toml", "--config", "devices.toml", "--out", "out"], "");
    let has_begun = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !has_begun.load(Ordering::Relaxed) {
                // One that is not open yet may be full. Once an episode has begun, another press is refused.
                let _ = rustix::io::write(&port, b"begin\n");
                next_press();
            }
        });
        // Also if what it reads fails.
        let _ended = Raised(&has_begun);
        run.read_until("REC");
    });
    let journal = || std::fs::read_to_string(place.path("out/session.toml")).unwrap_or_default();
    until("it is in the journal", || journal().contains("_001"));
}
