//! A number in the samples of a device that is an input.
//!
//! The stream of the device evaluates each sample before it publishes it; the thread of the tap sleeps until the number
//! has been missing for too long.
//!
//! Invariant: a sample with the same level as the one before is evaluated without a lock and without allocation.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use rapid_registry::{Bound, FieldInput};
use rustix::event::{EventfdFlags, eventfd};

use super::watch::{Woken, wait};
use super::{Report, lost_at_a_panic};

/// See the module's comment.
#[derive(Debug, Clone)]
pub struct Tap(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    device: String,
    index: usize,
    on: Bound,
    off: Option<Bound>,
    silence: Duration,
    report: Arc<dyn Report>,
    /// When the newest sample arrived; 0 while the input is lost.
    received_at: AtomicU64,
    /// Wakes the thread with the first sample after a loss.
    found: OwnedFd,
}

impl Tap {
    pub(super) fn new(spec: &FieldInput, report: Arc<dyn Report>) -> std::io::Result<Self> {
        Ok(Self(Arc::new(Inner {
            device: spec.device.clone(),
            index: spec.index,
            on: spec.on,
            off: spec.off,
            silence: spec.silence,
            report,
            received_at: AtomicU64::new(0),
            found: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?,
        })))
    }

    /// Name of the device whose samples are evaluated.
    pub fn device(&self) -> &str {
        &self.0.device
    }

    /// A sample has arrived.
    pub fn feed(&self, encoding: Encoding, bytes: &[u8]) {
        let tap = &*self.0;
        let Some(value) = (encoding == Encoding::F64).then(|| number(bytes, tap.index)).flatten() else {
            self.lose("its sample does not hold the number");
            return;
        };
        if tap.received_at.swap(Stamp::now().0.max(1), Ordering::SeqCst) == 0 {
            // An eventfd always has room for a number.
            let _ = rustix::io::write(&tap.found, &1_u64.to_ne_bytes());
        }
        let is_on = tap.on.holds(value);
        if is_on || tap.off.is_none_or(|off| off.holds(value)) {
            tap.report.level(0, is_on);
        }
    }

    /// No samples arrive any more.
    pub fn lose(&self, why: &str) {
        self.0.received_at.store(0, Ordering::SeqCst);
        self.0.report.lost(why);
    }

    /// Reports the input lost when it is silent, until `stop`.
    pub(super) fn watch(&self, stop: &OwnedFd) {
        let _lost = lost_at_a_panic(&*self.0.report);
        let tap = &*self.0;
        loop {
            let received_at = tap.received_at.load(Ordering::SeqCst);
            let wake = (received_at > 0).then(|| Stamp(received_at).after(tap.silence));
            match wait(stop, Some(&tap.found), wake) {
                Woken::Stop => return,
                Woken::Ready(_) => {
                    let _ = rustix::io::read(&tap.found, &mut [0; 8]);
                }
                // Unless a sample arrived meanwhile.
                Woken::Late if tap.received_at.load(Ordering::SeqCst) == received_at => {
                    self.lose(&format!("no sample of {} for {:?}", tap.device, tap.silence));
                }
                Woken::Late => {}
            }
        }
    }
}

fn number(bytes: &[u8], index: usize) -> Option<f64> {
    let (numbers, _) = bytes.as_chunks::<8>();
    // One that is not finite is on no side of a limit: the input is lost, which stops.
    numbers.get(index).map(|number| f64::from_le_bytes(*number)).filter(|number| number.is_finite())
}

/// Reports the taps as lost when it is dropped.
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
