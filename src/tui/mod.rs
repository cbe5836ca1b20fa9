//! The monitor: a full-screen view of the rig while data is collected.
//!
//! A snapshot of the board fifteen times a second and the user's keys change the [`model`]; the
//! `view` draws it; what the user wants goes out as [`Command`]s, but for orders to the actuator, which are given
//! to its [`Permission`] at once.
//!
//! Invariant: the terminal is given back as it was found, however the screen ends.
//! Invariant: a terminal that takes no output delays nothing: frames are written by a thread of
//! their own and left out while it is behind.

mod devices;
pub mod flashlight;
mod footer;
mod header;
mod help;
mod log;
mod mask;
pub mod model;
mod policy;
mod recording;
mod terminal;
pub mod theme;
pub mod view;

use std::io;
use std::sync::Arc;
use std::time::Duration;

use crossterm::event::{Event, EventStream};
use futures::{Stream, StreamExt};
use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use crate::action::Order;
use crate::permission::Permission;
use crate::status::{Board, Command};
use crate::time::Stamp;
use model::{Effect, Model, Msg};
use terminal::Screen;
use theme::Theme;

/// Time between two frames when no key comes.
const FRAME: Duration = Duration::from_millis(67);

/// Why there is no screen.
#[derive(Debug, thiserror::Error)]
pub enum TuiError {
    /// Neither input nor output is a terminal, or it cannot be put into raw mode.
    #[error("no terminal for the monitor: {0}; --headless runs without one")]
    NoTerminal(#[source] io::Error),
    /// The terminal went away.
    #[error("the terminal is gone: {0}")]
    Gone(#[source] io::Error),
}

/// Width of the terminal in columns, if there is one.
#[must_use]
pub fn columns() -> Option<usize> {
    crossterm::terminal::size().ok().map(|(columns, _)| usize::from(columns))
}

/// Shows the monitor until `shutdown`.
///
/// Asking to quit only sends [`Command::Quit`]; the screen stays until whoever takes the commands
/// cancels `shutdown` or drops the receiver.
///
/// # Errors
/// When there is no terminal, or it goes away.
pub async fn run(
    board: Arc<Board>,
    commands: mpsc::Sender<Command>,
    permission: Arc<Permission>,
    shutdown: CancellationToken,
) -> Result<(), TuiError> {
    let theme = Theme::detect(|name| std::env::var(name).ok());
    let mut screen = Screen::open().map_err(TuiError::NoTerminal)?;
    let asked = Asked { commands, permission };
    let outcome = drive(&board, &asked, &shutdown, EventStream::new(), |model| screen.draw(model, theme)).await;
    screen.close().await;
    outcome
}

/// Nobody takes commands any more.
struct Ended;

/// Who does what the user asks for.
struct Asked {
    commands: mpsc::Sender<Command>,
    permission: Arc<Permission>,
}

impl Asked {
    /// What the model is to know of it.
    fn carry_out(&self, effect: Effect) -> Result<Option<Msg>, Ended> {
        match effect {
            Effect::None => Ok(None),
            Effect::Order(Order::Disarm | Order::Emergency(_)) => {
                self.permission.disarm(Stamp::now());
                Ok(None)
            }
            // The monitor gives the plain one: to drive a joint back is asked for by its name.
            Effect::Order(Order::Arm | Order::ArmBack) => {
                let now = Stamp::now();
                Ok(self.permission.arm(now, now).err().map(Msg::Void))
            }
            Effect::Leave => {
                self.permission.disarm(Stamp::now());
                self.send(Command::Quit)
            }
            Effect::Send(command) => self.send(command),
        }
    }

    fn send(&self, command: Command) -> Result<Option<Msg>, Ended> {
        match self.commands.try_send(command) {
            Ok(()) => Ok(None),
            Err(TrySendError::Full(_)) => Ok(Some(Msg::Refused)),
            Err(TrySendError::Closed(_)) => Err(Ended),
        }
    }
}

/// The loop itself, with any source of terminal events and any way to draw.
async fn drive(
    board: &Board,
    asked: &Asked,
    shutdown: &CancellationToken,
    events: impl Stream<Item = io::Result<Event>>,
    mut draw: impl FnMut(&Model) -> io::Result<()>,
) -> Result<(), TuiError> {
    let mut events = std::pin::pin!(events);
    let mut model = Model::new(board.snapshot());
    let mut frames = tokio::time::interval(FRAME);
    frames.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let effect = tokio::select! {
            biased;
            () = shutdown.cancelled() => return Ok(()),
            event = events.next() => match event {
                Some(Ok(Event::Key(key))) => model.update(Msg::Key(key)),
                // Another size, which the next frame finds by itself, and pasted text, which asks for nothing.
                Some(Ok(_)) => Effect::None,
                Some(Err(error)) => return Err(TuiError::Gone(error)),
                None => return Err(TuiError::Gone(io::ErrorKind::UnexpectedEof.into())),
            },
            _ = frames.tick() => model.update(Msg::Snapshot(Box::new(board.snapshot()))),
        };
        match asked.carry_out(effect) {
            Ok(Some(answer)) => drop(model.update(answer)),
            Ok(None) => {}
            Err(Ended) => return Ok(()),
        }
        draw(&model).map_err(TuiError::Gone)?;
    }
}

#[cfg(test)]
mod tests;
