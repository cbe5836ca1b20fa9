//! Holding brakes of joints: threads that engage and release them over lines of GPIO chips.
//!
//! Setting a line over USB takes a millisecond, and seconds if its chip hangs. No cycle of the motors and no other chip
//! may wait for that: each chip has its own thread.
//!
//! Invariant: a line is opened engaged, and engaged when the thread ends.
//! Invariant: a brake is reported engaged or released only if its line was read back in that state and no other was requested
//! since. A line that cannot be driven, or is not open yet, is reported broken, and so are all lines of a chip that
//! hangs.
//! Invariant: the functions called in a motor cycle neither wait nor allocate.

use std::io;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::motors::Brakes as State;
use rapid_registry::{BrakeSpec, DamiaoSpec};
use rapid_system::gpio::Output;
use rapid_system::realtime::{CONTROL_PRIORITY, use_fifo};
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

use super::guard::{Guard, hand_over};

/// Every line is set again after this, so that an unplugged chip is noticed and a replugged one opened.
const AGAIN: Duration = Duration::from_millis(500);
/// A chip that takes longer to set a line cannot drive a brake.
const SET_WITHIN: Duration = Duration::from_millis(200);
/// A line that takes longer than this to open is reported broken until it is open.
const OPENS_WITHIN: Duration = Duration::from_secs(1);
/// At its end the thread must engage all brakes within this; otherwise it is abandoned.
const ENDS_WITHIN: Duration = Duration::from_millis(200);

/// The brakes of a bus. Dropping engages them.
#[derive(Debug)]
pub(super) struct Brakes {
    chips: Vec<Chip>,
}

/// A chip and its thread.
#[derive(Debug)]
struct Chip {
    shared: Arc<Shared>,
    /// Bits of the motors whose brakes it drives.
    motors: u16,
    /// Has a message once all its lines were tried, and an end when the thread has ended.
    ended: Receiver<()>,
}

#[derive(Debug)]
struct Shared {
    /// Bits of motors whose brakes must be released.
    wanted: AtomicU16,
    /// [`State`]: the bits of `released`, `moving` and `broken`, from the lowest on.
    state: AtomicU64,
    /// When the thread began to set lines; 0 while it sleeps.
    busy: AtomicU64,
    ends: AtomicBool,
    wake: OwnedFd,
}

impl Shared {
    fn new() -> io::Result<Self> {
        let shared = Self {
            wanted: AtomicU16::new(0),
            state: AtomicU64::new(0),
            busy: AtomicU64::new(0),
            ends: AtomicBool::new(false),
            wake: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?,
        };
        shared.publish(UNKNOWN);
        Ok(shared)
    }

    /// Is the brake of these motors to be released? Only if all want that.
    fn releases(&self, motors: u16) -> bool {
        !self.ends.load(Ordering::SeqCst) && self.wanted.load(Ordering::SeqCst) & motors == motors
    }

    fn wake(&self) {
        // Room for a number is always there.
        let _ = rustix::io::write(&self.wake, &1_u64.to_ne_bytes());
    }

    fn publish(&self, state: State) {
        let bits = [state.released, state.moving, state.broken].into_iter().rev();
        self.state.store(bits.fold(0, |all, bits| all << 16 | u64::from(bits)), Ordering::SeqCst);
    }

    fn state(&self, now: Stamp) -> State {
        let busy = self.busy.load(Ordering::SeqCst);
        let is_stuck = busy > 0 && now.since(Stamp(busy)) >= SET_WITHIN;
        let bits = self.state.load(Ordering::SeqCst);
        let [released, moving, broken] = [bits, bits >> 16, bits >> 32].map(|bits| (bits & 0xffff) as u16);
        State { released, moving, broken: if is_stuck { u16::MAX } else { broken } }
    }
}

/// Before anything was opened.
const UNKNOWN: State = State { released: 0, moving: 0, broken: u16::MAX };

