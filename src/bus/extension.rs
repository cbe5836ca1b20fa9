//! A topic that is opened during a run, for an entry that is added to the registry.
//!
//! Invariant: as for the topics of the start: all its memory is reserved before anything uses it.

use std::sync::Arc;

use rapid_registry::DeviceSpec;

use super::home::Home;
use super::inbox::Subscription;
use super::topic::TopicSpec;
use super::{BusError, TopicFactory, WAKE_NOTIFIERS, WAKE_SERVICE, Writer, error, open_topic, open_wake, space};

/// See the module's comment. It must live as long as the run: samples that a reader has not fetched are lost with it.
pub struct Extension {
    // Declared in the order they must be dropped: port, service, node.
    writer: Arc<Writer>,
    topic: (TopicSpec, TopicFactory),
    home: Arc<Home>,
}

impl std::fmt::Debug for Extension {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Extension").field(&self.topic.0).finish()
    }
}

impl Extension {
    pub(super) fn open(home: &Arc<Home>, device: &DeviceSpec) -> Result<Self, BusError> {
        let spec = TopicSpec::of_device(device);
        space::check(spec.room())?;
        error::addresses(spec.room())?;
        let open = || {
            let topic = open_topic(home.node(), spec)?;
            let wake = open_wake(home.node(), WAKE_SERVICE, WAKE_NOTIFIERS)?;
            let writer = Arc::new(Writer::open(&topic.0, &topic.1, &wake, None)?);
            Ok(Self { writer, topic, home: Arc::clone(home) })
        };
        open().map_err(|error| home.explain(error))
    }

    /// Its one writer.
    pub fn writer(&self) -> Arc<Writer> {
        Arc::clone(&self.writer)
    }

    /// Its samples from now on, for one consumer.
    ///
    /// # Errors
    /// When the topic has no free slot for another subscriber, or the system lacks memory or descriptors.
    pub fn subscribe(&self) -> Result<Subscription, BusError> {
        let (spec, factory) = &self.topic;
        Subscription::open(spec, factory, &self.writer).map_err(|error| self.home.explain(error))
    }
}
