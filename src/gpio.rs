//! Lines of GPIO chips: inputs and outputs over the kernel's character devices (`linux/gpio.h`, version 2).
//!
//! Invariant: a line is ours alone while it is open; another program, and a second open here, are refused.
//! Invariant: an open line that cannot be read or set any more is an error: its chip was unplugged, or hangs.

use std::fs::File;
use std::io;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use gpiocdev::Request;
use gpiocdev::line::{Bias, Value};
use gpiocdev_uapi::v2::{LineValues, set_line_values};
use rustix::io::Errno;
use rustix::pipe::{PipeFlags, pipe_with};

use crate::realtime::{CONTROL_PRIORITY, use_fifo};
use crate::text;

/// A line is read again after this: a chip on USB takes about 1 ms.
const POLL: Duration = Duration::from_millis(5);

/// A line that is read.
///
/// A thread asks for its level, because a chip that hangs lets it wait for seconds; and asks again and again, because no
/// event says that a chip hangs, and those on USB report no edges.
#[derive(Debug)]
pub struct Input {
    shown: String,
    /// A byte each time that the thread was answered, 0 or 1. The thread ends when this is dropped, or with an error, which
    /// it sends as text behind a byte [`FAILED`].
    levels: OwnedFd,
}

const FAILED: u8 = 2;

impl Input {
    /// Without a level for this long the chip does not answer; so long it may take on a machine that is busy with other
    /// things.
    pub const SILENCE: Duration = Duration::from_millis(200);

    /// Opens `line` of `chip`, pulled to the level `pulled_high` where the chip can.
    ///
    /// # Errors
    /// Why it cannot be opened, for people.
    pub fn open(chip: &Path, line: u32, pulled_high: bool) -> Result<Self, String> {
        let shown = chip.display().to_string();
        let bias = if pulled_high { Bias::PullUp } else { Bias::PullDown };
        let mut builder = Request::builder();
        builder.on_chip(chip).with_consumer("rapid").with_line(line).as_input().with_bias(bias);
        let request = builder.request().map_err(|error| why(&shown, &error))?;
        let levels = ask(request, line, shown.clone()).map_err(|error| format!("{shown}: {error}"))?;
        Ok(Self { shown, levels })
    }

    /// Readable when there is something to take.
    #[must_use]
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.levels.as_fd()
    }

    /// Reports every level that was read since the last call, without waiting. `true` is high.
    ///
    /// # Errors
    /// When it cannot be read any more, for people.
    pub fn take(&mut self, report: &mut dyn FnMut(bool)) -> Result<(), String> {
        take_asked(&self.levels, &self.shown, report)
    }
}

fn take_asked(levels: &OwnedFd, shown: &str, report: &mut dyn FnMut(bool)) -> Result<(), String> {
    let mut bytes = [0; 256];
    loop {
        let count = match rustix::io::read(levels, &mut bytes) {
            Ok(0) => return Err(format!("{shown} is read no more")),
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

/// Starts the thread that asks for the levels of a line, every [`POLL`].
fn ask(request: Request, line: u32, shown: String) -> io::Result<OwnedFd> {
    let (levels, out) = pipe_with(PipeFlags::CLOEXEC | PipeFlags::NONBLOCK)?;
    let work = move || {
        // Without the right to it, the motors' thread warns.
        let _ = use_fifo(CONTROL_PRIORITY);
        loop {
            let (message, is_end) = match request.value(line) {
                Ok(level) => (vec![u8::from(level == Value::Active)], false),
                Err(error) => ([&[FAILED], why(&shown, &error).as_bytes()].concat(), true),
            };
            // Of one that nothing is taken from, what comes out is old, and what is new follows.
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

/// A line that is driven. Another process may hold it too: see [`Output::of`].
#[derive(Debug)]
pub struct Output(File);

impl Output {
    /// Opens `line` of `chip`, and drives it to a level.
    ///
    /// # Errors
    /// Why it cannot be opened, for people.
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
    #[must_use]
    pub fn of(descriptor: OwnedFd) -> Self {
        Self(File::from(descriptor))
    }

    /// What another process needs for [`Self::of`].
    #[must_use]
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }

    /// Drives it to a level. Waits for a chip on USB.
    ///
    /// # Errors
    /// When the kernel cannot.
    pub fn set(&self, is_high: bool) -> io::Result<()> {
        set_line_values(&self.0, &LineValues::from_slice(&[is_high])).map_err(|error| match error {
            gpiocdev_uapi::Error::Os(error) => io::Error::from_raw_os_error(error.0),
            error @ gpiocdev_uapi::Error::UnderRead(_) => io::Error::other(error),
        })
    }
}

/// Why the kernel refused, for people.
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
    fn a_chip_that_is_not_there_or_none_is_named() {
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
    fn a_descriptor_that_is_no_line_cannot_be_set() {
        let output = Output::of(File::open("/dev/null").unwrap().into());
        assert!(output.set(true).is_err());
    }
}
