//! Inputs over real descriptors: a pseudo terminal for a serial port, and samples as a stream delivers them.

use std::os::fd::OwnedFd;
use std::time::{Duration, Instant};

use rapid_core::action::{Order, Trip};
use rapid_core::permission::Attended;
use rapid_core::sample::Encoding;
use rapid_status::{Event, EventKind, StopStatus};
use rustix::fs::OFlags;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use super::*;
use crate::inputs::{lost_at_a_panic, tap};
use crate::patience::PATIENCE;

const DEVICES: &str = r#"
[device.arm]
vid = "2e88"
pid = "4603"
node = "can"
bit = 0
[device.arm.can]
adapter = "damiao"
protocol = "damiao"
motors = [{ name = "grip", slave = 5, type = "DMH3510", kp = 0.8, kd = 0.05, position = [-1, 1] }]
[device.buttons]
vid = "1209"
pid = "0001"
node = "serial"
bit = 1
serial = { channels = 2 }
"#;

struct Run {
    permission: Arc<Permission>,
    attended: Attended,
    board: Arc<Board>,
    events: tokio::sync::broadcast::Receiver<Event>,
    watched: Watched,
    reported: Reported,
}

fn run(stops: &str) -> Run {
    let registry = Registry::parse(&format!("{DEVICES}{stops}"), None).unwrap().registry;
    let board = Arc::new(Board::new(&registry));
    let permission = Arc::new(Permission::new(false).with_interlocks(from_registry(&registry)));
    let attended = permission.attend();
    let events = board.events();
    let reported = Reported::nothing(&registry);
    let watched = Watched::begin(&registry, &permission, &reported, &board).unwrap();
    Run { permission, attended, board, events, watched, reported }
}

impl Run {
    fn stop(&self) -> StopStatus {
        self.board.snapshot().stops.remove(0)
    }

    fn until(&self, state: InputState) -> StopStatus {
        let end = Instant::now() + PATIENCE;
        loop {
            let stop = self.stop();
            if stop.state == state {
                return stop;
            }
            assert!(Instant::now() < end, "{stop:?}");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn arm(&self) -> Result<(), String> {
        let now = Stamp::now();
        self.permission.arm(now, Stamp::now()).map_err(|void| void.to_string())
    }

    fn orders(&self) -> Vec<Order> {
        self.attended.take_pending().collect()
    }

    /// The words of the announcements since the last call.
    fn announced(&mut self) -> Vec<&'static str> {
        let events = std::iter::from_fn(|| self.events.try_recv().ok());
        events
            .filter_map(|event| if let EventKind::Stop(stop) = event.what { Some(stop.word()) } else { None })
            .collect()
    }
}

/// A pendant on a pseudo terminal, and the path of its port.
fn pendant() -> (OwnedFd, String) {
    let port = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&port).unwrap();
    unlockpt(&port).unwrap();
    let path = ptsname(&port, Vec::new()).unwrap().into_string().unwrap();
    rustix::fs::fcntl_setfl(&port, OFlags::RDWR | OFlags::NONBLOCK).unwrap();
    (port, path)
}

