//! The guard of the motors: whatever ends the process that drives them, they are stopped before their own time limit.
//!
//! This program is three: the test; with `drive` the process that drives motors on a line and is killed; and, started by
//! that one under the guard's name, its guard. So it has a `main` of its own.

#![expect(clippy::expect_used, clippy::print_stdout, reason = "a test, though it has a `main`")]

#[path = "support/motors.rs"]
mod motors;

use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStdout, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use motors::{Adapter, Hand, PATIENCE, spec};
use rapid_core::action::{ActionSource, Order};
use rapid_core::time::Stamp;
use rapid_devices::driver::can::guard;
use rapid_devices::driver::can::motors::Motors;
use rapid_registry::device::DeviceNode;
use rapid_registry::{CanAdapter, CanProtocol, CanSpec, DamiaoSpec, Stop};
use rustix::process::{Pid, Signal, kill_process};

const BOTH: [u16; 2] = [1, 2];

/// A test: its name, and what it does.
type Case = (&'static str, fn());

const CASES: [Case; 6] = [
    ("a_killed_process_leaves_no_motor_to_its_own_limit", killed),
    ("neither_does_one_that_crashes", crashed),
    ("nor_one_that_stands_still_and_it_drives_nothing_when_it_runs_again", stopped),
    ("a_joint_that_is_to_be_damped_is_damped_and_then_disabled", damped),
    ("a_process_that_ends_leaves_no_guard_and_no_line_open", ended),
    ("a_guard_that_is_killed_is_missed", unguarded),
];

fn main() -> ExitCode {
    let mut args = std::env::args_os();
    if args.next().is_some_and(|name| name == guard::NAME) {
        return guard::run(args);
    }
    let args: Vec<String> = args.map(OsString::into_string).map_while(Result::ok).collect();
    if let [word, adapter, path, stop] = &args[..]
        && word == "drive"
    {
        return drive(adapter, path, stop);
    }
    if args.iter().any(|arg| arg == "--list") {
        for (name, _) in CASES {
            println!("{name}: test");
        }
        return ExitCode::SUCCESS;
    }
    let filter = args.iter().find(|arg| !arg.starts_with('-'));
    for (name, case) in CASES {
        if filter.is_none_or(|filter| name.contains(filter.as_str())) {
            // One that fails panics, which ends the program with an error.
            case();
            println!("test {name} ... ok");
        }
    }
    ExitCode::SUCCESS
}

fn entry(stop: &str) -> DamiaoSpec {
    let mut entry = spec(2);
    let stop = if stop == "damp" { Stop::Damp } else { Stop::Limp };
    entry.motors.iter_mut().for_each(|motor| motor.stop.other_fault = stop);
    entry
}

/// Arms the motors on the line at `path`, and drives them until standard input closes.
fn drive(adapter: &str, path: &str, stop: &str) -> ExitCode {
    let adapter = CanAdapter::WORDS.into_iter().find(|(word, _)| *word == adapter).expect("an adapter").1;
    let motors = entry(stop);
    let can = CanSpec { adapter, bitrate: 1_000_000, protocol: CanProtocol::Damiao(motors.clone()) };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");
    let (end, mut ends) = tokio::sync::oneshot::channel::<()>();
    std::thread::spawn(move || {
        let _ = std::io::stdin().lines().last();
        drop(end);
    });
    runtime.block_on(async {
        let mut driven = Motors::open(&can, &motors, &DeviceNode::Tty(path.into())).await.expect("motors");
        let hand = Arc::<Hand>::default();
        driven.follow(Arc::clone(&hand) as Arc<dyn ActionSource>);
        let mut notices = driven.notices().expect("the first call");
        let mut ticks = tokio::time::interval(Duration::from_millis(50));
        let mut is_armed = false;
        loop {
            tokio::select! {
                _ = &mut ends => break,
                reading = driven.read() => drop(reading.expect("a sample")),
                _ = ticks.tick() => {
                    hand.point(&[0.3, -0.3]);
                }
            }
            while let Ok(notice) = notices.try_recv() {
                println!("{:?} {}", notice.arming, notice.text);
            }
            // Once all have answered.
            if !std::mem::replace(&mut is_armed, true) {
                driven.order(Order::Arm).expect("it listens");
            }
        }
        driven.close().await;
    });
    ExitCode::SUCCESS
}

/// Motors behind an adapter, and the process that drives them.
struct Driven {
    adapter: Adapter,
    process: Child,
    output: BufReader<ChildStdout>,
}

impl Driven {
    /// Its motors follow actions.
    fn start(kind: CanAdapter, stop: &str) -> Self {
        let adapter = Adapter::plug_as(kind, 2);
        let mut process = Command::new(std::env::current_exe().expect("this program"))
            .args(["drive", kind.word()])
            .arg(&adapter.path)
            .arg(stop)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process");
        let output = BufReader::new(process.stdout.take().expect("its output"));
        let mut driven = Self { adapter, process, output };
        driven.wait_for("Armed motors follow actions");
        driven
    }

    fn wait_for(&mut self, text: &str) -> String {
        let mut all = String::new();
        loop {
            let from = all.len();
            let count = self.output.read_line(&mut all).expect("text");
            assert!(count > 0, "it ended without {text:?}: {all}");
            if all[from..].contains(text) {
                return all[from..].to_owned();
            }
        }
    }

    fn signal(&self, signal: Signal) {
        kill_process(pid(self.process.id()), signal).expect("a signal");
    }

    /// Has it a handler for this signal?
    fn catches(&self, signal: Signal) -> bool {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id())).expect("its status");
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).expect("a mask").trim();
        u64::from_str_radix(caught, 16).expect("a mask") >> (signal.as_raw() - 1) & 1 == 1
    }

    /// The process of the guard, by the kernel's list of children.
    fn guard(&self) -> u32 {
        let mut children = String::new();
        for task in std::fs::read_dir(format!("/proc/{}/task", self.process.id())).expect("its threads").flatten() {
            children += &std::fs::read_to_string(task.path().join("children")).unwrap_or_default();
        }
        let is_guard = |id: &u32| {
            let name = std::fs::read_to_string(format!("/proc/{id}/comm")).unwrap_or_default();
            name.trim_end() == guard::NAME
        };
        let ids: Vec<u32> = children.split_whitespace().filter_map(|id| id.parse().ok()).filter(is_guard).collect();
        assert_eq!(ids.len(), 1, "one guard: {children}");
        ids[0]
    }

    /// Waits until both motors were disabled by an order, and none gave up by its own limit. Prints how long it took.
    fn expect_off(&self, what: &str, since: Stamp) {
        until(|| BOTH.iter().all(|motor| self.adapter.reported_at(*motor, "motor_disabled", since).is_some()));
        assert_eq!(self.adapter.count("motor_timeout"), 0, "{what}: {:?}", self.adapter.reported());
        for motor in BOTH {
            let off = self.adapter.reported_at(motor, "motor_disabled", since).expect("it was");
            println!("{what}: motor {motor} off after {:.1} ms", off.since(since).as_secs_f64() * 1e3);
        }
    }
}

