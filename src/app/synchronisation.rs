//! Stage synchronisation: publishes on the bus which samples belong to each tick.

use std::sync::Arc;

use rapid_bus::{Bus, Subscription, TopicId};
use rapid_registry::{DeviceSpec, Registry};
use rapid_status::Board;
use rapid_system::fault;
use tokio::sync::mpsc;

use super::AppError;
use super::stage::Stage;
use crate::alignment::Alignment;

/// The stage before it starts: samples that arrive from now on wait for it.
pub(super) struct Synchronisation {
    alignment: Alignment,
    /// Receives the modalities that are added.
    pub(super) additions: mpsc::UnboundedSender<(Arc<DeviceSpec>, Subscription)>,
}

impl Synchronisation {
    /// Of the samples of the bus.
    ///
    /// # Errors
    /// When the bus cannot be read.
    pub(super) fn new(registry: &Registry, bus: &Bus, board: &Arc<Board>) -> Result<Self, AppError> {
        let Some(writer) = bus.writer(TopicId::Observation) else { return Err(AppError::Panicked("the bus")) };
        let (additions, added) = mpsc::unbounded_channel();
        let alignment = Alignment::new(registry, bus.queues()?, writer, Arc::clone(board)).extended_by(added);
        Ok(Self { alignment, additions })
    }

    pub(super) fn start(self) -> Stage {
        Stage::start("the synchronisation", |stop| async move {
            tokio::select! {
                _ = self.alignment.run(stop) => Ok(()),
                never = fault::strike("sync") => never,
            }
        })
    }
}
