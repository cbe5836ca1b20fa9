//! Holding brakes of joints: a thread that engages and releases them over lines of GPIO chips.
//!
//! A line behind USB takes a millisecond, and one whose chip hangs seconds: no cycle of the motors may wait for that.
//!
//! Invariant: a line is opened engaged, and engaged when the thread ends.
//! Invariant: what is reported engaged or released was taken by the kernel; a line that cannot be driven, or is not open
//! yet, is reported broken, and so are all while the thread waits for a chip.
//! Invariant: what the motors' cycle calls neither waits nor allocates.

use std::io;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, AtomicU32, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

use super::guard::{Guard, hand_over};
use crate::control::motors::Brakes as State;
use crate::gpio::Output;
use crate::realtime::{CONTROL_PRIORITY, use_fifo};
use crate::registry::{BrakeSpec, DamiaoSpec};
use crate::time::Stamp;

/// Every line is set again after this, so that a chip that was unplugged is noticed, and one that is back opened.
const AGAIN: Duration = Duration::from_millis(500);
/// A chip that takes longer to set a line cannot drive a brake.
const SET_WITHIN: Duration = Duration::from_millis(200);
/// Lines are open within this, or are reported broken until they are.
const OPENS_WITHIN: Duration = Duration::from_secs(1);
/// The thread engages all brakes within this at its end, or is left behind.
const ENDS_WITHIN: Duration = Duration::from_millis(200);

/// The brakes of a bus. Dropped, they are engaged.
#[derive(Debug)]
pub(super) struct Brakes {
    shared: Arc<Shared>,
    ended: Receiver<()>,
}

#[derive(Debug)]
struct Shared {
    /// Bits of motors whose brakes are to be released.
    wanted: AtomicU16,
    /// [`State`], the bits of `broken` above those of `released`.
    state: AtomicU32,
    /// When the thread began to set lines; 0 while it sleeps.
    busy: AtomicU64,
    ends: AtomicBool,
    wake: OwnedFd,
}

impl Shared {
    fn wake(&self) {
        // Room for a number is always there.
        let _ = rustix::io::write(&self.wake, &1_u64.to_ne_bytes());
    }

    fn publish(&self, state: State) {
        self.state.store(u32::from(state.broken) << 16 | u32::from(state.released), Ordering::SeqCst);
    }
}

impl Brakes {
    /// Opens the brakes of an entry, all engaged; `None` where it has none. What cannot be opened is tried again.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub(super) fn start(spec: &DamiaoSpec, guard: Option<&Guard>) -> io::Result<Option<Self>> {
        let lines = lines(spec);
        if lines.is_empty() {
            return Ok(None);
        }
        let shared = Arc::new(Shared {
            wanted: AtomicU16::new(0),
            state: AtomicU32::new(u32::from(u16::MAX) << 16),
            busy: AtomicU64::new(0),
            ends: AtomicBool::new(false),
            wake: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?,
        });
        let guard = guard.map(Guard::socket).transpose()?;
        let (end, ended) = channel();
        let tender = Tender { lines, shared: Arc::clone(&shared), guard, end };
        std::thread::Builder::new().name("brakes".to_owned()).spawn(move || tender.run())?;
        // An arm that is ordered at once needs them open.
        let _ = ended.recv_timeout(OPENS_WITHIN);
        Ok(Some(Self { shared, ended }))
    }

    /// These brakes are to be released, a bit for each motor, and all others engaged.
    pub(super) fn release(&self, motors: u16) {
        if self.shared.wanted.swap(motors, Ordering::SeqCst) != motors {
            self.shared.wake();
        }
    }

    /// What they are.
    pub(super) fn state(&self, now: Stamp) -> State {
        let busy = self.shared.busy.load(Ordering::SeqCst);
        let is_stuck = busy > 0 && now.since(Stamp(busy)) >= SET_WITHIN;
        let [low, high, broken_low, broken_high] = self.shared.state.load(Ordering::SeqCst).to_le_bytes();
        State {
            released: u16::from_le_bytes([low, high]),
            broken: if is_stuck { u16::MAX } else { u16::from_le_bytes([broken_low, broken_high]) },
        }
    }
}

