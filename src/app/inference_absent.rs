//! Stage inference of a program that was built without cargo feature `policy`: there is nothing to start.

use std::sync::Arc;
use std::sync::mpsc::Sender;

use rapid_bus::Bus;
use rapid_episode::ReferenceSample;
use rapid_registry::Registry;
use rapid_status::{Board, EpisodeWatch};
use tokio_util::sync::CancellationToken;

use super::AppError;
use super::stage::Stage;
use crate::rig::presence::Published;

/// No policy can be given.
#[derive(Debug)]
pub enum PolicyOptions {}

/// What the stage would be given by others.
#[expect(dead_code, reason = "there is no stage that reads it")]
pub(super) struct Surroundings<'a> {
    pub(super) registry: &'a Arc<Registry>,
    pub(super) bus: &'a Bus,
    pub(super) board: &'a Arc<Board>,
    pub(super) loaded: &'a CancellationToken,
    pub(super) references: Sender<ReferenceSample>,
    pub(super) mask: Published,
    pub(super) episode: Option<EpisodeWatch>,
}

/// Starts nothing.
pub(super) fn start(options: PolicyOptions, _: Surroundings<'_>) -> Result<Stage, AppError> {
    match options {}
}
