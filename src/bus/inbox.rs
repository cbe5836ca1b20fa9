//! An inbox: every topic of the rig, for one consumer.

use std::time::Duration;

use iceoryx2::port::listener::Listener;
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};

use super::{BusError, EventFactory, Service, TopicFactory, TopicId, TopicSpec, topic_error};
use crate::sample::SampleHeader;

/// A consumer of every topic. Samples wait in shared memory until they are drained.
pub struct Inbox {
    topics: Vec<Subscription>,
    wake: Listener<Service>,
}

struct Subscription {
    id: TopicId,
    name: String,
    /// Samples that can wait here.
    depth: usize,
    subscriber: Subscriber<Service, [u8], SampleHeader>,
}

impl std::fmt::Debug for Inbox {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.topics.iter().map(|topic| &topic.name)).finish()
    }
}

impl Inbox {
    pub(super) fn open(topics: &[(TopicSpec, TopicFactory)], wake: &EventFactory<Service>) -> Result<Self, BusError> {
        let subscribe = |(spec, factory): &(TopicSpec, TopicFactory)| {
            let subscriber =
                factory.subscriber_builder().buffer_size(spec.depth).create().map_err(|error| match error {
                    SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                        BusError::Full { topic: spec.name.clone() }
                    }
                    other => topic_error(&spec.name, &other),
                })?;
            Ok(Subscription { id: spec.id, name: spec.name.clone(), depth: spec.depth, subscriber })
        };
        let topics = topics.iter().map(subscribe).collect::<Result<Vec<_>, BusError>>()?;
        let wake = wake.listener_builder().create().map_err(|error| topic_error(super::WAKE_SERVICE, &error))?;
        Ok(Self { topics, wake })
    }

    /// Blocks until a modality was published or `timeout` passed, whichever is first. The mask alone
    /// wakes nobody.
    ///
    /// # Errors
    /// When the event service is broken.
    pub fn wait(&self, timeout: Duration) -> Result<(), BusError> {
        self.wake.timed_wait(|_| {}, timeout).map(|_| ()).map_err(|error| topic_error(super::WAKE_SERVICE, &error))
    }

    /// Hands over every sample that waits at the time of the call, oldest first within a topic; the
    /// bytes are lent from shared memory for the call. Ends however fast more are published.
    ///
    /// # Errors
    /// The first topic that cannot be read; the others are handed over all the same.
    pub fn drain(&self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), BusError> {
        let mut result = Ok(());
        for topic in &self.topics {
            // No more than this wait at any time: a topic that is filled faster than `take` empties
            // it must not keep the others, or the caller, waiting.
            for _ in 0..topic.depth {
                match topic.subscriber.receive() {
                    Ok(Some(sample)) => take(topic.id, sample.user_header(), sample.payload()),
                    Ok(None) => break,
                    Err(error) => {
                        let (topic, reason) = (topic.name.clone(), format!("{error:?}"));
                        result = result.and(Err(BusError::Transfer { topic, reason }));
                        break;
                    }
                }
            }
        }
        result
    }
}
