//! Stage Foxglove of a program that was built without cargo feature `foxglove`: there is nothing to start.

use std::convert::Infallible;
use std::sync::{Arc, mpsc};

use rapid_bus::{Bus, Subscription};
use rapid_core::permission::Permission;
use rapid_core::time::WallClock;
use rapid_episode::made::Made;
use rapid_episode::made::Shown;
use rapid_registry::{DeviceSpec, Registry};
use rapid_status::Board;
use tokio::sync::mpsc::UnboundedSender;
use tokio::sync::watch;

use super::AppError;
use super::requests::Request;
use super::stage::Stage;

/// No server can be requested.
#[derive(Debug, Clone, Copy)]
pub enum LiveOptions {}

/// An entry that was added during the run, and its samples.
pub(super) type LiveAddition = (Arc<DeviceSpec>, Subscription);

/// Listens on nothing.
#[expect(clippy::unused_async, reason = "as with the feature")]
pub(super) async fn listen(
    options: LiveOptions,
    _: &Arc<Registry>,
    _: &Arc<Board>,
    _: &Arc<Permission>,
    _: &UnboundedSender<Request>,
) -> Result<Listening, AppError> {
    match options {}
}

/// There is none: the field has no value.
#[derive(Debug)]
pub(super) struct Listening {
    never: Infallible,
    pub(super) shown: Shown,
}

/// Likewise.
#[derive(Debug)]
pub(super) struct Served {
    pub(super) stage: Stage,
    pub(super) additions: mpsc::Sender<LiveAddition>,
}

impl Listening {
    /// Starts nothing.
    pub(super) fn start(self, _: &Bus, _: &Board, _: watch::Receiver<WallClock>) -> Result<Served, AppError> {
        match self.never {}
    }
}
