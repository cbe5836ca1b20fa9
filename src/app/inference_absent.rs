//! Stage inference of a program that was built without cargo feature `policy`: there is nothing to start.

use std::sync::Arc;

use rapid_bus::Bus;
use rapid_registry::Registry;
use rapid_status::Board;
use tokio_util::sync::CancellationToken;

use super::AppError;
use super::stage::Stage;

/// No policy can be given.
#[derive(Debug)]
pub enum PolicyOptions {}

/// Starts nothing.
pub(super) fn start(
    options: PolicyOptions,
    _: &Arc<Registry>,
    _: &Bus,
    _: (&Arc<Board>, &CancellationToken),
    _: bool,
) -> Result<Stage, AppError> {
    match options {}
}
