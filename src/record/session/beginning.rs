//! What a session begins with.

use std::sync::Arc;

use crate::record::episode::{EpisodePath, EpisodeRequest};
use crate::record::file::Sink;
use crate::record::provenance::Attached;
use crate::registry::Registry;
use crate::status::Board;
use crate::sync::SyncModality;
use crate::time::{Stamp, WallClock};

/// Samples of a modality that may arrive while those of a whole queue are being written.
const RING_SLACK: usize = 1024;

/// What a session begins with.
pub(in crate::record) struct Beginning<'a> {
    pub(in crate::record) registry: Arc<Registry>,
    pub(in crate::record) board: Arc<Board>,
    pub(in crate::record) request: &'a EpisodeRequest,
    pub(in crate::record) path: EpisodePath,
    pub(in crate::record) sink: Box<dyn Sink>,
    pub(in crate::record) attached: &'a Attached,
    pub(in crate::record) clock: WallClock,
    pub(in crate::record) begin: Stamp,
}

/// The modalities of a registry, as frames are made of them.
pub(super) fn synchronised(registry: &Registry) -> Vec<SyncModality> {
    let devices = registry.devices.iter();
    let modality = devices.map(|device| SyncModality {
        id: device.id,
        when_stale: device.when_stale,
        latency: device.latency,
        capacity: device.depth.saturating_add(RING_SLACK),
    });
    modality.collect()
}
