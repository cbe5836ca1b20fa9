//! A number in the samples of a device that is an emergency stop or an enabling switch.
//!
//! The stream of the device looks at each sample before it publishes it; the thread of the tap sleeps until the number has
//! been missing for too long.
//!
//! Invariant: to look at a sample that says the same as the one before takes no lock and no memory.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rustix::event::{EventfdFlags, eventfd};

use super::Reporter;
use super::watch::{Woken, wait};
use crate::interlock::InputState;
use crate::registry::{Bound, FieldInput};
use crate::sample::Encoding;
use crate::time::Stamp;

/// See the module's comment.
#[derive(Debug, Clone)]
pub struct Tap(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    device: String,
    index: usize,
    runs: Bound,
    silence: Duration,
    reporter: Reporter,
    /// When the newest sample came; 0 while the input is lost.
    heard: AtomicU64,
    /// Wakes the thread with the first sample after a loss.
    found: OwnedFd,
}

impl Tap {
    pub(super) fn new(spec: &FieldInput, reporter: Reporter) -> std::io::Result<Self> {
        Ok(Self(Arc::new(Inner {
            device: spec.device.clone(),
            index: spec.index,
            runs: spec.runs,
            silence: spec.silence,
            reporter,
            heard: AtomicU64::new(0),
            found: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?,
        })))
    }

    /// Name of the device whose samples are looked at.
    #[must_use]
    pub fn device(&self) -> &str {
        &self.0.device
    }

    /// A sample came.
    pub fn look(&self, encoding: Encoding, bytes: &[u8]) {
        let tap = &*self.0;
        let Some(value) = (encoding == Encoding::F64).then(|| number(bytes, tap.index)).flatten() else {
            self.lose("its sample does not hold the number");
            return;
        };
        if tap.heard.swap(Stamp::now().0.max(1), Ordering::SeqCst) == 0 {
            // Room for a number is always there.
            let _ = rustix::io::write(&tap.found, &1_u64.to_ne_bytes());
        }
        tap.reporter.report(if tap.runs.holds(value) { InputState::Runs } else { InputState::Stopped }, "");
    }

    /// Nothing comes any more.
    pub fn lose(&self, why: &str) {
        self.0.heard.store(0, Ordering::SeqCst);
        self.0.reporter.report(InputState::Lost, why);
    }

    /// Reports the input lost when it is silent, until `stop`.
    pub(super) fn watch(&self, stop: &OwnedFd) {
        let _lost = self.0.reporter.lost_at_a_panic();
        let tap = &*self.0;
        loop {
            let heard = tap.heard.load(Ordering::SeqCst);
            let wake = (heard > 0).then(|| Stamp(heard).after(tap.silence));
            match wait(stop, Some(&tap.found), wake) {
                Woken::Stop => return,
                Woken::Ready(_) => {
                    let _ = rustix::io::read(&tap.found, &mut [0; 8]);
                }
                // Unless a sample came meanwhile.
                Woken::Late if tap.heard.load(Ordering::SeqCst) == heard => {
                    self.lose(&format!("no sample of {} for {:?}", tap.device, tap.silence));
                }
                Woken::Late => {}
            }
        }
    }
}

fn number(bytes: &[u8], index: usize) -> Option<f64> {
    let (numbers, _) = bytes.as_chunks::<8>();
    numbers.get(index).map(|number| f64::from_le_bytes(*number))
}

/// Loses what is tapped when it is dropped.
#[must_use]
pub fn lost_at_the_end(taps: &Arc<[Tap]>) -> impl Drop + use<> {
    Lost(Arc::clone(taps))
}

struct Lost(Arc<[Tap]>);

impl Drop for Lost {
    fn drop(&mut self) {
        for tap in &*self.0 {
            tap.lose(&format!("{} is no longer read", tap.device()));
        }
    }
}
