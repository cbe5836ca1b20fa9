//! Stage page of a program that was built without cargo feature `web`: there is nothing to start.

use std::sync::Arc;

use rapid_status::Board;
use tokio::sync::mpsc::UnboundedSender;

use super::AppError;
use super::requests::Request;
use super::stage::Stage;

/// No page can be requested.
#[derive(Debug, Clone)]
pub enum WebOptions {}

/// Starts nothing.
pub(super) fn start(options: &WebOptions, _: &Arc<Board>, _: &UnboundedSender<Request>) -> Result<Stage, AppError> {
    match *options {}
}
