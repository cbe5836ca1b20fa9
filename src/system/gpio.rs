//! Lines of GPIO chips: inputs and outputs over the kernel's character devices (`linux/gpio.h`, version 2).
//!
//! Invariant: a line belongs to this process alone while it is open; another program, and a second open here, are
//! refused. Invariant: an open line that can no longer be read or set is an error: its chip was unplugged, or hangs.

use std::fs::File;
use std::io;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use gpiocdev::Request;
use gpiocdev::line::{Bias, Value};
use gpiocdev_uapi::v2::{LineValues, get_line_values, set_line_values};
use rapid_core::text;
use rapid_core::time::Stamp;
use rustix::io::Errno;
use rustix::pipe::{PipeFlags, pipe_with};

use crate::realtime::{CONTROL_PRIORITY, use_fifo};

/// A line is read again after this: a chip on USB takes about 1 ms.
const POLL: Duration = Duration::from_millis(5);

/// How long a line that is set may still have its former level: the edge of a loaded line is slow.
const EDGE: Duration = Duration::from_millis(5);

/// A line that is read.
///
/// A thread reads its level, because a hanging chip blocks a read for seconds; and it polls, because no event reports
/// that a chip hangs, and those on USB report no edges.
#[derive(Debug)]
pub struct Input {
    shown: String,
    /// A byte per level read by the thread, 0 or 1. The thread ends when this is dropped, or with an error, which it
    /// sends as text after a byte [`FAILED`].
    levels: OwnedFd,
}

const FAILED: u8 = 2;

impl Input {
    /// Without a level for this long the chip is considered not to answer; on a busy machine an answer may take nearly
    /// this long.
    pub const SILENCE: Duration = Duration::from_millis(200);

    /// Opens `line` of `chip`, biased to the level `pulled_high` where the chip can.
    ///
    /// # Errors
    /// Why it cannot be opened, as text for the user.
    pub fn open(chip: &Path, line: u32, pulled_high: bool) -> Result<Self, String> {
        let shown = chip.display().to_string();
        let bias = if pulled_high { Bias::PullUp } else { Bias::PullDown };
        let mut builder = Request::builder();
        builder.on_chip(chip).with_consumer("rapid").with_line(line).as_input().with_bias(bias);
        let request = builder.request().map_err(|error| why(&shown, &error))?;
        let levels = poll_levels(request, line, shown.clone()).map_err(|error| format!("{shown}: {error}"))?;
        Ok(Self { shown, levels })
    }

    /// Readable when there is something to take.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.levels.as_fd()
    }

    /// Reports every level that was read since the last call, without waiting. `true` is high.
    ///
    /// # Errors
    /// When it can no longer be read, as text for the user.
    pub fn drain(&mut self, report: &mut dyn FnMut(bool)) -> Result<(), String> {
        take_levels(&self.levels, &self.shown, report)
    }
}

fn take_levels(levels: &OwnedFd, shown: &str, report: &mut dyn FnMut(bool)) -> Result<(), String> {
    let mut bytes = [0; 256];
    loop {
        let count = match rustix::io::read(levels, &mut bytes) {
            Ok(0) => return Err(format!("{shown} is no longer read")),
            Ok(count) => count,
            Err(Errno::AGAIN) => return Ok(()),
            Err(Errno::INTR) => continue,
            Err(error) => return Err(format!("{shown}: {error}")),
        };
        for (at, byte) in bytes.iter().enumerate().take(count) {
            if *byte == FAILED {
                return Err(String::from_utf8_lossy(bytes.get(at + 1..count).unwrap_or_default()).into_owned());
            }
            report(*byte == 1);
        }
    }
}

