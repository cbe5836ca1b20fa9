//! The monitor: a full-screen view of the rig while data is collected.
//!
//! Snapshots of the board, fifteen per second, and the user's keys change the [`model`]; the `view` draws
//! it. The user's requests are sent as [`Command`]s, except orders to the actuator, which go directly to its
//! [`Permission`].
//!
//! Invariant: the terminal is restored to its previous state, however the screen ends.
//! Invariant: a blocked terminal delays nothing: a separate thread writes the frames, and frames are dropped
//! while it is behind.

mod devices;
mod episodes;
pub mod flashlight;
mod footer;
mod header;
mod help;
mod history;
mod keys;
mod log;
mod mask;
pub mod model;
mod policy;
mod recording;
mod terminal;
pub mod theme;
pub mod view;

use std::io::{self, Write as _};
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
use crate::time::{Stamp, Zone};
use model::{Effect, Model, Msg};
use terminal::Screen;
use theme::Theme;

/// Time between two frames when no key is pressed.
const FRAME: Duration = Duration::from_millis(67);

/// Why there is no screen.
#[derive(Debug, thiserror::Error)]
pub enum TuiError {
    /// Input or output is not a terminal, or it cannot be switched to raw mode.
    #[error("no terminal for the monitor: {0}; --headless runs without one")]
    NoTerminal(#[source] io::Error),
    /// The terminal went away.
    #[error("the terminal is gone: {0}")]
    Gone(#[source] io::Error),
}

/// Width of the terminal in columns, if there is one.
pub fn columns() -> Option<usize> {
    crossterm::terminal::size().ok().map(|(columns, _)| usize::from(columns))
}

/// Shows the monitor until `shutdown`.
///
/// A request to quit only sends [`Command::Quit`]; the screen stays until the receiver of the commands
/// cancels `shutdown` or is dropped.
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
    let requests = Requests { commands, permission };
    let outcome = drive(&board, &requests, &shutdown, EventStream::new(), |model| screen.draw(model, theme)).await;
    screen.close().await;
    // The terminal shows what was there before: without this line nothing of the run is left on it.
    if let Some(summary) = board.episodes().summary() {
        let _ = writeln!(io::stdout(), "{summary}");
    }
    outcome
}

/// The receiver of the commands was dropped.
struct Closed;

/// Where the user's requests go.
struct Requests {
    commands: mpsc::Sender<Command>,
    permission: Arc<Permission>,
}

impl Requests {
    /// Carries out an effect; returns the answer for the model, if any.
    fn carry_out(&self, effect: Effect) -> Result<Option<Msg>, Closed> {
        match effect {
            Effect::None => Ok(None),
            Effect::Order(Order::Disarm | Order::Emergency(_)) => {
                self.permission.disarm(Stamp::now());
                Ok(None)
            }
            // The monitor arms without driving back: `rapid arm --drive-back` is a deliberate choice.
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

    fn send(&self, command: Command) -> Result<Option<Msg>, Closed> {
        match self.commands.try_send(command) {
            Ok(()) => Ok(None),
            Err(TrySendError::Full(_)) => Ok(Some(Msg::Refused)),
            Err(TrySendError::Closed(_)) => Err(Closed),
        }
    }
}

/// The loop itself, with any source of terminal events and any way to draw.
async fn drive(
    board: &Board,
    requests: &Requests,
    shutdown: &CancellationToken,
    events: impl Stream<Item = io::Result<Event>>,
    mut draw: impl FnMut(&Model) -> io::Result<()>,
) -> Result<(), TuiError> {
    let mut events = std::pin::pin!(events);
    let mut model = Model::new(board.snapshot());
    model.zone = Zone::local();
    let mut frames = tokio::time::interval(FRAME);
    frames.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let effect = tokio::select! {
            biased;
            () = shutdown.cancelled() => return Ok(()),
            event = events.next() => match event {
                Some(Ok(Event::Key(key))) => model.update(Msg::Key(key)),
                // A resize, which the next frame detects by itself, and pasted text, which is no request.
                Some(Ok(_)) => Effect::None,
                Some(Err(error)) => return Err(TuiError::Gone(error)),
                None => return Err(TuiError::Gone(io::ErrorKind::UnexpectedEof.into())),
            },
            _ = frames.tick() => model.update(Msg::Snapshot(Box::new(board.snapshot()))),
        };
        match requests.carry_out(effect) {
            Ok(Some(answer)) => drop(model.update(answer)),
            Ok(None) => {}
            Err(Closed) => return Ok(()),
        }
        draw(&model).map_err(TuiError::Gone)?;
    }
}

#[cfg(test)]
mod tests;
