//! An open place of any kind.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use rapid_system::gpio::Input;

use super::InputGroup;
use super::gpio::Gpio;
use super::key::{self, Keys};
use super::line::Lines;

#[derive(Debug)]
pub(super) enum InputSource {
    Keys(Box<Keys>),
    Gpio(Gpio),
    Lines(Lines),
}

impl InputSource {
    /// Opens it.
    ///
    /// # Errors
    /// Why it cannot be opened, as text for the user.
    pub(super) fn open(place: &InputGroup) -> Result<Self, String> {
        match place {
            InputGroup::Keys(keys) => Ok(Self::Keys(Box::new(Keys::open(keys)?))),
            InputGroup::Gpio(gpio) => Ok(Self::Gpio(Gpio::open(gpio)?)),
            InputGroup::Lines(lines) => Ok(Self::Lines(Lines::open(lines)?)),
            InputGroup::Field(field) => Err(format!("{} is read by its stream", field.device)),
        }
    }

    /// Readable when there is something to take.
    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        match self {
            Self::Keys(keys) => keys.fd(),
            Self::Gpio(gpio) => gpio.fd(),
            Self::Lines(lines) => lines.as_fd(),
        }
    }

    /// Reports every level that each input has had since the last call, and its present one where it can be queried,
    /// without waiting.
    /// # Errors
    /// When it can no longer be read, as text for the user.
    pub(super) fn drain(&mut self, report: &mut dyn FnMut(usize, bool)) -> Result<(), String> {
        match self {
            Self::Keys(keys) => keys.drain(report),
            Self::Gpio(gpio) => gpio.drain(report),
            Self::Lines(lines) => lines.drain(report),
        }
    }

    /// How long after a call of [`Self::drain`] the next one is due at the latest; `None` where it cannot be queried.
    pub(super) const fn look_after(&self) -> Option<Duration> {
        match self {
            Self::Keys(_) => Some(key::LOOK),
            Self::Gpio(_) | Self::Lines(_) => None,
        }
    }

    /// Why it is silent, as text for the user.
    pub(super) fn why_silent(&mut self) -> String {
        match self {
            Self::Keys(_) => String::new(),
            Self::Gpio(_) => format!("its chip has not answered for {:?}", Input::SILENCE),
            Self::Lines(lines) => lines.why_silent(),
        }
    }

    /// After this long without data it is lost; `None` where the kernel knows its level at all times, and where data is
    /// sent at changes only.
    pub(super) fn silence(&self) -> Option<Duration> {
        match self {
            Self::Keys(_) => None,
            Self::Gpio(_) => Some(Input::SILENCE),
            Self::Lines(lines) => lines.silence(),
        }
    }
}
