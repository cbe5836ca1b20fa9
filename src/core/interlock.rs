//! Interlocks: emergency stops and enabling switches, each with an input that must run for the actuator to move.
//!
//! | input      | emergency stop         | enabling switch        |
//! |------------|------------------------|------------------------|
//! | runs       | an arm is possible     | an arm is possible     |
//! | stopped    | emergency stop         | disarm                 |
//! | lost       | emergency stop         | disarm                 |
//!
//! What an input is read from, and when it is lost, is known to the code that reports it; the orders are given by
//! [`Permission`](crate::permission::Permission).
//!
//! Invariant: an input that has not reported yet is lost. One that has stopped runs again only after it has reported nothing
//! else for [`SETTLES_IN`]: a chattering contact is one stop.
//! Invariant: nothing here moves anything: an input that runs again only permits an arm.
//! Invariant: nothing here waits, locks or, except to refuse an arm, allocates.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::action::{Order, Trip};
use crate::time::Stamp;

/// Stops of a rig, at most.
pub const MAX_STOPS: usize = 16;

/// An input that has stopped, or was lost, runs again after this at the earliest.
pub const SETTLES_IN: Duration = Duration::from_millis(100);

/// What an input stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StopKind {
    /// An emergency stop: the joints stop as each is configured, and stay stopped until an arm.
    Emergency,
    /// A switch that has to be held: released, the actuator is disarmed.
    Enabling,
}

impl StopKind {
    /// Its kind, as text for the user.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Emergency => "emergency stop",
            Self::Enabling => "enabling switch",
        }
    }

    /// The state of an input of this kind, as text for the user.
    pub const fn word(self, state: InputState) -> &'static str {
        match (self, state) {
            (_, InputState::Lost) => "lost",
            (Self::Emergency, InputState::Stopped) => "pressed",
            (Self::Emergency, InputState::Runs) | (Self::Enabling, InputState::Stopped) => "released",
            (Self::Enabling, InputState::Runs) => "held",
        }
    }
}

/// The state that an input reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InputState {
    /// The actuator may move.
    Runs,
    /// It may not move.
    Stopped,
    /// Unknown: it is unplugged, silent, or cannot be read.
    Lost,
}

/// The input that prevents the actuator from being armed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Blocked {
    /// Its position in the registry.
    pub index: usize,
    /// Its name.
    pub stop: Arc<str>,
    /// Its kind.
    pub kind: StopKind,
    /// Its state.
    pub state: InputState,
}

impl std::error::Error for Blocked {}

impl std::fmt::Display for Blocked {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (kind, name, word) = (self.kind.label(), &self.stop, self.kind.word(self.state));
        let remedy = match (self.kind, self.state) {
            (_, InputState::Lost) => "restore it, the log names the cause",
            (StopKind::Emergency, _) => "release it",
            (StopKind::Enabling, _) => "hold it",
        };
        write!(f, "{kind} {name} is {word}: {remedy}, then arm again")
    }
}

/// See the module's comment.
#[derive(Debug, Default)]
pub struct Interlocks {
    all: Box<[Interlock]>,
    names: Arc<[Arc<str>]>,
}

#[derive(Debug)]
struct Interlock {
    kind: StopKind,
    /// Its state in the lowest two bits, and above them when it was last reported not to run, 0 before the first time. One
    /// word: an input that is lost while another thread finds that it runs is not overwritten.
    reported: AtomicU64,
}

impl Interlock {
    fn load(&self) -> Reported {
        Reported(self.reported.load(Ordering::SeqCst))
    }
}

/// The value of [`Interlock::reported`]. Nanoseconds of the monotonic clock need 62 bits in 146 years.
#[derive(Clone, Copy)]
struct Reported(u64);

const RUNS: u64 = 0;
const STOPPED: u64 = 1;
const LOST: u64 = 2;
const UNREPORTED: u64 = 3;

impl Reported {
    const fn new(code: u64, stopped: u64) -> Self {
        Self(stopped << 2 | code)
    }

    const fn code(self) -> u64 {
        self.0 & 3
    }

    const fn stopped(self) -> u64 {
        self.0 >> 2
    }

    const fn state(self) -> InputState {
        match self.code() {
            RUNS => InputState::Runs,
            STOPPED => InputState::Stopped,
            _ => InputState::Lost,
        }
    }
}

