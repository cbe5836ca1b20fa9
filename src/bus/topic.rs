//! Topics: name, depth and memory of each, derived once from the registry.

use rapid_core::action::{ACTION_TOPIC, MAX_ACTION};
use rapid_core::mask::{MASK_TOPIC, PAYLOAD_LEN};
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::observation::{HEAD_BYTES, OBSERVATION_TOPIC, SLOT_BYTES};
use rapid_registry::{DeviceSpec, MAX_SUBSCRIBERS, POOL_SPARE};

use super::space::BOOKS;

/// 4 s of mask at 500 Hz: how long a consumer may be held up without losing a sample.
const MASK_DEPTH: usize = 2048;
/// 2 s of actions at 200 Hz, twice the rate of the fastest policy.
const ACTION_DEPTH: usize = 400;

/// 2 s of observations at 30 Hz.
const OBSERVATION_DEPTH: usize = 64;

/// Identifies a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TopicId {
    /// Samples of a modality.
    Modality(ModalityId),
    /// The physical mask.
    Mask,
    /// Observations, for other programs.
    Observation,
    /// Actions for the actuator; exists only with an actuator in the registry.
    Action,
}

/// Specification of a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicSpec {
    /// Its identity.
    pub id: TopicId,
    /// Service name.
    pub name: String,
    /// Samples a subscriber may fall behind.
    pub depth: usize,
    /// Largest payload in bytes.
    pub max_bytes: usize,
}

impl TopicSpec {
    pub(super) fn of_device(device: &DeviceSpec) -> Self {
        Self {
            id: TopicId::Modality(device.id),
            name: device.topic.clone(),
            depth: device.depth,
            max_bytes: device.max_bytes,
        }
    }

    pub(super) fn mask() -> Self {
        Self { id: TopicId::Mask, name: MASK_TOPIC.to_owned(), depth: MASK_DEPTH, max_bytes: PAYLOAD_LEN }
    }

    /// Of as many devices as there can be: some may be added during the run.
    pub(super) fn observation() -> Self {
        let max_bytes = HEAD_BYTES + MAX_MODALITIES * SLOT_BYTES;
        Self { id: TopicId::Observation, name: OBSERVATION_TOPIC.to_owned(), depth: OBSERVATION_DEPTH, max_bytes }
    }

    pub(super) fn action() -> Self {
        let max_bytes = MAX_ACTION * size_of::<f64>();
        Self { id: TopicId::Action, name: ACTION_TOPIC.to_owned(), depth: ACTION_DEPTH, max_bytes }
    }

    /// Samples in the pool, for queues of `depth`.
    pub(super) fn pool_samples(&self) -> usize {
        Self::pool_for(self.depth)
    }

    /// Samples in a pool that is never exhausted.
    ///
    /// Each subscriber's queue holds at most the newest `depth` samples, so all queues together hold no more than
    /// `depth` different ones; in addition each subscriber may hold a few, and the writer one. iceoryx2's own bound
    /// assumes that every queue holds different samples.
    pub(super) const fn pool_for(depth: usize) -> usize {
        depth + POOL_SPARE
    }

    /// Maximum bytes of shared memory that the topic takes with its maximum number of subscribers.
    pub(super) fn room(&self) -> u64 {
        /// iceoryx2's overhead per sample, with alignment.
        const SAMPLE: u64 = 64;
        /// iceoryx2's overhead per sample that is queued for, or borrowed by, one subscriber.
        const WAITING: u64 = 24;
        let samples = self.pool_samples() as u64;
        let waiting = samples.saturating_mul(WAITING * MAX_SUBSCRIBERS as u64);
        self.pool_bytes().saturating_add(samples.saturating_mul(SAMPLE)).saturating_add(waiting).saturating_add(BOOKS)
    }

    /// Bytes of the pool.
    pub fn pool_bytes(&self) -> u64 {
        let sample = self.max_bytes + size_of::<rapid_core::sample::SampleHeader>();
        (self.pool_samples() as u64).saturating_mul(sample as u64)
    }
}