impl Brakes {
    /// Opens the brakes of an entry, all engaged; `None` where it has none. What cannot be opened is tried again.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn start(spec: &DamiaoSpec, guard: Option<&Guard>) -> io::Result<Option<Self>> {
        let mut brakes = Self { chips: Vec::new() };
        let mut rest = lines(spec);
        while let Some(chip) = rest.first().map(|line| line.spec.chip.clone()) {
            let (lines, others) = rest.into_iter().partition(|line: &Line| line.spec.chip == chip);
            rest = others;
            brakes.chips.push(Chip::start(lines, guard)?);
        }
        // An arm that is ordered at once needs them open.
        let end = Stamp::now().after(OPENS_WITHIN);
        for chip in &brakes.chips {
            let _ = chip.ended.recv_timeout(end.since(Stamp::now()));
        }
        Ok((!brakes.chips.is_empty()).then_some(brakes))
    }

    /// Requests that these brakes be released, a bit for each motor, and all others engaged.
    pub(super) fn release(&self, motors: u16) {
        for Chip { shared, motors: own, .. } in &self.chips {
            if shared.wanted.swap(motors & own, Ordering::SeqCst) != motors & own {
                shared.wake();
            }
        }
    }

    pub(super) fn state(&self, now: Stamp) -> State {
        self.chips.iter().fold(State::default(), |all, chip| {
            let State { released, moving, broken } = chip.shared.state(now);
            State {
                released: all.released | released & chip.motors,
                moving: all.moving | moving & chip.motors,
                broken: all.broken | broken & chip.motors,
            }
        })
    }
}

impl Chip {
    fn start(lines: Vec<Line>, guard: Option<&Guard>) -> io::Result<Self> {
        let shared = Arc::new(Shared::new()?);
        let motors = lines.iter().fold(0, |all, line| all | line.motors);
        let guard = guard.map(Guard::socket).transpose()?;
        let (end, ended) = channel();
        let tender = Tender { lines, shared: Arc::clone(&shared), state: UNKNOWN, guard, end };
        std::thread::Builder::new().name("brakes".to_owned()).spawn(move || tender.run())?;
        Ok(Self { shared, motors, ended })
    }
}

impl Drop for Brakes {
    fn drop(&mut self) {
        for Chip { shared, .. } in &self.chips {
            shared.ends.store(true, Ordering::SeqCst);
            shared.wake();
        }
        let end = Stamp::now().after(ENDS_WITHIN);
        for chip in &self.chips {
            // The message of its start may still be queued; an error means that the thread has ended.
            while chip.ended.recv_timeout(end.since(Stamp::now())).is_ok() {}
        }
    }
}

/// The thread of a chip.
struct Tender {
    lines: Vec<Line>,
    shared: Arc<Shared>,
    /// The published state.
    state: State,
    guard: Option<OwnedFd>,
    /// See [`Chip::ended`].
    end: Sender<()>,
}

impl Tender {
    fn run(mut self) {
        // Without permission for it, the motors' thread warns.
        let _ = use_fifo(CONTROL_PRIORITY);
        let mut is_first = true;
        loop {
            let ends = self.shared.ends.load(Ordering::SeqCst);
            self.tend();
            self.shared.busy.store(0, Ordering::SeqCst);
            if ends {
                return;
            }
            if std::mem::take(&mut is_first) {
                // Its owner may have stopped waiting.
                let _ = self.end.send(());
            }
            self.wait();
        }
    }

