//! Stage streaming: the rig, from the first device to the end of the last device program.

use rapid_devices::hotplug::HotplugStream;
use rapid_system::fault;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::AppError;
use super::stage::Stage;
use crate::rig::{Rig, RigCommand};

/// Requests that may wait for the rig.
const WAITING: usize = 16;

/// The stage, and what the run waits for in it.
#[derive(Debug)]
pub(super) struct Streaming {
    pub(super) stage: Stage,
    pub(super) commands: mpsc::Sender<RigCommand>,
    /// Cancelled when the rig begins to close its devices without a request.
    pub(super) ending: CancellationToken,
    /// Cancelled when all streams have ended, or the rig has panicked. Otherwise the mask is still published.
    pub(super) closed: CancellationToken,
    /// Cancelled when the mask is no longer needed.
    pub(super) release: CancellationToken,
    /// Once this is cancelled, programs that are being ended are killed.
    pub(super) hurry: CancellationToken,
}

impl Streaming {
    pub(super) fn start(rig: Rig, plugged: HotplugStream) -> Self {
        let (commands, requested) = mpsc::channel(WAITING);
        let (ending, hurry) = (rig.ending(), rig.hurry());
        let (closed, release) = (CancellationToken::new(), CancellationToken::new());
        let (is_closed, released) = (closed.clone(), release.clone());
        let stage = Stage::start("the rig", |stop| async move {
            let mut rig = rig;
            // On a panic too, and then before the rig is dropped and the mask ends: the cause is reported first.
            let guard = is_closed.drop_guard();
            let outcome = tokio::select! {
                outcome = rig.run(plugged, requested, stop) => outcome,
                never = fault::strike("rig") => never,
            };
            drop(guard);
            released.cancelled().await;
            rig.programs_ended().await;
            // Dropping joins the mask's thread.
            tokio::task::spawn_blocking(move || drop(rig)).await.map_err(|_| AppError::Panicked("the rig"))?;
            Ok(outcome?)
        });
        Self { stage, commands, ending, closed, release, hurry }
    }

    /// Closes all devices and waits for it. The mask stays published as it was.
    pub(super) async fn close(&self) {
        self.stage.request_end();
        self.closed.cancelled().await;
    }

    /// Waits for the programs of devices, and withdraws the mask.
    pub(super) async fn end(&mut self) -> Result<(), AppError> {
        self.release.cancel();
        self.stage.end().await
    }
}
