//! The screen of a run: the monitor, or lines on standard output.

use std::io::IsTerminal;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::permission::Permission;
use rapid_screens::headless::{self, HeadlessOptions};
use rapid_screens::tui::{self, ScreenOptions, TuiError};
use rapid_status::palette::Palette;
use rapid_status::{Board, Command, Event};
use rapid_system::fault;
use tokio::sync::{broadcast, mpsc};

use super::attached::Attached;
use super::stage::Stage;
use super::{AppError, Screen};

/// Commands that may wait to be sorted.
const WAITING: usize = 16;

/// The screen, and where the commands of all screens come from.
pub(super) struct Shown {
    pub(super) stage: Stage,
    pub(super) commands: mpsc::Receiver<Command>,
    /// Screens of other processes, whose commands come from there too.
    pub(super) attached: Attached,
}

/// Starts the requested screen, which shows these events of the board.
pub(super) fn start(
    screen: Screen,
    board: &Arc<Board>,
    events: broadcast::Receiver<Event>,
    permission: &Arc<Permission>,
    duration: Option<Duration>,
    shown: ScreenOptions,
) -> Shown {
    let (sender, commands) = mpsc::channel(WAITING);
    let attached = Attached::new(Arc::clone(board), sender.clone());
    let (board, permission) = (Arc::clone(board), Arc::clone(permission));
    let stage = if screen == Screen::Monitor {
        monitor(board, sender, permission, shown)
    } else {
        // Lines of text cannot make requests.
        drop(sender);
        lines(screen, board, events, duration)
    };
    Shown { stage, commands, attached }
}

fn monitor(
    board: Arc<Board>,
    commands: mpsc::Sender<Command>,
    permission: Arc<Permission>,
    shown: ScreenOptions,
) -> Stage {
    Stage::start("the screen", |stop| async move {
        tokio::select! {
            outcome = tui::run(board, commands, permission, shown, stop) => match outcome {
                // Equivalent to SIGHUP, which arrives with it or a little later.
                Err(error @ TuiError::Gone(_)) => {
                    tracing::warn!(%error, "the run ends");
                    Ok(())
                }
                outcome => Ok(outcome?),
            },
            never = fault::strike("screen") => never,
        }
    })
}

fn lines(screen: Screen, board: Arc<Board>, events: broadcast::Receiver<Event>, duration: Option<Duration>) -> Stage {
    let (json, stdout) = (screen == Screen::Json, std::io::stdout());
    let palette = if json { Palette::Plain } else { Palette::for_output(&stdout) };
    let options = HeadlessOptions { json, palette, in_place: !json && stdout.is_terminal(), duration };
    Stage::start("the screen", |stop| {
        let run = headless::run(board, events, stop, options, stdout);
        async move {
            tokio::select! {
                outcome = run => outcome.map_err(AppError::Output),
                never = fault::strike("screen") => never,
            }
        }
    })
}