/// Starts the thread that reads the levels of a line, every [`POLL`].
fn poll_levels(request: Request, line: u32, shown: String) -> io::Result<OwnedFd> {
    let (levels, out) = pipe_with(PipeFlags::CLOEXEC | PipeFlags::NONBLOCK)?;
    let work = move || {
        // Without the privilege for it, the motors' thread warns.
        let _ = use_fifo(CONTROL_PRIORITY);
        loop {
            let (message, is_end) = match request.value(line) {
                Ok(level) => (vec![u8::from(level == Value::Active)], false),
                Err(error) => ([&[FAILED], why(&shown, &error).as_bytes()].concat(), true),
            };
            // If the pipe is full its oldest levels are read first, and newer ones follow.
            let sent = rustix::io::write(&out, &message);
            if is_end || matches!(sent, Err(error) if error != Errno::AGAIN) {
                return;
            }
            std::thread::sleep(POLL);
        }
    };
    std::thread::Builder::new().name("gpio".to_owned()).spawn(work)?;
    Ok(levels)
}

/// A line that is driven. Another process may hold it too: see [`Output::from_descriptor`].
#[derive(Debug)]
pub struct Output(File);

impl Output {
    /// Opens `line` of `chip`, and drives it to a level.
    ///
    /// # Errors
    /// Why it cannot be opened, as text for the user.
    pub fn open(chip: &Path, line: u32, is_high: bool) -> Result<Self, String> {
        let shown = chip.display().to_string();
        let level = if is_high { Value::Active } else { Value::Inactive };
        let mut builder = Request::builder();
        builder.on_chip(chip).with_consumer("rapid").with_line(line).as_output(level);
        let request = builder.request().map_err(|error| why(&shown, &error))?;
        let held = request.as_fd().try_clone_to_owned().map_err(|error| format!("{shown}: {error}"))?;
        Ok(Self(File::from(held)))
    }

    /// A line that another process has opened, and keeps open for as long as this is.
    pub fn from_descriptor(descriptor: OwnedFd) -> Self {
        Self(File::from(descriptor))
    }

    /// The descriptor that another process needs for [`Self::from_descriptor`].
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }

    /// Drives it to a level, and reads it back: before Linux 6.15 a driver cannot report that its chip refused the level
    /// or is gone (`set` of `struct gpio_chip` returns nothing). Waits for a chip on USB.
    ///
    /// # Errors
    /// When the line cannot be set or read, or has the other level.
    pub fn set(&self, is_high: bool) -> io::Result<()> {
        set_line_values(&self.0, &LineValues::from_slice(&[is_high])).map_err(os_error)?;
        let set_at = Stamp::now();
        while self.level()? != Some(is_high) {
            if Stamp::now().since(set_at) > EDGE {
                let word = |is_high: bool| if is_high { "high" } else { "low" };
                let text = format!("it is {} although it was set to {}", word(!is_high), word(is_high));
                return Err(io::Error::other(text));
            }
        }
        Ok(())
    }

    /// The level of the line itself, where its chip can read it.
    fn level(&self) -> io::Result<Option<bool>> {
        let mut level = LineValues::from_slice(&[false]);
        get_line_values(&self.0, &mut level).map_err(os_error)?;
        Ok(level.get(0))
    }
}

fn os_error(error: gpiocdev_uapi::Error) -> io::Error {
    match error {
        gpiocdev_uapi::Error::Os(error) => io::Error::from_raw_os_error(error.0),
        error @ gpiocdev_uapi::Error::UnderRead(_) => io::Error::other(error),
    }
}

/// Why the kernel refused, as text for the user.
fn why(shown: &str, error: &gpiocdev::Error) -> String {
    match error {
        gpiocdev::Error::Os(error) => text::not_opened(shown, "gpio", &io::Error::from_raw_os_error(error.0)),
        error => format!("{shown}: {error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_or_invalid_chip_is_named() {
        for opened in [
            |chip: &str| Input::open(Path::new(chip), 1, false).map(|_| ()),
            |chip: &str| Output::open(Path::new(chip), 1, false).map(|_| ()),
        ] {
            assert_eq!(opened("/dev/gpiochip_none").unwrap_err(), "/dev/gpiochip_none is not plugged in");
            let why = opened("/dev/null").unwrap_err();
            assert!(why.contains("/dev/null"), "{why}");
        }
    }

    #[test]
    fn a_descriptor_that_is_not_a_line_cannot_be_set() {
        let output = Output::from_descriptor(File::open("/dev/null").unwrap().into());
        assert!(output.set(true).is_err());
    }
}
