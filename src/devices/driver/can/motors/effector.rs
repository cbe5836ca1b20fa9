//! Thread `effector`: turns actions, which are poses of the tip of an arm, into targets of its motors.
//!
//! It takes actions where the motors would, and thread `control` takes the targets from it ([`Targets`]). The solver needs
//! a fraction of a millisecond for a pose that is near and some for one that is out of reach, allocates and locks, which
//! thread `control` must not.
//!
//! Invariant: an action whose pose the arm does not reach gives no target: without one in time the motors hold. It is
//! counted and reported.

use std::fmt;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
use std::thread::JoinHandle;
use std::time::Duration;

use rapid_core::action::{ActionSource, MAX_ACTION, NoAction};
use rapid_core::bell::Bell;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_motors::kinematics::{Arm, Solver};
use rapid_registry::{MAX_MOTORS, MOTOR_CHANNELS};
use rustix::event::{PollFd, PollFlags, Timespec};

/// The longest time that an action without a notification waits.
const LOOK: Duration = Duration::from_millis(10);
/// Joints nearer to their last target than this, rad, are on their way: the next target is sought from the last one, so that
/// the arm stays as it is bent. Farther away they do not follow, or were moved by hand: it is sought from where they are.
const ON_THE_WAY: f64 = 0.3;

/// The arm of a bus of motors.
#[derive(Debug)]
pub struct Effector {
    arm: Arm,
    motors: usize,
    latest: Arc<Latest>,
    thread: Option<(Arc<AtomicBool>, JoinHandle<Tally>)>,
}

/// What became of the actions.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Tally {
    /// They became targets.
    followed: u64,
    /// The arm does not reach their poses.
    out_of_reach: u64,
    /// They are no poses of this arm, or not the policy's.
    invalid: u64,
}

impl Tally {
    fn refuse(&mut self, refused: NoAction) {
        match refused {
            NoAction::OutOfReach => self.out_of_reach += 1,
            NoAction::NoNumbers | NoAction::Foreign | NoAction::Length => self.invalid += 1,
        }
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { followed, out_of_reach, invalid } = self;
        write!(f, "{} followed, {out_of_reach} out of reach, {invalid} invalid", text::counted(*followed, "action"))
    }
}

/// Where the motors were at the last sample.
#[derive(Debug, Default)]
struct Latest {
    positions: [AtomicU64; MAX_MOTORS],
    is_known: AtomicBool,
}

impl Effector {
    /// For so many motors.
    pub fn new(arm: Arm, motors: usize) -> Self {
        Self { arm, motors, latest: Arc::default(), thread: None }
    }

    /// Takes the state of the motors, and writes the numbers of the tip that follow it in a sample. Returns how many.
    pub fn update(&self, motors: &[f64], tip: &mut [f64]) -> usize {
        for (place, position) in self.latest.positions.iter().zip(motors.iter().step_by(MOTOR_CHANNELS)) {
            place.store(position.to_bits(), Ordering::Relaxed);
        }
        self.latest.is_known.store(true, Ordering::Release);
        self.arm.state(motors, tip);
        self.arm.numbers()
    }

    /// Starts the thread; returns where thread `control` takes its targets.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn follow(&mut self, actions: Arc<dyn ActionSource>) -> std::io::Result<Arc<dyn ActionSource>> {
        self.stop();
        let (targets, stop) = (Arc::new(Targets::new(self.motors)), Arc::<AtomicBool>::default());
        let worker = Worker {
            solver: self.arm.solver(),
            motors: self.motors,
            actions,
            latest: Arc::clone(&self.latest),
            targets: Arc::clone(&targets),
            stop: Arc::clone(&stop),
        };
        let thread = std::thread::Builder::new().name("effector".to_owned()).spawn(move || worker.run())?;
        self.thread = Some((stop, thread));
        Ok(targets)
    }

    /// The thread has panicked: no action is followed any more.
    pub(super) fn has_ended(&self) -> bool {
        self.thread.as_ref().is_some_and(|(_, thread)| thread.is_finished())
    }

    /// Ends the thread, if it runs, and reports what became of its actions.
    fn stop(&mut self) -> Option<Tally> {
        let (stop, thread) = self.thread.take()?;
        stop.store(true, Ordering::Release);
        // Its panic has been reported; the motors hold without its targets.
        let tally = thread.join().ok()?;
        if tally != Tally::default() {
            tracing::info!("thread `effector`: {tally}");
        }
        Some(tally)
    }
}

impl Drop for Effector {
    /// Waits for the action that is being solved, some 10 ms at most.
    fn drop(&mut self) {
        self.stop();
    }
}

struct Worker {
    solver: Solver,
    motors: usize,
    actions: Arc<dyn ActionSource>,
    latest: Arc<Latest>,
    targets: Arc<Targets>,
    stop: Arc<AtomicBool>,
}