    /// Sets every line. The state of each is published right before and after it is set, not once all are set; the
    /// wanted state is read again for each, because the previous line may have taken seconds. Open lines to be engaged
    /// come first.
    fn tend(&mut self) {
        let Self { lines, shared, state, guard, .. } = self;
        lines.sort_by_cached_key(|line| (line.output.is_none(), shared.releases(line.motors)));
        for line in lines {
            // The limit of a chip that hangs is for one line.
            shared.busy.store(Stamp::now().0.max(1), Ordering::SeqCst);
            let bits = line.motors;
            if shared.releases(bits) != (state.released & bits == bits) {
                state.moving |= bits;
                shared.publish(*state);
            }
            let releases = shared.releases(bits);
            let tended = line.tend(releases, guard.as_ref());
            let put = |all: &mut u16, is_so: bool| *all = if is_so { *all | bits } else { *all & !bits };
            put(&mut state.released, releases && tended.is_ok());
            put(&mut state.broken, tended.is_err());
            put(&mut state.moving, false);
            shared.publish(*state);
            if let Err(why) = tended {
                line.complain(why);
            }
        }
    }

    fn wait(&self) {
        let limit = Timespec { tv_sec: 0, tv_nsec: AGAIN.subsec_nanos().into() };
        let _ = poll(&mut [PollFd::new(&self.shared.wake, PollFlags::IN)], Some(&limit));
        let _ = rustix::io::read(&self.shared.wake, &mut [0; 8]);
    }
}

impl Drop for Tender {
    fn drop(&mut self) {
        // After a panic no thread drives them.
        if std::thread::panicking() {
            self.shared.publish(UNKNOWN);
        }
    }
}

/// One line, which the brakes of several joints may share.
#[derive(Debug)]
struct Line {
    spec: BrakeSpec,
    /// Bits of its motors.
    motors: u16,
    names: String,
    output: Option<Output>,
    /// The guard has the line, or knows that it is closed.
    is_handed_over: bool,
    /// Why it cannot be driven, as last logged.
    why: Option<String>,
}

fn lines(spec: &DamiaoSpec) -> Vec<Line> {
    let mut lines: Vec<Line> = Vec::new();
    for (index, motor) in spec.motors.iter().enumerate() {
        let Some(brake) = &motor.brake else { continue };
        let bit = 1 << (index % 16);
        let shared = lines.iter_mut().find(|line| (&line.spec.chip, line.spec.line) == (&brake.chip, brake.line));
        if let Some(line) = shared {
            line.motors |= bit;
            line.names = format!("{}, {}", line.names, motor.name);
        } else {
            let (spec, names) = (brake.clone(), motor.name.clone());
            lines.push(Line { spec, motors: bit, names, output: None, is_handed_over: true, why: None });
        }
    }
    lines
}

impl Line {
    /// Releases the brake, or engages it.
    fn tend(&mut self, releases: bool, guard: Option<&OwnedFd>) -> Result<(), String> {
        let Self { spec, motors, output, is_handed_over, .. } = self;
        let engaged_high = !spec.released_high;
        let tended = match output {
            Some(output) => Ok(output),
            // Both processes have to close a line before it can be opened again.
            None if guard.is_some() && !*is_handed_over => Err("its guard still holds it".to_owned()),
            None => Output::open(&spec.chip, spec.line, engaged_high).map(|opened| {
                *is_handed_over = false;
                output.insert(opened)
            }),
        };
        let tended = tended.and_then(|output| {
            let set = output.set(releases != engaged_high);
            set.map_err(|error| format!("line {} of {}: {error}", spec.line, spec.chip.display()))
        });
        if tended.is_err()
            && let Some(output) = output.take()
        {
            // A line keeps its level when it is closed: it must not be the one that releases.
            let _ = output.set(engaged_high);
            *is_handed_over = false;
        }
        if let Some(guard) = guard.filter(|_| !*is_handed_over) {
            *is_handed_over = hand_over(guard, *motors, engaged_high, output.as_ref().map(|output| output.fd()));
        }
        tended?;
        if let Some(why) = self.why.take() {
            tracing::info!(motors = self.names, "the brake can be driven again, after: {why}");
        }
        Ok(())
    }

    fn complain(&mut self, why: String) {
        if self.why.as_ref() != Some(&why) {
            tracing::warn!(motors = self.names, "the brake cannot be driven: {why}");
        }
        self.why = Some(why);
    }
}