impl Interlocks {
    /// Stops with these names, [`MAX_STOPS`] at most.
    pub fn new<'a>(stops: impl Iterator<Item = (&'a str, StopKind)>) -> Self {
        let (names, all): (Vec<Arc<str>>, Vec<_>) =
            stops.map(|(name, kind)| (name.into(), Interlock { kind, reported: AtomicU64::new(UNREPORTED) })).unzip();
        Self { all: all.into(), names: names.into() }
    }

    /// Names of the stops.
    pub const fn names(&self) -> &Arc<[Arc<str>]> {
        &self.names
    }

    /// The state of an input.
    pub fn state(&self, index: usize) -> InputState {
        self.all.get(index).map_or(InputState::Lost, |one| one.load().state())
    }

    /// Checks that every input runs.
    ///
    /// # Errors
    /// With the first that does not.
    pub fn check(&self) -> Result<(), Blocked> {
        let states = self.all.iter().map(|one| one.load().state()).enumerate();
        let Some((index, state)) = states.into_iter().find(|(_, state)| *state != InputState::Runs) else {
            return Ok(());
        };
        let kind = self.all.get(index).map_or(StopKind::Emergency, |one| one.kind);
        Err(Blocked { index, stop: self.names.get(index).cloned().unwrap_or_default(), kind, state })
    }

    /// Stores the state of an input. Returns whether it has changed.
    pub fn set(&self, index: usize, state: InputState, now: Stamp) -> bool {
        let code = match state {
            InputState::Runs => RUNS,
            InputState::Stopped => STOPPED,
            InputState::Lost => LOST,
        };
        let Some(one) = self.all.get(index) else { return false };
        let next = |before: u64| {
            let stopped = Reported(before).stopped();
            if code != RUNS {
                // The later one of two threads may be the first here.
                return Some(Reported::new(code, stopped.max(now.0).max(1)).0);
            }
            let has_settled = stopped == 0 || now.since(Stamp(stopped)) >= SETTLES_IN;
            has_settled.then(|| Reported::new(RUNS, stopped).0)
        };
        let before = one.reported.fetch_update(Ordering::SeqCst, Ordering::SeqCst, next);
        before.is_ok_and(|before| Reported(before).code() != code)
    }

    /// An input that has stopped, or was lost, after this time, whatever it reports now; an emergency stop before an enabling
    /// switch.
    pub fn stopped_after(&self, last: u64) -> Option<usize> {
        let is_after = |one: &Interlock| one.load().stopped() > last;
        let stopped = |kind| self.all.iter().position(|one| one.kind == kind && is_after(one));
        stopped(StopKind::Emergency).or_else(|| stopped(StopKind::Enabling))
    }

    /// The order that results from an input that does not run.
    pub fn order(&self, index: usize) -> Option<Order> {
        let trip =
            || Trip { stop: u8::try_from(index).unwrap_or(u8::MAX), is_lost: self.state(index) == InputState::Lost };
        Some(match self.all.get(index)?.kind {
            StopKind::Emergency => Order::Emergency(trip()),
            StopKind::Enabling => Order::Disarm,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::*;

    #[test]
    fn of_two_stops_the_later_one_counts_whichever_is_reported_first() {
        let interlocks = Interlocks::new([("stop", StopKind::Emergency)].into_iter());
        for at in [12, 10] {
            interlocks.set(0, InputState::Lost, Stamp(at));
        }
        assert_eq!([11, 12].map(|armed| interlocks.stopped_after(armed)), [Some(0), None]);
    }

    /// Whichever comes first: what runs at the moment of a loss has not settled.
    #[test]
    fn an_input_that_is_lost_at_the_moment_when_it_runs_is_lost() {
        let interlocks = Interlocks::new([("stop", StopKind::Emergency)].into_iter());
        let (begin, end) = (Barrier::new(2), Barrier::new(2));
        let at = |round: u64| Stamp(round * 1_000_000_000);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for round in 1..=20_000 {
                    begin.wait();
                    interlocks.set(0, InputState::Runs, at(round));
                    end.wait();
                }
            });
            let mut ran = 0;
            for round in 1..=20_000 {
                begin.wait();
                interlocks.set(0, InputState::Lost, at(round));
                end.wait();
                ran += u32::from(interlocks.state(0) != InputState::Lost);
            }
            assert_eq!(ran, 0, "of 20000 rounds, an arm was possible after the loss");
        });
    }
}