/// Sends a line repeatedly, as a pendant does, until `done`.
fn send(port: &OwnedFd, line: &str, mut done: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !done() {
        // A port that no process has opened yet is full after a while.
        let _ = rustix::io::write(port, line.as_bytes());
        assert!(Instant::now() < end);
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn serial(path: &str) -> String {
    format!(
        "[stop.pendant]\nkind = \"emergency\"\nserial = {{ path = \"{path}\", run = \"RUN\", silence = \"400ms\" }}\n"
    )
}

#[test]
fn a_serial_pendant_stops_by_value_by_silence_and_by_unplugging() {
    let (port, path) = pendant();
    let mut run = run(&serial(&path));
    assert!(run.arm().unwrap_err().contains("pendant is lost"));
    send(&port, "RUN\n", || run.stop().state == InputState::Runs);
    run.orders();
    assert_eq!(run.arm(), Ok(()));
    assert_eq!(run.orders(), [Order::Arm]);

    // By value, at once, even though it runs again immediately after.
    rustix::io::write(&port, b"RUN\nSTOP\nRUN\n").unwrap();
    let begun = Instant::now();
    let orders = loop {
        let orders = run.orders();
        if !orders.is_empty() || begun.elapsed() > PATIENCE {
            break orders;
        }
        send(&port, "RUN\n", {
            let mut sent = false;
            move || std::mem::replace(&mut sent, true)
        });
    };
    assert_eq!(orders, [Order::Emergency(Trip { stop: 0, is_lost: false })]);
    send(&port, "RUN\n", || run.stop().state == InputState::Runs);
    assert_eq!(run.orders(), [], "an input alone arms nothing");
    assert_eq!(run.arm(), Ok(()));
    assert_eq!(run.orders(), [Order::Arm]);

    // By silence.
    let silent = run.until(InputState::Lost);
    assert_eq!(silent.detail, "nothing was received for 400ms");
    assert_eq!(run.orders(), [Order::Emergency(Trip { stop: 0, is_lost: true })]);
    send(&port, "RUN\n", || run.stop().state == InputState::Runs);
    assert_eq!(run.arm(), Ok(()));

    // By unplugging.
    drop(port);
    let gone = run.until(InputState::Lost);
    assert!(gone.detail.contains("plugged"), "{gone:?}");
    assert_eq!(run.orders(), [Order::Emergency(Trip { stop: 0, is_lost: true })]);
    assert!(run.arm().unwrap_err().contains("pendant is lost"));
    let announced = run.announced();
    assert!(announced.ends_with(&["released", "pressed", "released", "lost", "released", "lost"]), "{announced:?}");
}

#[test]
fn a_serial_pendant_is_opened_when_plugged_in_and_exclusively() {
    let none = run(&serial("/dev/serial/by-id/none"));
    let why = none.until(InputState::Lost);
    let end = Instant::now() + PATIENCE;
    while none.stop().detail.contains("not reported yet") {
        assert!(Instant::now() < end, "{why:?}");
    }
    assert_eq!(none.stop().detail, "/dev/serial/by-id/none is not plugged in");

    let (port, path) = pendant();
    let first = run(&serial(&path));
    send(&port, "RUN\n", || first.stop().state == InputState::Runs);
    let second = run(&serial(&path));
    while second.stop().detail.contains("not reported yet") {}
    assert!(second.stop().detail.contains("held by another program"), "{:?}", second.stop());
    // It is available once the first has ended.
    drop(first);
    send(&port, "RUN\n", || second.stop().state == InputState::Runs);
}

#[test]
fn a_number_of_a_stream_stops_by_value_by_silence_and_by_the_end_of_its_stream() {
    let stop = "[stop.pedal]\nkind = \"enabling\"\n\
                field = { device = \"buttons\", index = 1, runs_above = 0.5, silence = \"300ms\" }\n";
    let mut run = run(stop);
    let taps: Arc<[Tap]> = run.watched.taps().into();
    assert_eq!(taps[0].device(), "buttons");
    let bytes = |value: f64| [9.0_f64.to_le_bytes(), value.to_le_bytes()].concat();
    let look = |value: f64| taps[0].feed(Encoding::F64, &bytes(value));
    // Until the stop has settled.
    let run_again = |run: &Run| {
        let end = Instant::now() + PATIENCE;
        while run.stop().state != InputState::Runs {
            assert!(Instant::now() < end);
            look(0.6);
        }
    };
    let end = Instant::now() + PATIENCE;
    while run.stop().detail.contains("not reported yet") {
        assert!(Instant::now() < end);
    }
    run.orders();
    look(0.5);
    assert_eq!(run.stop().state, InputState::Stopped);
    assert!(run.arm().unwrap_err().contains("pedal is released: hold it"));
    assert_eq!(run.orders(), [Order::Disarm]);
    look(0.6);
    assert!(run.arm().unwrap_err().contains("pedal is released"), "it may be a contact that chatters");
    run_again(&run);
    assert_eq!((run.orders(), run.arm()), (vec![], Ok(())));
    assert_eq!(run.orders(), [Order::Arm]);
    // Not a number, not finite although on the side that runs, missing, or not of the stream.
    for bytes in [bytes(f64::NAN), bytes(f64::INFINITY), bytes(1.0)[..15].to_vec(), Vec::new()] {
        run_again(&run);
        taps[0].feed(Encoding::F64, &bytes);
        assert_eq!(run.orders(), [Order::Disarm]);
    }
    run_again(&run);
    let lost = run.until(InputState::Lost);
    assert_eq!((lost.detail.as_str(), run.orders()), ("no sample of buttons for 300ms", vec![Order::Disarm]));
    run_again(&run);
    drop(tap::lost_at_the_end(&taps));
    assert_eq!((run.stop().detail.as_str(), run.orders()), ("buttons is no longer read", vec![Order::Disarm]));
    let announced = run.announced();
    assert!(announced.starts_with(&["lost", "released", "held", "lost"]), "{announced:?}");
    // A loss at the end of a run takes effect but is not announced.
    run_again(&run);
    run.announced();
    run.watched.end();
    drop(tap::lost_at_the_end(&taps));
    assert_eq!((run.announced(), run.orders()), (vec![], vec![Order::Disarm]));
}

#[test]
fn an_input_whose_thread_panics_is_lost() {
    let run = run("[stop.pedal]\nkind = \"enabling\"\nfield = { device = \"buttons\", index = 0, runs_above = 0 }\n");
    let reporter = Reporter {
        index: 0,
        permission: Arc::clone(&run.permission),
        reported: run.reported.clone(),
        board: Arc::clone(&run.board),
        is_ending: Arc::default(),
    };
    let end = Instant::now() + PATIENCE;
    while run.stop().detail.contains("not reported yet") {
        assert!(Instant::now() < end);
    }
    while run.stop().state != InputState::Runs {
        assert!(Instant::now() < end);
        reporter.report(InputState::Runs, "");
    }
    run.orders();
    let panicked = std::thread::spawn({
        let reporter = reporter.clone();
        move || {
            let _lost = lost_at_a_panic(&reporter);
            panic!("on purpose");
        }
    });
    assert!(panicked.join().is_err());
    assert_eq!((run.stop().state, run.orders()), (InputState::Lost, vec![Order::Disarm]));
    assert_eq!(run.reported.states().borrow()[0], run.stop(), "an episode records what is shown");
}

/// A stream reports that its input runs while the thread that watches for silence reports its loss.
#[test]
fn an_input_that_is_lost_as_it_begins_to_run_is_shown_and_recorded_as_it_is() {
    let run = run("[stop.pedal]\nkind = \"enabling\"\nfield = { device = \"buttons\", index = 0, runs_above = 0 }\n");
    let reporter = Reporter {
        index: 0,
        permission: Arc::clone(&run.permission),
        reported: run.reported.clone(),
        board: Arc::clone(&run.board),
        is_ending: Arc::default(),
    };
    for round in 0..20 {
        let is_lost = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let end = Instant::now() + PATIENCE;
                while run.arm().is_err() && Instant::now() < end {}
                reporter.lost("silent");
                is_lost.store(true, Ordering::SeqCst);
            });
            while !is_lost.load(Ordering::SeqCst) {
                reporter.level(0, true);
            }
        });
        let (shown, recorded) = (run.stop().state, run.reported.states().borrow()[0].state);
        assert_eq!([shown, recorded], [run.permission.state(0); 2], "round {round}: shown and recorded");
    }
}

