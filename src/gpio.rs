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
use gpiocdev::line::{Bias, EdgeDetection, EdgeKind, Value};
use gpiocdev_uapi::v2::{LineValues, set_line_values};

use crate::text;

/// A line whose chip reports no edges is read again after this: a chip on USB takes about 1 ms.
const POLL: Duration = Duration::from_millis(5);
/// Any other one, because the kernel leaves out edges for which it has no room.
const LOOK: Duration = Duration::from_millis(50);

/// A line that is read.
#[derive(Debug)]
pub struct Input {
    request: Request,
    shown: String,
    line: u32,
    has_edges: bool,
}

impl Input {
    /// Opens `line` of `chip`, pulled to the level `pulled_high` where the chip can.
    ///
    /// # Errors
    /// Why it cannot be opened, for people.
    pub fn open(chip: &Path, line: u32, pulled_high: bool) -> Result<Self, String> {
        let shown = chip.display().to_string();
        let bias = if pulled_high { Bias::PullUp } else { Bias::PullDown };
        let request = |edges: Option<EdgeDetection>| {
            let mut builder = Request::builder();
            builder.on_chip(chip).with_consumer("rapid").with_line(line).as_input();
            builder.with_bias(bias).with_edge_detection(edges).request()
        };
        let with_edges = request(Some(EdgeDetection::BothEdges));
        let has_edges = with_edges.is_ok();
        // Chips on USB have no interrupts: of those the kernel refuses edges, and nothing else.
        let opened = with_edges.or_else(|_| request(None));
        Ok(Self { request: opened.map_err(|error| why(&shown, &error))?, shown, line, has_edges })
    }

    /// Readable when there is something to take, where the chip reports edges.
    #[must_use]
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.request.as_fd()
    }

    /// How long after a call of [`Self::take`] the next one is due at the latest.
    #[must_use]
    pub const fn poll_after(&self) -> Duration {
        if self.has_edges { LOOK } else { POLL }
    }

    /// Reports every level that the line has had since the last call, as far as the chip reports them, and the one of
    /// now, without waiting. `true` is high.
    ///
    /// # Errors
    /// When it cannot be read any more, for people.
    pub fn take(&mut self, report: &mut dyn FnMut(bool)) -> Result<(), String> {
        let Self { request, shown, line, has_edges } = self;
        let failed = |error: gpiocdev::Error| why(shown, &error);
        while *has_edges && request.has_edge_event().map_err(failed)? {
            report(request.read_edge_event().map_err(failed)?.kind == EdgeKind::Rising);
        }
        report(request.value(*line).map_err(failed)? == Value::Active);
        Ok(())
    }
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
