//! The link of a screen to its run: where snapshots come from, and where requests go.

use std::sync::Arc;

use rapid_core::action::Order;
use rapid_core::permission::Permission;
use rapid_core::time::Stamp;
use rapid_status::{Board, Command, Snapshot};
use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;

use super::model::{Effect, Msg};

/// The link was closed: the screen ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Closed;

/// What a screen is linked to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LinkState {
    /// The run of this process, which ends with the screen.
    #[default]
    Own,
    /// A run of another process, which continues without the screen.
    Attached {
        /// Its process.
        process: u32,
        /// No request is sent to it.
        read_only: bool,
    },
    /// No run: what is shown is the last state.
    Lost {
        /// When the screen noticed it.
        since: Stamp,
        /// As before.
        read_only: bool,
        /// The process of the run is still there, and the link to it is lost: nothing is known of it since then.
        runs: bool,
    },
}

/// See the module's comment.
pub trait RigLink {
    /// The newest snapshot.
    fn snapshot(&mut self) -> Snapshot;

    /// What it is linked to.
    fn state(&self) -> LinkState;

    /// An answer that arrived later than the request, if there is one.
    fn answer(&mut self) -> Option<Msg> {
        None
    }

    /// Carries out an effect; returns the answer for the model, if any.
    ///
    /// # Errors
    /// When the link was closed.
    fn carry_out(&mut self, effect: Effect) -> Result<Option<Msg>, Closed>;
}

/// The link to the run of this process. Orders to the actuator go directly to its [`Permission`].
#[derive(Debug)]
pub struct Own {
    board: Arc<Board>,
    commands: mpsc::Sender<Command>,
    permission: Arc<Permission>,
}

impl Own {
    /// Shows `board` and sends requests to `commands`.
    pub fn new(board: Arc<Board>, commands: mpsc::Sender<Command>, permission: Arc<Permission>) -> Self {
        Self { board, commands, permission }
    }

    fn send(&self, command: Command) -> Result<Option<Msg>, Closed> {
        match self.commands.try_send(command) {
            Ok(()) => Ok(None),
            Err(TrySendError::Full(_)) => Ok(Some(Msg::Refused)),
            Err(TrySendError::Closed(_)) => Err(Closed),
        }
    }
}

impl RigLink for Own {
    fn snapshot(&mut self) -> Snapshot {
        self.board.snapshot()
    }

    fn state(&self) -> LinkState {
        LinkState::Own
    }

    fn carry_out(&mut self, effect: Effect) -> Result<Option<Msg>, Closed> {
        match effect {
            Effect::None => Ok(None),
            Effect::Order(Order::Disarm | Order::Emergency(_)) => {
                self.permission.disarm(Stamp::now());
                Ok(None)
            }
            // The monitor arms without driving back: `rapid arm --drive-back` is a deliberate choice.
            Effect::Order(Order::Arm | Order::ArmBack) => {
                let now = Stamp::now();
                Ok(self.permission.arm(now, now).err().map(|why| Msg::NotArmed(why.to_string())))
            }
            Effect::Leave => {
                self.permission.disarm(Stamp::now());
                self.send(Command::Quit)
            }
            Effect::Send(command) => self.send(command),
        }
    }
}
