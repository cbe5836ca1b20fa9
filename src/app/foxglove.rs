//! Stage Foxglove: thread `foxglove`, which serves the topics of the run over a websocket ([`rapid_foxglove`]).
//!
//! Invariant: no recording ends because of it: its failure is an error of the log.

use std::sync::{Arc, mpsc};

use futures::FutureExt;
use futures::future::BoxFuture;
use rapid_bus::Bus;
use rapid_core::time::WallClock;
use rapid_episode::made::{Made, Shown};
pub use rapid_foxglove::FoxgloveOptions;
use rapid_foxglove::{Controls, Feed, FoxgloveServer};
use rapid_status::Board;
use tokio::sync::watch;

use super::AppError;
use super::optional::{AddedEntry, Host, Listening, Server};
use super::requests::asker;
use super::stage::Stage;

impl Server for FoxgloveOptions {
    fn listen<'a>(self: Box<Self>, host: &'a Host<'a>) -> BoxFuture<'a, Result<Listening, AppError>> {
        async move {
            let Host { registry, board, permission, conductor } = host;
            let controls = self.control.then(|| Controls { ask: asker(conductor), permission: Arc::clone(permission) });
            let server = FoxgloveServer::listen(*self, Arc::clone(registry), Arc::clone(board), controls).await;
            let server = server.map_err(AppError::optional)?;
            let (shown, made) = Shown::channel();
            let (additions, added) = mpsc::channel();
            let streams = (made, added);
            Ok(Listening {
                shown: Some(shown),
                additions: Some(additions),
                start: Box::new(|bus, board, clock| start(server, bus, board, clock, streams)),
            })
        }
        .boxed()
    }
}

/// What the server reads besides the bus.
type Streams = (mpsc::Receiver<Made>, mpsc::Receiver<AddedEntry>);

/// Shows the topics of the bus, and starts the stage.
fn start(
    mut server: FoxgloveServer,
    bus: &Bus,
    board: &Board,
    clock: watch::Receiver<WallClock>,
    (made, additions): Streams,
) -> Result<Stage, AppError> {
    let mut queues = bus.queues()?;
    if let Some(observations) = bus.observations()? {
        queues.add(observations);
    }
    server.feed(Feed { queues, events: board.events(), clock, made, additions });
    Ok(Stage::start("the Foxglove server", |stop| async move {
        server.run(stop).await;
        Ok(())
    }))
}