#[test]
fn a_chattering_contact_is_one_stop() {
    let (port, path) = pendant();
    let mut run = run(&serial(&path));
    send(&port, "RUN\n", || run.stop().state == InputState::Runs);
    run.announced();
    let chatter = "STOP\nRUN\n".repeat(100);
    for _ in 0..30 {
        let _ = rustix::io::write(&port, chatter.as_bytes());
        std::thread::sleep(Duration::from_millis(5));
    }
    let announced = run.announced();
    // If the machine stalls in between, one stop becomes two.
    assert!(
        announced.starts_with(&["pressed"]) && announced.len() < 20,
        "{}: {:?}",
        announced.len(),
        &announced[..announced.len().min(20)]
    );
    send(&port, "RUN\n", || run.stop().state == InputState::Runs);
}

#[test]
fn a_port_that_receives_other_bytes_is_not_reported_as_silent() {
    let (port, path) = pendant();
    let run = run(&serial(&path));
    let detail_has = |words: &str| run.stop().detail.contains(words);
    send(&port, "RUN\r", || detail_has("bytes came: check `baud`"));
    send(&port, "RUN\n", || run.stop().state == InputState::Runs);
    let end = Instant::now() + PATIENCE;
    while !detail_has("nothing was received for") {
        assert!(Instant::now() < end, "{:?}", run.stop());
    }
}
