//! A line of a GPIO chip.
//!
//! The line is pulled to the level that stops: where its wire is broken, it stops. Chips without resistors of their own
//! need one beside the contact.

use std::os::fd::{AsFd as _, BorrowedFd};

use gpiocdev::Request;
use gpiocdev::line::{Bias, EdgeDetection, EdgeKind, Value};

use super::source::{failure, state};
use crate::interlock::InputState;
use crate::registry::GpioInput;

/// A line that is ours.
#[derive(Debug)]
pub(super) struct Gpio {
    request: Request,
    shown: String,
    line: u32,
    runs_while_high: bool,
}

impl Gpio {
    pub(super) fn open(spec: &GpioInput) -> Result<Self, String> {
        let shown = spec.chip.display().to_string();
        let bias = if spec.runs_while_high { Bias::PullDown } else { Bias::PullUp };
        let mut builder = Request::builder();
        builder.on_chip(&spec.chip).with_consumer("rapid").with_line(spec.line).as_input();
        let request = builder.with_bias(bias).with_edge_detection(EdgeDetection::BothEdges).request();
        let request = request.map_err(|error| say(&shown, &error))?;
        Ok(Self { request, shown, line: spec.line, runs_while_high: spec.runs_while_high })
    }

    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        self.request.as_fd()
    }

    pub(super) fn take(&mut self, is_first: bool, tell: &mut dyn FnMut(InputState)) -> Result<(), String> {
        let Self { request, shown, line, runs_while_high } = self;
        let failed = |error: gpiocdev::Error| say(shown, &error);
        let mut has_changed = is_first;
        while request.has_edge_event().map_err(failed)? {
            let edge = request.read_edge_event().map_err(failed)?;
            tell(state(edge.kind == EdgeKind::Rising, *runs_while_high));
            has_changed = true;
        }
        // The kernel leaves out edges for which it has no room.
        if has_changed {
            tell(state(request.value(*line).map_err(failed)? == Value::Active, *runs_while_high));
        }
        Ok(())
    }
}

/// Why the kernel refused, for people.
fn say(shown: &str, error: &gpiocdev::Error) -> String {
    match error {
        gpiocdev::Error::Os(error) => failure(shown, "gpio", &std::io::Error::from_raw_os_error(error.0)),
        error => format!("{shown}: {error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chip_that_is_not_there_or_none_is_named() {
        let why =
            |chip: &str| Gpio::open(&GpioInput { chip: chip.into(), line: 1, runs_while_high: false }).unwrap_err();
        assert_eq!(why("/dev/gpiochip_none"), "/dev/gpiochip_none is not plugged in");
        assert!(why("/dev/null").contains("/dev/null"), "{}", why("/dev/null"));
    }
}
