//! Emergency stops and enabling switches: where their inputs are read.
//!
//! Each has a thread, which sleeps until the kernel has something to read or the input has been silent for too long;
//! for a number in the samples of a device the thread of [`tap`] only waits for silence, and the device's stream
//! evaluates the number. The state of an input goes to the run's [`Permission`], which gives the orders, and then to
//! the board.
//!
//! Invariant: the order is given before anything is shown or logged.
//! Invariant: an input is lost from the moment when it cannot be read until it reports that it runs: unplugged, silent,
//! held by another program, or read by a thread that panicked.

mod gpio;
mod key;
mod line;
mod source;
pub mod tap;
mod watch;

use std::io;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use rustix::event::{EventfdFlags, eventfd};

use crate::interlock::{InputState, Interlocks};
use crate::permission::Permission;
use crate::realtime::{CONTROL_PRIORITY, use_fifo};
use crate::registry::{InterlockInput, Registry};
use crate::status::Board;
use crate::time::Stamp;
use tap::Tap;

/// The stops of a registry, none of which runs.
pub fn of(registry: &Registry) -> Interlocks {
    Interlocks::new(registry.stops.iter().map(|stop| (stop.name.as_str(), stop.kind)))
}

/// Reads the inputs until it is dropped.
#[derive(Debug)]
pub struct Watched {
    stop: Arc<OwnedFd>,
    threads: Vec<JoinHandle<()>>,
    taps: Vec<Tap>,
    is_ending: Arc<AtomicBool>,
}

impl Watched {
    /// Reads the inputs of `registry` from now on, for `permission`, which was created from the same registry.
    ///
    /// # Errors
    /// When the system provides no thread.
    pub fn begin(registry: &Registry, permission: &Arc<Permission>, board: &Arc<Board>) -> io::Result<Self> {
        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC)?);
        let mut watched = Self { stop, threads: Vec::new(), taps: Vec::new(), is_ending: Arc::default() };
        for (index, spec) in registry.stops.iter().enumerate() {
            let reporter = Reporter {
                index,
                permission: Arc::clone(permission),
                board: Arc::clone(board),
                is_ending: Arc::clone(&watched.is_ending),
            };
            let stop = Arc::clone(&watched.stop);
            let begin = |work: Box<dyn FnOnce() + Send>| {
                // As much of the name as the kernel keeps.
                let name = format!("stop-{}", spec.name).chars().take(15).collect();
                std::thread::Builder::new().name(name).spawn(move || {
                    // Without the privilege for it, the motors' thread warns.
                    let _ = use_fifo(CONTROL_PRIORITY);
                    work();
                })
            };
            let thread = match spec.input.clone() {
                InterlockInput::Field(field) => {
                    let tap = Tap::new(&field, reporter)?;
                    // Before any sample can come.
                    tap.lose(&format!("no sample of {} has come", field.device));
                    watched.taps.push(tap.clone());
                    begin(Box::new(move || tap.watch(&stop)))?
                }
                input => begin(Box::new(move || watch::watch(&input, &reporter, &stop)))?,
            };
            watched.threads.push(thread);
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
        &self.taps
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        // An eventfd always has room for a number.
        let _ = rustix::io::write(&self.stop, &1_u64.to_ne_bytes());
        for thread in self.threads.drain(..) {
            // Its panic has been reported.
            let _ = thread.join();
        }
    }
}

/// Receives the state of one input.
#[derive(Debug, Clone)]
struct Reporter {
    index: usize,
    permission: Arc<Permission>,
    board: Arc<Board>,
    /// See [`Watched::end`].
    is_ending: Arc<AtomicBool>,
}

impl Reporter {
    /// `why` it is lost, if it is.
    fn report(&self, state: InputState, why: &str) {
        let is_news = self.permission.report(self.index, state, Stamp::now());
        if is_news && !self.is_ending.load(Ordering::Relaxed) {
            self.board.set_stop(self.index, state, why);
        }
    }

    /// Held by a thread or task: if it panics, the input is lost.
    fn lost_at_a_panic(&self) -> LostAtPanic<'_> {
        LostAtPanic(self)
    }
}

struct LostAtPanic<'a>(&'a Reporter);

impl Drop for LostAtPanic<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.report(InputState::Lost, "its thread panicked; please report this");
        }
    }
}

#[cfg(test)]
mod tests;
