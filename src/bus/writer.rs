//! A topic's writer: one copy from the driver's buffer into shared memory.

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::LoanError;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::*;
use rapid_core::modality::MAX_MODALITIES;
use rapid_core::sample::SampleHeader;

use super::error::topic_error;
use super::{BusError, EventFactory, Header, Service, TopicFactory, TopicId, TopicSpec};

/// The one writer of a topic.
pub struct Writer {
    topic: String,
    max_bytes: usize,
    publisher: Publisher<Service, [u8], Header>,
    /// First the actuator's, which is the most urgent, then those of all consumers.
    wakes: Vec<Notifier<Service>>,
}

impl std::fmt::Debug for Writer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Writer").field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl Writer {
    /// `own` is the event service of this topic alone, if any.
    pub(super) fn open(
        spec: &TopicSpec,
        factory: &TopicFactory,
        wake: &EventFactory<Service>,
        own: Option<&EventFactory<Service>>,
    ) -> Result<Self, BusError> {
        // A topic that another program kept open from an earlier run may have deeper queues than requested.
        let samples = TopicSpec::pool_for(factory.static_config().subscriber_max_buffer_size().max(spec.depth));
        let publisher = factory
            .publisher_builder()
            .initial_max_slice_len(spec.max_bytes)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(1)
            .override_sample_preallocation(move |_| samples)
            // A reader that does not keep up loses samples; the writer never waits for it.
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|error| topic_error(&spec.name, &error))?;
        let event = match spec.id {
            TopicId::Modality(modality) => Some(modality.index()),
            // Consumers poll the mask; 500 wake-ups a second would be useless to them. Who waits for samples is awake
            // at their observation.
            TopicId::Mask | TopicId::Observation => None,
            TopicId::Action => Some(MAX_MODALITIES),
        };
        let notifiers = own.map(|own| (own, 0)).into_iter().chain(event.map(|event| (wake, event)));
        let wakes = notifiers
            .map(|(service, event)| {
                let notifier = service.notifier_builder().default_event_id(EventId::new(event)).create();
                notifier.map_err(|error| topic_error(&spec.name, &error))
            })
            .collect::<Result<_, _>>()?;
        Ok(Self { topic: spec.name.clone(), max_bytes: spec.max_bytes, publisher, wakes })
    }

    /// Identifies this writer in every sample it publishes.
    pub(super) fn id(&self) -> UniquePublisherId {
        self.publisher.id()
    }

    /// Publishes one sample and wakes the consumers.
    ///
    /// # Errors
    /// When the payload is larger than the topic allows, or the pool is exhausted because a dead subscriber still holds
    /// samples.
    pub fn publish(&self, header: SampleHeader, payload: &[u8]) -> Result<(), BusError> {
        if payload.len() > self.max_bytes {
            let (size, max) = (payload.len(), self.max_bytes);
            return Err(BusError::TooLarge { topic: self.topic.clone(), size, max });
        }
        let mut loan =
            self.publisher.loan_slice_uninit(payload.len()).map_err(|error| self.transfer(&describe(error)))?;
        *loan.user_header_mut() = Header(header);
        let sample = loan.write_from_slice(payload);
        sample.send().map_err(|error| self.transfer(&format!("{error:?}")))?;
        for wake in &self.wakes {
            // A consumer that cannot be woken polls soon after; the sample is not lost.
            let _ = wake.notify();
        }
        Ok(())
    }

    fn transfer(&self, reason: &str) -> BusError {
        BusError::Transfer { topic: self.topic.clone(), reason: reason.to_owned() }
    }
}

fn describe(error: LoanError) -> String {
    match error {
        LoanError::OutOfMemory => "the pool is exhausted: a subscriber holds too many samples".to_owned(),
        other => format!("{other:?}"),
    }
}
