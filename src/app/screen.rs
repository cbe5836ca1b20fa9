//! What shows a run: the monitor, or lines on standard output.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::{AppError, Screen};
use crate::fault;
use crate::headless::style::ColourChoice;
use crate::headless::{self, HeadlessOptions};
use crate::permission::Permission;
use crate::status::{Board, Command};
use crate::tui::{self, TuiError};

pub(super) type ScreenTask = JoinHandle<Result<(), AppError>>;

/// Starts the screen that was asked for.
pub(super) fn start(
    screen: Screen,
    board: &Arc<Board>,
    commands: mpsc::Sender<Command>,
    permission: &Arc<Permission>,
    stop: CancellationToken,
    duration: Option<Duration>,
) -> ScreenTask {
    let (board, permission) = (Arc::clone(board), Arc::clone(permission));
    if screen == Screen::Monitor {
        return tokio::spawn(async move {
            tokio::select! {
                outcome = tui::run(board, commands, permission, stop) => match outcome {
                    // As good as SIGHUP, which comes with it or a little later.
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
    let options = HeadlessOptions {
        json: screen == Screen::Json,
        colour: ColourChoice::Auto,
        progress: screen == Screen::Lines,
        duration,
    };
    let run = headless::run(board, stop, options, std::io::stdout());
    tokio::spawn(async move {
        // Lines cannot ask for anything.
        drop(commands);
        tokio::select! {
            outcome = run => outcome.map_err(AppError::Output),
            never = fault::strike("screen") => never,
        }
    })
}

/// Waits for the end of the screen, whose outcome is taken; for ever if it was taken before.
pub(super) async fn ended(screen: &mut Option<ScreenTask>) -> Result<(), AppError> {
    let Some(task) = screen else { return std::future::pending().await };
    let outcome = task.await;
    *screen = None;
    outcome.unwrap_or(Err(AppError::Panicked("the screen")))
}
