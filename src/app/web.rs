//! Stage page: thread `web`, which serves the page for a phone ([`rapid_web`]).
//!
//! Invariant: no recording ends because of it: its failure is an error of the log.

use std::sync::Arc;

use tokio::sync::mpsc::UnboundedSender;

pub use rapid_web::WebOptions;

use rapid_status::Board;
use rapid_web::Web;

use super::AppError;
use super::requests::{Request, asker};
use super::stage::Stage;

/// Starts the stage, before anything of the run is started: a port in use is an error of the start.
pub(super) fn start(
    options: &WebOptions,
    board: &Arc<Board>,
    conductor: &UnboundedSender<Request>,
) -> Result<Stage, AppError> {
    let web = Web::start(options, Arc::clone(board), asker(conductor))?;
    Ok(Stage::start("the page", |stop| async move {
        web.run(stop).await;
        Ok(())
    }))
}