impl Drop for Brakes {
    fn drop(&mut self) {
        self.shared.ends.store(true, Ordering::SeqCst);
        self.shared.wake();
        // A message may still be there of its beginning; an error says that the thread has ended.
        while self.ended.recv_timeout(ENDS_WITHIN).is_ok() {}
    }
}

/// The thread.
struct Tender {
    lines: Vec<Line>,
    shared: Arc<Shared>,
    guard: Option<OwnedFd>,
    /// Has a message once all lines were tried, and is dropped at the end.
    end: Sender<()>,
}

impl Tender {
    fn run(mut self) {
        // Without the right to it, the motors' thread warns.
        let _ = use_fifo(CONTROL_PRIORITY);
        let mut is_first = true;
        loop {
            self.shared.busy.store(Stamp::now().0.max(1), Ordering::SeqCst);
            let ends = self.shared.ends.load(Ordering::SeqCst);
            let wanted = if ends { 0 } else { self.shared.wanted.load(Ordering::SeqCst) };
            let mut state = State::default();
            for line in &mut self.lines {
                match line.tend(wanted, self.guard.as_ref()) {
                    Ok(is_released) => state.released |= if is_released { line.motors } else { 0 },
                    Err(why) => {
                        state.broken |= line.motors;
                        line.complain(why);
                    }
                }
            }
            self.shared.publish(state);
            self.shared.busy.store(0, Ordering::SeqCst);
            if ends {
                return;
            }
            if std::mem::take(&mut is_first) {
                // It may be waited for no more.
                let _ = self.end.send(());
            }
            self.wait();
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
        // After a panic nobody drives them any more.
        if std::thread::panicking() {
            self.shared.publish(State { released: 0, broken: u16::MAX });
        }
    }
}

/// One line, which the brakes of several joints may share.
#[derive(Debug)]
struct Line {
    spec: BrakeSpec,
    /// Bits of its motors.
    motors: u16,
    /// Their names.
    names: String,
    output: Option<Output>,
    /// The guard has it, or was informed that it is closed.
    is_handed_over: bool,
    /// Why it cannot be driven, as was logged last.
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
    /// Releases the brake if all its joints want that, and otherwise engages it. Says whether it is released.
    fn tend(&mut self, wanted: u16, guard: Option<&OwnedFd>) -> Result<bool, String> {
        let Self { spec, motors, output, is_handed_over, .. } = self;
        let engaged_high = !spec.released_high;
        let tended = match output {
            Some(output) => Ok(output),
            // Both processes have to close a line before it can be opened again.
            None if guard.is_some() && !*is_handed_over => Err("its guard does not let go of it".to_owned()),
            None => Output::open(&spec.chip, spec.line, engaged_high).map(|opened| {
                *is_handed_over = false;
                output.insert(opened)
            }),
        };
        let released = wanted & *motors == *motors;
        let tended = tended.and_then(|output| {
            let set = output.set(released != engaged_high);
            set.map_err(|error| format!("line {} of {}: {error}", spec.line, spec.chip.display()))
        });
        if tended.is_err() && output.take().is_some() {
            *is_handed_over = false;
        }
        if let Some(guard) = guard.filter(|_| !*is_handed_over) {
            *is_handed_over = hand_over(guard, *motors, engaged_high, output.as_ref().map(|output| output.fd()));
        }
        tended?;
        if let Some(why) = self.why.take() {
            tracing::info!(motors = self.names, "the brake can be driven again, after: {why}");
        }
        Ok(released)
    }

    fn complain(&mut self, why: String) {
        if self.why.as_ref() != Some(&why) {
            tracing::warn!(motors = self.names, "the brake cannot be driven: {why}");
        }
        self.why = Some(why);
    }
}
