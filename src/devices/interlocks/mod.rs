//! Emergency stops and enabling switches: what follows from their inputs.
//!
//! The inputs are read by the threads of [`crate::inputs`]. The state of an input goes to the run's [`Permission`], which
//! gives the orders, then to [`rapid_status::stops`], from which an episode takes those of its beginning, and to the board.
//!
//! Invariant: the order is given before anything is shown or logged.
//! Invariant: an input that is lost does not run.
//! Invariant: what is shown and recorded last is what was ordered last, whichever thread reports.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rapid_core::interlock::{InputState, Interlocks};
use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_registry::Registry;
use rapid_status::stops::Reported;
use rapid_status::{Board, EventKind, StopStatus};

use crate::inputs::tap::Tap;
use crate::inputs::{InputGroup, Readers, Report};

/// The stops of a registry, none of which runs.
pub fn from_registry(registry: &Registry) -> Interlocks {
    Interlocks::new(registry.stops.iter().map(|stop| (stop.name.as_str(), stop.kind)))
}

/// Reads the inputs until it is dropped.
#[derive(Debug)]
pub struct Watched {
    readers: Readers,
    is_ending: Arc<AtomicBool>,
}

impl Watched {
    /// Reads the inputs of `registry` from now on, for `permission` and `reported`, which were created from the same registry.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub fn begin(
        registry: &Registry,
        permission: &Arc<Permission>,
        reported: &Reported,
        board: &Arc<Board>,
    ) -> io::Result<Self> {
        let mut watched = Self { readers: Readers::new(true)?, is_ending: Arc::default() };
        for (index, spec) in registry.stops.iter().enumerate() {
            let input = Reporter {
                index,
                permission: Arc::clone(permission),
                reported: reported.clone(),
                board: Arc::clone(board),
                is_ending: Arc::clone(&watched.is_ending),
            };
            let place = InputGroup::from_spec(&spec.input);
            if let InputGroup::Field(field) = &place {
                // Before any sample can come.
                input.lost(&format!("no sample of {} has come", field.device));
            }
            watched.readers.read(&format!("stop-{}", spec.name), place, Arc::new(input))?;
        }
        Ok(watched)
    }

    /// The run ends and its devices are closed: missing numbers of theirs are not reported. They stop the actuator as
    /// before.
    pub fn end(&self) {
        self.is_ending.store(true, Ordering::Relaxed);
    }

    /// The inputs that are numbers in the samples of a device.
    pub fn taps(&self) -> &[Tap] {
        self.readers.taps()
    }
}

/// Receives the state of one input.
#[derive(Debug, Clone)]
struct Reporter {
    index: usize,
    permission: Arc<Permission>,
    reported: Reported,
    board: Arc<Board>,
    /// See [`Watched::end`].
    is_ending: Arc<AtomicBool>,
}

impl Reporter {
    /// `why` it is lost, if it is.
    fn report(&self, state: InputState, why: &str) {
        let is_news = self.permission.report(self.index, state, Stamp::now());
        if !is_news || self.is_ending.load(Ordering::Relaxed) {
            return;
        }
        // Under the lock: what is noted is shown in the same order.
        self.reported.update(self.index, |noted| {
            let stop = StopStatus { state, detail: why.to_owned(), ..noted.clone() };
            if self.permission.state(self.index) == state {
                noted.clone_from(&stop);
                self.board.set_stop(stop);
            } else {
                // Another thread has reported since, and notes it: this is only what has happened.
                self.board.announce(EventKind::Stop(stop));
            }
        });
    }
}

impl Report for Reporter {
    fn level(&self, _: usize, is_on: bool) {
        self.report(if is_on { InputState::Runs } else { InputState::Stopped }, "");
    }

    fn lost(&self, why: &str) {
        self.report(InputState::Lost, why);
    }
}

#[cfg(test)]
mod tests;
