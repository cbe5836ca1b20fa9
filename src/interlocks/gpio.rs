//! A line of a GPIO chip.
//!
//! The line is biased to the level that stops: a broken wire is a stop. Chips without bias resistors need an external
//! one at the contact.

use std::os::fd::BorrowedFd;

use super::source::state;
use crate::gpio::Input;
use crate::interlock::InputState;
use crate::registry::GpioInput;

/// A line that this process holds.
#[derive(Debug)]
pub(super) struct Gpio {
    input: Input,
    runs_while_high: bool,
}

impl Gpio {
    pub(super) fn open(spec: &GpioInput) -> Result<Self, String> {
        let input = Input::open(&spec.chip, spec.line, !spec.runs_while_high)?;
        Ok(Self { input, runs_while_high: spec.runs_while_high })
    }

    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        self.input.fd()
    }

    pub(super) fn take(&mut self, report: &mut dyn FnMut(InputState)) -> Result<(), String> {
        let runs_while_high = self.runs_while_high;
        self.input.take(&mut |is_high| report(state(is_high, runs_while_high)))
    }
}
