//! Motors on a serial line: the simulated motors of the virtual bench behind a Damiao or slcan adapter, on a
//! pseudo-terminal.

#![allow(dead_code, reason = "each who uses it needs a part of it")]

#[path = "motor_spec.rs"]
#[allow(clippy::duplicate_mod, reason = "`motor_world` has it too")]
pub(crate) mod motor_spec;
#[path = "patience.rs"]
pub(crate) mod patience;

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

pub(crate) use patience::PATIENCE;
use rapid_core::action::{ActionSource, MAX_ACTION, NoAction};
use rapid_core::bell::Bell;
use rapid_core::time::Stamp;
use rapid_registry::{CanAdapter, DamiaoSpec, MotorMode, MotorSpec};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use vbench::emu::can::bus::{self, Bus};
use vbench::emu::can::damiao::{self, Damiao};
use vbench::emu::can::slcan::{Received, Slcan};
use vbench::emu::order::Order;
use vbench::emu::reported::Reported;

/// Actions of a test, in place of the topic.
#[derive(Debug, Default)]
pub(crate) struct Hand {
    bell: Bell,
    action: Mutex<Option<(Vec<f64>, Stamp)>>,
}

impl Hand {
    /// Publishes an action with the current time.
    pub(crate) fn point(&self, target: &[f64]) {
        *self.action.lock().expect("whole") = Some((target.to_vec(), Stamp::now()));
        self.bell.ring();
    }
}

impl ActionSource for Hand {
    fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.bell.descriptor()
    }

    fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction> {
        self.bell.silence();
        let Some((target, tick)) = self.action.lock().expect("whole").take() else { return Ok(None) };
        let place = &mut action[..target.len()];
        place.copy_from_slice(&target);
        Ok(Some((place, tick)))
    }
}

/// An adapter with motors behind it. Dropping it unplugs it.
pub(crate) struct Adapter {
    /// Path of its line.
    pub(crate) path: PathBuf,
    shared: Arc<Mutex<Shared>>,
    pulled: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    bus: Bus,
    /// Reports of the motors, with their times.
    reported: Vec<(Stamp, Reported)>,
}

/// The adapter's protocol on its line.
enum Codec {
    Damiao(Damiao),
    Slcan(Slcan),
}

impl Codec {
    /// Writes the bus's answers to bytes from the host into `answers`.
    fn receive(&mut self, bytes: &[u8], bus: &mut Bus, answers: &mut Vec<u8>) {
        let mut frames = Vec::new();
        match self {
            Self::Damiao(damiao) => damiao.receive(bytes, answers, |frame| frames.push(frame)),
            Self::Slcan(slcan) => slcan.receive(bytes, answers, |received| {
                if let Received::Frame(frame) = received {
                    frames.push(frame);
                }
            }),
        }
        for frame in frames {
            bus.send(&frame, Stamp::now().0, |answer| match self {
                Self::Damiao(_) => damiao::send_to_host(&answer, answers),
                Self::Slcan(slcan) => slcan.send_to_host(&answer, answers),
            });
        }
    }
}

impl Adapter {
    /// A Damiao adapter with `count` motors, with the slave ids 1, 2, ... and the master ids 0x11, 0x12, ...
    pub(crate) fn plug(count: u16) -> Self {
        Self::plug_as(CanAdapter::Damiao, count)
    }

