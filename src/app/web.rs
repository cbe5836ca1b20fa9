//! Stage page: thread `web`, which serves the page for a phone ([`crate::web`]).
//!
//! Invariant: no recording ends because of it: its failure is an error of the log.

use std::sync::Arc;

use tokio::sync::mpsc::UnboundedSender;

pub use crate::web::WebOptions;

use rapid_status::Board;

use super::AppError;
use super::requests::{Request, asker};
use super::stage::Stage;
use crate::web::Web;

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
