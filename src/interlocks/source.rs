//! An open input, whatever it is.

use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use super::gpio::Gpio;
use super::key::Key;
use super::line::Line;
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
    /// Why it cannot be opened, for people.
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

    /// Reports every state that it has had since the last call, without waiting; at the first call what it is now, where
    /// it can be asked.
    ///
    /// # Errors
    /// When it cannot be read any more, for people.
    pub(super) fn take(&mut self, is_first: bool, report: &mut dyn FnMut(InputState)) -> Result<(), String> {
        match self {
            Self::Key(key) => key.take(is_first, report),
            Self::Gpio(gpio) => gpio.take(is_first, report),
            Self::Line(line) => line.take(report),
        }
    }

    /// Silent for this long it is lost; `None` where the kernel knows its state at all times.
    pub(super) fn silence(&self) -> Option<Duration> {
        match self {
            Self::Key(_) | Self::Gpio(_) => None,
            Self::Line(line) => Some(line.silence()),
        }
    }
}

/// The state of an input that runs while it is on, or while it is off.
pub(super) const fn state(is_on: bool, runs_while_on: bool) -> InputState {
    if is_on == runs_while_on { InputState::Runs } else { InputState::Stopped }
}

/// What an open or a read that failed says to people.
pub(super) fn failure(what: &str, group: &str, error: &io::Error) -> String {
    match error.raw_os_error() {
        Some(libc::ENOENT | libc::ENODEV | libc::ENXIO | libc::EIO) => format!("{what} is not plugged in"),
        Some(libc::EACCES | libc::EPERM) => {
            format!("{what} may not be opened: add the user to group {group} (`sudo usermod -aG {group} $USER`)")
        }
        Some(libc::EBUSY | libc::EAGAIN) => {
            format!("{what} is held by another program: end it (`fuser {what}` names it)")
        }
        _ => format!("{what}: {error}"),
    }
}
