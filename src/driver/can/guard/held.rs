//! Lines of brakes that the guard holds.

use std::os::fd::OwnedFd;
use std::thread::JoinHandle;
use std::time::Duration;

use crate::gpio::Output;

/// A line that cannot be set is retried this many times...
const TRIES: usize = 200;
/// ...at this interval.
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
    is_engaged: bool,
}

impl Held {
    /// The line of these motors was opened, or closed.
    pub(super) fn take(&mut self, motors: u16, engaged_high: bool, descriptor: Option<OwnedFd>) {
        self.lines.retain(|line| line.motors != motors);
        self.lines.extend(descriptor.map(|descriptor| Line { motors, engaged_high, descriptor, is_engaged: false }));
    }

    /// Engages those brakes of these motors that are not engaged yet. A chip that hangs must not delay the frames of
    /// motors: each has its own thread.
    pub(super) fn engage(&mut self, motors: u16) {
        for line in &mut self.lines {
            let was_engaged = std::mem::replace(&mut line.is_engaged, line.motors & motors != 0);
            if was_engaged || !line.is_engaged {
                continue;
            }
            let Ok(descriptor) = line.descriptor.try_clone() else {
                line.is_engaged = false;
                continue;
            };
            let (output, level) = (Output::of(descriptor), line.engaged_high);
            let set = move || {
                let mut tries = 0..TRIES;
                while tries.next().is_some() && output.set(level).is_err() {
                    std::thread::sleep(AGAIN);
                }
            };
            match std::thread::Builder::new().spawn(set) {
                Ok(setting) => self.setting.push(setting),
                Err(_) => line.is_engaged = false,
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