impl Worker {
    fn run(mut self) -> Tally {
        let mut last: Option<[f64; MAX_MOTORS]> = None;
        let mut tally = Tally::default();
        while !self.stop.load(Ordering::Acquire) {
            let mut action = [0.0; MAX_ACTION];
            match self.actions.newest(&mut action) {
                Ok(None) => self.wait(),
                Ok(Some((action, tick))) => {
                    // Before the first sample the motors have no position.
                    let Some(now) = self.where_they_are() else { continue };
                    let from = last.filter(|last| self.are_on_the_way(last, &now)).unwrap_or(now);
                    match self.solver.targets(action, &from) {
                        Ok(targets) => {
                            tally.followed += 1;
                            last = Some(targets);
                            self.targets.give(tick, targets.get(..self.motors).unwrap_or_default());
                        }
                        Err(refused) => {
                            tally.refuse(refused);
                            self.targets.refuse(refused);
                        }
                    }
                }
                Err(refused) => {
                    tally.refuse(refused);
                    self.targets.refuse(refused);
                }
            }
        }
        tally
    }

    fn are_on_the_way(&self, last: &[f64; MAX_MOTORS], now: &[f64; MAX_MOTORS]) -> bool {
        // A gripper that holds something stays far from its target, and where it is does not move the tip.
        let pair = |joint: &usize| Some((last.get(*joint)?, now.get(*joint)?));
        self.solver.joints().iter().filter_map(pair).all(|(last, now)| (last - now).abs() < ON_THE_WAY)
    }

    /// Until an action may have arrived.
    fn wait(&self) {
        let Some(bell) = self.actions.bell() else { return std::thread::sleep(LOOK) };
        // So short a time has this form; an interrupted wait is repeated.
        let limit = Timespec::try_from(LOOK).unwrap_or_default();
        let _ = rustix::event::poll(&mut [PollFd::new(&bell, PollFlags::IN)], Some(&limit));
    }

    fn where_they_are(&self) -> Option<[f64; MAX_MOTORS]> {
        let is_known = self.latest.is_known.load(Ordering::Acquire);
        is_known
            .then(|| self.latest.positions.each_ref().map(|position| f64::from_bits(position.load(Ordering::Relaxed))))
    }
}

/// The newest target, from thread `effector` to thread `control`: a seqlock, so that neither waits for the other.
#[derive(Debug)]
struct Targets {
    motors: usize,
    /// Odd while it is written.
    version: AtomicU32,
    /// The version that was taken last.
    taken: AtomicU32,
    tick: AtomicU64,
    positions: [AtomicU64; MAX_MOTORS],
    /// Which refusal, if it is not a target: 1 + its place in [`REFUSALS`].
    refused: AtomicU32,
    bell: Bell,
}

const REFUSALS: [NoAction; 4] = [NoAction::NoNumbers, NoAction::Foreign, NoAction::OutOfReach, NoAction::Length];

impl Targets {
    fn new(motors: usize) -> Self {
        Self {
            motors,
            version: AtomicU32::new(0),
            taken: AtomicU32::new(0),
            tick: AtomicU64::new(0),
            positions: Default::default(),
            refused: AtomicU32::new(0),
            bell: Bell::default(),
        }
    }

    /// Only thread `effector` calls this.
    fn give(&self, tick: Stamp, targets: &[f64]) {
        self.write(|| {
            self.refused.store(0, Ordering::Relaxed);
            self.tick.store(tick.0, Ordering::Relaxed);
            for (place, target) in self.positions.iter().zip(targets) {
                place.store(target.to_bits(), Ordering::Relaxed);
            }
        });
    }

    /// Likewise.
    fn refuse(&self, refused: NoAction) {
        let place = REFUSALS.iter().position(|known| *known == refused).unwrap_or_default();
        self.write(|| self.refused.store(u32::try_from(place).unwrap_or_default() + 1, Ordering::Relaxed));
    }

    fn write(&self, values: impl FnOnce()) {
        self.version.fetch_add(1, Ordering::Relaxed);
        fence(Ordering::Release);
        values();
        self.version.fetch_add(1, Ordering::Release);
        self.bell.ring();
    }
}

impl ActionSource for Targets {
    fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.bell.descriptor()
    }

    fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction> {
        self.bell.silence();
        let version = self.version.load(Ordering::Acquire);
        // One that is being written rings when it is whole.
        if version % 2 == 1 || version == self.taken.load(Ordering::Relaxed) {
            return Ok(None);
        }
        for (place, position) in action.iter_mut().zip(&self.positions) {
            *place = f64::from_bits(position.load(Ordering::Relaxed));
        }
        let (tick, refused) = (self.tick.load(Ordering::Relaxed), self.refused.load(Ordering::Relaxed));
        fence(Ordering::Acquire);
        if self.version.load(Ordering::Relaxed) != version {
            return Ok(None);
        }
        self.taken.store(version, Ordering::Relaxed);
        let refused = usize::try_from(refused).ok().and_then(|place| place.checked_sub(1));
        match refused.and_then(|place| REFUSALS.get(place)) {
            Some(refused) => Err(*refused),
            None => Ok(action.get(..self.motors).map(|targets| (targets, Stamp(tick)))),
        }
    }
}

#[cfg(test)]
mod tests;
