//! Lines of brakes that the guard holds.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_system::gpio::Output;

/// A line that cannot be set is retried for this long...
const RETRIED_FOR: Duration = Duration::from_secs(2);
/// ...at this interval, until it is no longer to be engaged.
const AGAIN: Duration = Duration::from_millis(10);

/// See the module's comment. Dropping waits until the requested lines are set.
#[derive(Debug, Default)]
pub(super) struct Held {
    lines: Vec<Line>,
    setting: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Line {
    /// Bits of its motors.
    motors: u16,
    engaged_high: bool,
    descriptor: OwnedFd,
    /// Engaged, or about to be.
    is_engaged: Arc<AtomicBool>,
}

impl Drop for Line {
    fn drop(&mut self) {
        self.is_engaged.store(false, Ordering::SeqCst);
    }
}

impl Held {
    /// The line of these motors was opened, or closed.
    pub(super) fn set_line(&mut self, motors: u16, engaged_high: bool, descriptor: Option<OwnedFd>) {
        self.lines.retain(|line| line.motors != motors);
        let line = |descriptor| Line { motors, engaged_high, descriptor, is_engaged: Arc::default() };
        self.lines.extend(descriptor.map(line));
    }

    /// Engages those brakes of these motors that are not engaged yet. A chip that hangs must not delay the frames of
    /// motors: each has its own thread.
    pub(super) fn engage(&mut self, motors: u16) {
        for line in &mut self.lines {
            let engages = line.motors & motors != 0;
            if line.is_engaged.swap(engages, Ordering::SeqCst) || !engages {
                continue;
            }
            let Ok(descriptor) = line.descriptor.try_clone() else {
                line.is_engaged.store(false, Ordering::SeqCst);
                continue;
            };
            let (output, level) = (Output::from_descriptor(descriptor), line.engaged_high);
            let (is_wanted, end) = (Arc::clone(&line.is_engaged), Stamp::now().after(RETRIED_FOR));
            let set = move || {
                while is_wanted.load(Ordering::SeqCst) && output.set(level).is_err() && Stamp::now() < end {
                    std::thread::sleep(AGAIN);
                }
            };
            match std::thread::Builder::new().spawn(set) {
                Ok(setting) => self.setting.push(setting),
                Err(_) => line.is_engaged.store(false, Ordering::SeqCst),
            }
        }
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        for setting in self.setting.drain(..) {
            let _ = setting.join();
        }
    }
}
