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

use super::stage::Stage;
use super::{AppError, Screen};

/// Starts the requested screen, which shows these events of the board.
pub(super) fn start(
    screen: Screen,
    board: &Arc<Board>,
    events: broadcast::Receiver<Event>,
    commands: mpsc::Sender<Command>,
    permission: &Arc<Permission>,
    duration: Option<Duration>,
    shown: ScreenOptions,
) -> Stage {
    let (board, permission) = (Arc::clone(board), Arc::clone(permission));
    if screen == Screen::Monitor {
        return Stage::start("the screen", |stop| async move {
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
        });
    }
    let (json, stdout) = (screen == Screen::Json, std::io::stdout());
    let palette = if json { Palette::Plain } else { Palette::of(&stdout) };
    let options = HeadlessOptions { json, palette, in_place: !json && stdout.is_terminal(), duration };
    Stage::start("the screen", |stop| {
        let run = headless::run(board, events, stop, options, stdout);
        async move {
            // Lines of text cannot make requests.
            drop(commands);
            tokio::select! {
                outcome = run => outcome.map_err(AppError::Output),
                never = fault::strike("screen") => never,
            }
        }
    })
}