impl Drop for Driven {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn pid(id: u32) -> Pid {
    Pid::from_raw(id.cast_signed()).expect("a process id")
}

fn until(mut done: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !done() {
        assert!(begun.elapsed() < PATIENCE, "it does not come to that");
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn killed() {
    for kind in [CanAdapter::Damiao, CanAdapter::Slcan] {
        let driven = Driven::start(kind, "limp");
        let guard = driven.guard();
        let at = Stamp::now();
        driven.signal(Signal::KILL);
        driven.expect_off(&format!("SIGKILL, {}", kind.word()), at);
        until(|| !std::path::Path::new(&format!("/proc/{guard}")).exists());
    }
}

fn crashed() {
    for signal in [Signal::SEGV, Signal::ABORT, Signal::BUS] {
        let driven = Driven::start(CanAdapter::Damiao, "limp");
        if matches!(signal, Signal::SEGV | Signal::BUS) {
            // The handler for stack overflows takes the first for a fault that comes again, and makes way.
            driven.signal(signal);
            until(|| !driven.catches(signal));
        }
        let at = Stamp::now();
        driven.signal(signal);
        driven.expect_off(&format!("{signal:?}"), at);
    }
}

fn stopped() {
    let mut driven = Driven::start(CanAdapter::Damiao, "limp");
    let at = Stamp::now();
    driven.signal(Signal::STOP);
    driven.expect_off("SIGSTOP", at);
    let enabled = driven.adapter.count("motor_enabled");
    driven.signal(Signal::CONT);
    let text = driven.wait_for("Faulted");
    assert!(text.contains("rapid was held up: no motor was commanded for"), "{text}");
    assert_eq!(driven.adapter.count("motor_enabled"), enabled, "{:?}", driven.adapter.reported());
}

fn damped() {
    let driven = Driven::start(CanAdapter::Damiao, "damp");
    let at = Stamp::now();
    driven.signal(Signal::KILL);
    driven.expect_off("SIGKILL, damped", at);
    for motor in BOTH {
        // Commands came until then, or the motor would have given up; none was followed by another order.
        let off = driven.adapter.reported_at(motor, "motor_disabled", at).expect("it was");
        assert!(off.since(at) >= guard::KEEP_FOR, "it was disabled {:?} after the death", off.since(at));
    }
}

fn ended() {
    let mut driven = Driven::start(CanAdapter::Damiao, "limp");
    let guard = driven.guard();
    drop(driven.process.stdin.take());
    assert!(driven.process.wait().expect("its end").success());
    assert!(!std::path::Path::new(&format!("/proc/{guard}")).exists(), "its guard is left");
    driven.adapter.wait_until_off(&BOTH);
    assert_eq!(driven.adapter.count("motor_timeout"), 0);
}

fn unguarded() {
    let mut driven = Driven::start(CanAdapter::Damiao, "limp");
    kill_process(pid(driven.guard()), Signal::KILL).expect("a signal");
    driven.wait_for("the guard of the motors has ended: if rapid is killed, they stop by their own time limit alone");
    // The second line.
    let at = Stamp::now();
    driven.signal(Signal::KILL);
    until(|| BOTH.iter().all(|motor| driven.adapter.reported_at(*motor, "motor_timeout", at).is_some()));
}
