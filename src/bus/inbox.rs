//! The topics of the rig for one consumer: their queues, and an inbox, which can also wait for samples.
//!
//! Any program of the same user may publish on the rig's topics; iceoryx2 names the publisher of every sample.
//!
//! Invariant: on the topic of a modality and of the mask, only samples of their one writer are handed over. Samples of
//! other programs are counted and dropped.
//! Invariant: actions of other programs are handed over, so that an episode contains them. They are counted once this
//! process, which runs a policy, has published one; the actuator then ignores them ([`super::Actions`]).

use std::cell::Cell;
use std::ops::Deref;
use std::time::Duration;

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::unique_id_generator::unique_system_id::UniqueSystemId;
use rapid_core::sample::SampleHeader;

use super::error::topic_error;
use super::{BusError, EventFactory, Header, Service, TopicFactory, TopicId, TopicSpec, Writer};

/// The samples of every topic but that of observations, which this process makes for others. They wait in shared memory
/// until they are drained.
pub struct Queues {
    topics: Vec<Subscription>,
}

/// A consumer of these samples that can wait for them.
pub struct Inbox {
    queues: Queues,
    wake: Listener<Service>,
}

/// The samples of one topic, for one consumer.
pub struct Subscription {
    id: TopicId,
    name: String,
    /// Maximum number of samples in the queue.
    depth: usize,
    subscriber: Subscriber<Service, [u8], Header>,
    /// Publisher id of the topic's one writer.
    writer: UniquePublisherId,
    /// The writer has published since this inbox was opened.
    is_written: Cell<bool>,
    /// The last foreign publisher and its number of samples since the last report.
    other: Cell<Option<(UniquePublisherId, u64)>>,
}

/// Samples of another program on a topic of the rig.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Foreign<'a> {
    /// The topic's name.
    pub topic: &'a str,
    /// Process that published them.
    pub process: u32,
    /// Number of samples since the last report.
    pub samples: u64,
}

impl Subscription {
    pub(super) fn open(spec: &TopicSpec, factory: &TopicFactory, writer: &Writer) -> Result<Self, BusError> {
        let subscriber =
            factory.subscriber_builder().buffer_size(spec.depth).create().map_err(|error| match error {
                SubscriberCreateError::ExceedsMaxSupportedSubscribers => BusError::Full { topic: spec.name.clone() },
                other => topic_error(&spec.name, &other),
            })?;
        Ok(Self {
            id: spec.id,
            name: spec.name.clone(),
            depth: spec.depth,
            subscriber,
            writer: writer.id(),
            is_written: Cell::new(false),
            other: Cell::new(None),
        })
    }

    /// Whether this publisher belongs to another program.
    fn is_foreign(&self, publisher: UniquePublisherId) -> bool {
        if publisher == self.writer {
            self.is_written.set(true);
            return false;
        }
        // Actions come from other programs, unless a policy runs here.
        let is_foreign = self.id != TopicId::Action || self.is_written.get();
        if is_foreign {
            let samples = self.other.get().map_or(0, |(_, samples)| samples);
            self.other.set(Some((publisher, samples.saturating_add(1))));
        }
        is_foreign
    }
}

impl std::fmt::Debug for Subscription {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Subscription").field(&self.name).finish()
    }
}

impl std::fmt::Debug for Queues {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.topics.iter().map(|topic| &topic.name)).finish()
    }
}

impl std::fmt::Debug for Inbox {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.queues.fmt(f)
    }
}

impl Inbox {
    pub(super) fn open(queues: Queues, wake: &EventFactory<Service>) -> Result<Self, BusError> {
        let wake = wake.listener_builder().create().map_err(|error| topic_error(super::WAKE_SERVICE, &error))?;
        Ok(Self { queues, wake })
    }

    /// Blocks until a modality is published, `timeout` passes, or the process is continued after a stop. The mask alone
    /// wakes no inbox.
    ///
    /// # Errors
    /// When the event service is broken.
    pub fn wait(&self, timeout: Duration) -> Result<(), BusError> {
        match self.wake.timed_wait(|_| {}, timeout) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
            Err(error) => Err(topic_error(super::WAKE_SERVICE, &error)),
        }
    }
}

impl Inbox {
    /// [`Queues::add`].
    pub fn add(&mut self, subscription: Subscription) {
        self.queues.add(subscription);
    }
}

impl Deref for Inbox {
    type Target = Queues;

    fn deref(&self) -> &Queues {
        &self.queues
    }
}

impl Queues {
    /// `writers` has the same order as `topics`.
    pub(super) fn open<'a>(
        topics: &[(TopicSpec, TopicFactory)],
        writers: impl Iterator<Item = &'a Writer>,
    ) -> Result<Self, BusError> {
        let subscribe = |((spec, factory), writer): (&(TopicSpec, TopicFactory), &Writer)| {
            Subscription::open(spec, factory, writer)
        };
        let is_consumed = |((spec, _), _): &(&(TopicSpec, _), _)| spec.id != TopicId::Observation;
        let topics =
            topics.iter().zip(writers).filter(is_consumed).map(subscribe).collect::<Result<Vec<_>, BusError>>()?;
        Ok(Self { topics })
    }

    /// Adds a topic that was opened later. Its samples are handed over before those of mask and actions, like those of
    /// other modalities.
    pub fn add(&mut self, subscription: Subscription) {
        let is_modality = |topic: &Subscription| matches!(topic.id, TopicId::Modality(_));
        let at = self.topics.iter().position(|topic| !is_modality(topic)).unwrap_or(self.topics.len());
        self.topics.insert(at, subscription);
    }

    /// Hands over every sample that is queued at the time of the call, oldest first within a topic; the bytes are
    /// borrowed from shared memory for the call. It terminates however fast samples are published.
    ///
    /// # Errors
    /// The first topic that cannot be read; the others are still handed over.
    pub fn drain(&self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), BusError> {
        self.drain_some(usize::MAX, take).1
    }

    /// The same, but at most `most` samples of each topic; whether there may be more of one that can be read. For a thread with
    /// other work, which must not wait until the longest queue is empty.
    ///
    /// # Errors
    /// As [`Self::drain`].
    pub fn drain_some(
        &self,
        most: usize,
        take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8]),
    ) -> (bool, Result<(), BusError>) {
        let (mut is_more, mut result) = (false, Ok(()));
        for topic in &self.topics {
            // No more than this are queued at any time: a topic that is filled faster than `take` empties it must not
            // hold up the others or the caller.
            let most = most.min(topic.depth);
            for number in 1..=most {
                match topic.subscriber.receive() {
                    Ok(Some(sample)) => {
                        if !topic.is_foreign(sample.header().publisher_id()) || topic.id == TopicId::Action {
                            take(topic.id, sample.user_header(), sample.payload());
                        }
                        is_more |= number == most;
                    }
                    Ok(None) => break,
                    Err(error) => {
                        let (topic, reason) = (topic.name.clone(), format!("{error:?}"));
                        result = result.and(Err(BusError::Transfer { topic, reason }));
                        break;
                    }
                }
            }
        }
        (is_more, result)
    }

    /// Reports which other programs have published on the rig's topics since the last call, as far as drained.
    pub fn foreign(&self, take: &mut dyn FnMut(Foreign<'_>)) {
        for topic in &self.topics {
            let Some((publisher, samples)) = topic.other.take() else { continue };
            let process = UniqueSystemId::from(publisher.value()).pid().value();
            take(Foreign { topic: &topic.name, process: u32::try_from(process).unwrap_or(0), samples });
        }
    }
}
