//! A line of a GPIO chip.
//!
//! The line is biased to the level at which the input is off: with a broken wire it is off. Chips without bias resistors
//! need an external one at the contact.

use std::os::fd::BorrowedFd;

use rapid_registry::GpioInput;
use rapid_system::gpio::Input;

/// A line that this process holds.
#[derive(Debug)]
pub(super) struct Gpio {
    input: Input,
    on_while_high: bool,
}

impl Gpio {
    pub(super) fn open(spec: &GpioInput) -> Result<Self, String> {
        let input = Input::open(&spec.chip, spec.line, !spec.on_while_high)?;
        Ok(Self { input, on_while_high: spec.on_while_high })
    }

    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        self.input.fd()
    }

    pub(super) fn drain(&mut self, report: &mut dyn FnMut(usize, bool)) -> Result<(), String> {
        let on_while_high = self.on_while_high;
        self.input.drain(&mut |is_high| report(0, is_high == on_while_high))
    }
}