    /// An adapter that uses slcan or Damiao's protocol.
    pub(crate) fn plug_as(adapter: CanAdapter, count: u16) -> Self {
        let codec = match adapter {
            CanAdapter::Slcan => Codec::Slcan(Slcan::default()),
            _ => Codec::Damiao(Damiao::default()),
        };
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("terminal");
        grantpt(&master).expect("terminal");
        unlockpt(&master).expect("terminal");
        let path = PathBuf::from(ptsname(&master, Vec::new()).expect("its name").into_string().expect("text"));
        let motors: Vec<_> = (1..=count)
            .map(|id| bus::MotorSpec::parse(&format!("{id:x}/{:x}/DM4310", id + 0x10)).expect("a motor"))
            .collect();
        let shared = Arc::new(Mutex::new(Shared { bus: Bus::new(&motors), reported: Vec::new() }));
        let pulled = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let (shared, pulled) = (Arc::clone(&shared), Arc::clone(&pulled));
            move || serve(master, codec, &shared, &pulled)
        });
        Self { path, shared, pulled, thread: Some(thread) }
    }

    /// Applies an event to a motor.
    pub(crate) fn apply(&self, motor: u16, order: Order) {
        self.shared.lock().expect("whole").bus.apply(Some(motor), order, Stamp::now().0);
    }

    /// The motors' reports so far, oldest first.
    pub(crate) fn reported(&self) -> Vec<&'static str> {
        self.shared.lock().expect("whole").reported.iter().map(|(_, reported)| reported.action).collect()
    }

    /// How many times the motors reported this.
    pub(crate) fn count(&self, action: &str) -> usize {
        self.reported().iter().filter(|reported| **reported == action).count()
    }

    /// When a motor first reported this after `since`.
    pub(crate) fn reported_at(&self, motor: u16, action: &str, since: Stamp) -> Option<Stamp> {
        let shared = self.shared.lock().expect("whole");
        let mut of = shared
            .reported
            .iter()
            .filter(|(_, reported)| reported.action == action && reported.fields["motor"] == motor);
        of.find(|(at, _)| *at >= since).map(|(at, _)| *at)
    }

    /// Waits until each of these motors was disabled after it was last enabled. A motor may report several times that
    /// it was disabled.
    pub(crate) fn wait_until_off(&self, motors: &[u16]) {
        let begun = Instant::now();
        while !motors.iter().all(|motor| self.is_off(*motor)) {
            assert!(begun.elapsed() < PATIENCE, "of {motors:?} one was not turned off: {:?}", self.reported());
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Whether it was enabled and then disabled.
    fn is_off(&self, motor: u16) -> bool {
        let reported = &self.shared.lock().expect("whole").reported;
        let last = |action| {
            reported.iter().rposition(|(_, reported)| reported.action == action && reported.fields["motor"] == motor)
        };
        last("motor_enabled").is_some_and(|enabled| last("motor_disabled").is_some_and(|off| off > enabled))
    }
}

impl Drop for Adapter {
    fn drop(&mut self) {
        self.pulled.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn serve(master: OwnedFd, mut codec: Codec, shared: &Mutex<Shared>, pulled: &AtomicBool) {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let mut line = File::from(master);
    let mut piece = [0; 4096];
    while !pulled.load(Ordering::Acquire) {
        let waits = Timespec { tv_sec: 0, tv_nsec: 1_000_000 };
        let ready = {
            let mut fds = [PollFd::from_borrowed_fd(line.as_fd(), PollFlags::IN)];
            poll(&mut fds, Some(&waits)).expect("poll");
            fds[0].revents()
        };
        let mut answers = Vec::new();
        {
            let mut shared = shared.lock().expect("whole");
            if ready.contains(PollFlags::IN) {
                let count = line.read(&mut piece).unwrap_or(0);
                codec.receive(&piece[..count], &mut shared.bus, &mut answers);
            } else if ready.contains(PollFlags::HUP) {
                // No program has it open: it may be opened again.
                std::thread::sleep(Duration::from_millis(1));
            }
            shared.bus.tend(Stamp::now().0);
            let now = Stamp::now();
            let reported: Vec<_> = shared.bus.reported().map(|reported| (now, reported)).collect();
            shared.reported.extend(reported);
        }
        // Data that is not read is lost.
        let _ = line.write_all(&answers);
    }
}

/// The entry of `count` motors in position mode, at 200 Hz.
pub(crate) fn spec(count: u16) -> DamiaoSpec {
    let motor = |id| MotorSpec {
        mode: MotorMode::Mit { kp: 20.0, kd: 1.0 },
        position: [-1.0, 1.0],
        velocity: 5.0,
        torque: 8.0,
        slew: 4.0,
        max_rotor: 80.0,
        ..motor_spec::motor(id)
    };
    DamiaoSpec {
        // On a busy machine a test, or the terminal, may not run for a second.
        disable_after: Some(Duration::from_secs(5)),
        timeout: Duration::from_secs(2),
        silent_after: Duration::from_secs(2),
        effector: None,
        ..motor_spec::bus((1..=count).map(motor).collect())
    }
}
