//! An ingress: the topic on which a program of the rig publishes for one modality.
//!
//! It is separate from the modality's own topic and never reaches a consumer: the rig validates these samples and the
//! topic's one writer republishes them. An event service of the same name wakes the rig; programs that do not notify
//! are polled every [`LOOK`].
//!
//! Invariant: at most `depth` samples are queued; the oldest are dropped.
//! Invariant: a header is copied before it is examined: its program can still write to it.

use std::os::fd::{AsRawFd, RawFd};
use std::sync::Arc;
use std::time::Duration;

use iceoryx2::port::listener::Listener;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use rapid_core::sample::SampleHeader;
use rapid_registry::DeviceSpec;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::error::topic_error;
use super::{BusError, Header, MAX_NODES, Service, service_name};

/// Prefix of an ingress topic's name; the modality's topic follows.
const PREFIX: &str = "/rapid/ingress";
/// The longest time that a sample without a notification waits.
const LOOK: Duration = Duration::from_millis(10);
/// A successor may start before the slot of a dead program is released.
const PUBLISHERS: usize = 4;
/// Queue depth: the rig fetches each sample at once, and the pool is the program's memory.
const DEPTH: usize = 256;
/// The same for samples of more than [`LARGE`] bytes.
const DEPTH_OF_LARGE: usize = 16;
const LARGE: usize = 64 << 10;

/// See the module's comment.
pub struct Ingress {
    topic: String,
    depth: usize,
    subscriber: Subscriber<Service, [u8], Header>,
    listener: Listener<Service>,
}

impl std::fmt::Debug for Ingress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Ingress").field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl Ingress {
    pub(super) fn open(node: &Node<Service>, device: &DeviceSpec) -> Result<Self, BusError> {
        let topic = format!("{PREFIX}{}", device.topic);
        let depth = if device.max_bytes > LARGE { DEPTH_OF_LARGE } else { DEPTH }.min(device.depth);
        let name = service_name(&topic)?;
        let failed = |error: &dyn std::fmt::Debug| topic_error(&topic, error);
        let samples = node
            .service_builder(&name)
            .publish_subscribe::<[u8]>()
            .user_header::<Header>()
            .max_publishers(PUBLISHERS)
            .max_subscribers(1)
            .max_nodes(MAX_NODES)
            .subscriber_max_buffer_size(depth)
            .subscriber_max_borrowed_samples(2)
            .history_size(0)
            .enable_safe_overflow(true)
            .open_or_create()
            .map_err(|error| failed(&error))?;
        let subscriber = samples.subscriber_builder().buffer_size(depth).create().map_err(|error| failed(&error))?;
        let wake = node
            .service_builder(&name)
            .event()
            .max_notifiers(PUBLISHERS)
            .max_listeners(1)
            .max_nodes(MAX_NODES)
            .open_or_create()
            .map_err(|error| failed(&error))?;
        let listener = wake.listener_builder().create().map_err(|error| failed(&error))?;
        Ok(Self { topic, depth, subscriber, listener })
    }

    /// Where the program publishes.
    pub fn topic(&self) -> &str {
        &self.topic
    }

    /// The oldest queued sample.
    ///
    /// # Errors
    /// When the topic cannot be read.
    pub fn receive(&self) -> Result<Option<Given>, BusError> {
        match self.subscriber.receive() {
            Ok(sample) => Ok(sample.map(|sample| Given { header: sample.user_header().0, sample })),
            Err(error) => Err(BusError::Transfer { topic: self.topic.clone(), reason: format!("{error:?}") }),
        }
    }

    /// Discards all queued samples.
    pub fn clear(&self) {
        // Bounded: a program that publishes meanwhile must not hold up the caller.
        for _ in 0..2 * self.depth {
            if !matches!(self.receive(), Ok(Some(_))) {
                return;
            }
        }
    }

    /// Waits for samples; needs tokio's I/O.
    ///
    /// # Errors
    /// When the system cannot watch the event service.
    pub fn watch(self: &Arc<Self>) -> Result<Arrivals, BusError> {
        let descriptor = Descriptor(Arc::clone(self));
        // SAFETY: it keeps the owner of the descriptor alive, and always names the same one.
        let descriptor = unsafe { AsyncFd::register_with_interest(descriptor, Interest::READABLE) };
        Ok(Arrivals { descriptor: descriptor.map_err(|error| topic_error(&self.topic, &error))? })
    }
}

/// A sample as its program published it; nothing in it has been checked.
pub struct Given {
    header: SampleHeader,
    sample: Sample<Service, [u8], Header>,
}

impl std::fmt::Debug for Given {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Given").field("header", &self.header).finish_non_exhaustive()
    }
}

impl Given {
    /// The header as it was when the sample was taken.
    pub const fn header(&self) -> &SampleHeader {
        &self.header
    }

    /// The payload.
    pub fn bytes(&self) -> &[u8] {
        self.sample.payload()
    }
}

/// Wakes the reader of an ingress.
#[derive(Debug)]
pub struct Arrivals {
    descriptor: AsyncFd<Descriptor>,
}

impl Arrivals {
    /// Returns when a sample may have arrived, at the latest after `LOOK`. Cancel-safe.
    pub async fn wait(&self) {
        let Ok(Ok(mut ready)) = tokio::time::timeout(LOOK, self.descriptor.readable()).await else { return };
        // Samples announced here were published before; the caller looks next.
        if !matches!(self.descriptor.get_ref().0.listener.try_wait(|_| {}), Ok(1..)) {
            ready.clear_ready();
        }
    }
}

/// The event service's socket.
#[derive(Debug)]
struct Descriptor(Arc<Ingress>);

impl AsRawFd for Descriptor {
    fn as_raw_fd(&self) -> RawFd {
        // SAFETY: the descriptor belongs to the listener, which lives as long as `self` and does not close or replace
        // it before then; it is only watched here.
        unsafe { self.0.listener.file_descriptor().native_handle() }
    }
}
