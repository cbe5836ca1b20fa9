//! Stage Foxglove: thread `foxglove`, which serves the topics of the run over a websocket ([`rapid_live`]).
//!
//! Invariant: no recording ends because of it: its failure is an error of the log.

use std::sync::{Arc, mpsc};

use rapid_episode::made::Shown;
use tokio::sync::mpsc::UnboundedSender;
use tokio::sync::watch;

pub(super) use rapid_live::LiveAddition;
pub use rapid_live::LiveOptions;

use rapid_bus::Bus;
use rapid_core::permission::Permission;
use rapid_core::time::WallClock;
use rapid_episode::made::Made;
use rapid_live::{Controls, Feed, Live};
use rapid_registry::Registry;
use rapid_status::Board;

use super::AppError;
use super::requests::{Request, asker};
use super::stage::Stage;

/// Listens, before anything of the run is started: a port in use is an error of the start.
pub(super) async fn listen(
    options: LiveOptions,
    registry: &Arc<Registry>,
    board: &Arc<Board>,
    permission: &Arc<Permission>,
    conductor: &UnboundedSender<Request>,
) -> Result<Listening, AppError> {
    let controls = options.control.then(|| Controls { ask: asker(conductor), permission: Arc::clone(permission) });
    let live = Live::listen(options, Arc::clone(registry), Arc::clone(board), controls).await?;
    let (shown, made) = Shown::channel();
    Ok(Listening { live, made, shown })
}

/// A server that shows nothing yet.
#[derive(Debug)]
pub(super) struct Listening {
    live: Live,
    made: mpsc::Receiver<Made>,
    /// Receives what the recorder writes besides samples.
    pub(super) shown: Shown,
}

/// The stage, and what the other stages need of it.
#[derive(Debug)]
pub(super) struct Served {
    pub(super) stage: Stage,
    /// Receives the entries that are added.
    pub(super) additions: mpsc::Sender<LiveAddition>,
}

impl Listening {
    /// Shows the topics of the bus, and starts the stage.
    pub(super) fn start(self, bus: &Bus, board: &Board, clock: watch::Receiver<WallClock>) -> Result<Served, AppError> {
        let Self { mut live, made, shown: _ } = self;
        let mut queues = bus.queues()?;
        if let Some(observations) = bus.observations()? {
            queues.add(observations);
        }
        let (additions, added) = mpsc::channel();
        live.feed(Feed { queues, events: board.events(), clock, made, additions: added });
        let stage = Stage::start("the Foxglove server", |stop| async move {
            live.run(stop).await;
            Ok(())
        });
        Ok(Served { stage, additions })
    }
}
