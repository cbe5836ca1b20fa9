//! An open input of any kind.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use super::gpio::Gpio;
use super::key::{self, Key};
use super::line::Line;
use crate::gpio::Input;
use crate::interlock::InputState;
use crate::registry::InterlockInput;

/// See the module's comment.
#[derive(Debug)]
pub(super) enum Source {
    Key(Box<Key>),
    Gpio(Gpio),
    Line(Line),
}

impl Source {
    /// Opens it.
    ///
    /// # Errors
    /// Why it cannot be opened, as text for the user.
    pub(super) fn open(input: &InterlockInput) -> Result<Self, String> {
        match input {
            InterlockInput::Key(key) => Ok(Self::Key(Box::new(Key::open(key)?))),
            InterlockInput::Gpio(gpio) => Ok(Self::Gpio(Gpio::open(gpio)?)),
            InterlockInput::Serial(line) => Ok(Self::Line(Line::open(line)?)),
            InterlockInput::Field(field) => Err(format!("{} is read by its stream", field.device)),
        }
    }

    /// Readable when there is something to take.
    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        match self {
            Self::Key(key) => key.fd(),
            Self::Gpio(gpio) => gpio.fd(),
            Self::Line(line) => line.as_fd(),
        }
    }

    /// Reports every state that it has had since the last call, and its present state where it can be queried, without
    /// waiting.
    /// # Errors
    /// When it can no longer be read, as text for the user.
    pub(super) fn take(&mut self, report: &mut dyn FnMut(InputState)) -> Result<(), String> {
        match self {
            Self::Key(key) => key.take(report),
            Self::Gpio(gpio) => gpio.take(report),
            Self::Line(line) => line.take(report),
        }
    }

    /// How long after a call of [`Self::take`] the next one is due at the latest; `None` where it cannot be queried.
    pub(super) const fn look_after(&self) -> Option<Duration> {
        match self {
            Self::Key(_) => Some(key::LOOK),
            Self::Gpio(_) | Self::Line(_) => None,
        }
    }

    /// Why it is silent, as text for the user.
    pub(super) fn why_silent(&mut self) -> String {
        match self {
            Self::Key(_) => String::new(),
            Self::Gpio(_) => format!("its chip has not answered for {:?}", Input::SILENCE),
            Self::Line(line) => line.why_silent(),
        }
    }

    /// After this long without data it is lost; `None` where the kernel knows its state at all times.
    pub(super) fn silence(&self) -> Option<Duration> {
        match self {
            Self::Key(_) => None,
            Self::Gpio(_) => Some(Input::SILENCE),
            Self::Line(line) => Some(line.silence()),
        }
    }
}

/// The state of an input that runs while it is on, or while it is off.
pub(super) const fn state(is_on: bool, runs_while_on: bool) -> InputState {
    if is_on == runs_while_on { InputState::Runs } else { InputState::Stopped }
}
