//! The bus: every modality and the mask as a topic in shared memory, open for the whole run.
//!
//! One iceoryx2 node; all topics of the registry are opened once, so that a plug or unplug reconnects nothing. The
//! payload is the driver's data, the user header a [`SampleHeader`]; any process with an iceoryx2 binding can
//! subscribe. One event service wakes consumers: the event's id is the modality's bit. The topic of actions has an
//! event service of its own, which wakes only the actuator.
//!
//! Invariant: a writer never waits for a reader. A reader that falls `depth` samples behind loses
//! the oldest, and sees the hole in `SampleHeader::seq`.
//! Invariant: payloads lie in pools that are reserved when a topic is opened, and the handle of a loan in reused memory
//! (`shared`): once a thread has published a sample, no sample allocates (`tests/memory/stream_alloc.rs`). Only a
//! topic's own stream takes the locks of its port.
//! Invariant: every segment of this program has all its memory from its creation (`space`). A program of this user that
//! truncates one, or overwrites iceoryx2's tables in it, ends this process. Nothing of the bus is writable by others,
//! and nothing outlives the processes that use it (`stale_files`).

mod actions;
mod error;
mod extension;
mod home;
mod inbox;
mod ingress;
mod paths;
#[cfg(test)]
#[path = "../../tests/support/patience.rs"]
mod patience;
mod service;
mod shared;
#[cfg(test)]
#[path = "../../tests/support/skip.rs"]
mod skip;
mod space;
mod stale_files;
mod topic;
mod writer;

use std::ops::Deref;
use std::sync::Arc;

use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::event::PortFactory as EventFactory;
use rapid_core::modality::ModalityId;
use rapid_core::sample::SampleHeader;
use rapid_registry::{DeviceSpec, MAX_BORROWED, MAX_SUBSCRIBERS, NodeSpec, Registry};

use error::topic_error;
use home::Home;
use service::Service;

pub use actions::{Actions, watch};
pub use error::BusError;
pub use extension::Extension;
pub use inbox::{Foreign, Inbox, Queues, Subscription};
pub use ingress::{Arrivals, Given, Ingress};
pub use paths::memory as check_memory;
pub use topic::{TopicId, TopicSpec};
pub use writer::Writer;

type TopicFactory = iceoryx2::service::port_factory::publish_subscribe::PortFactory<Service, [u8], Header>;

/// Name of the event service that wakes consumers.
const WAKE_SERVICE: &str = "/rapid/wake";
/// A notifier for each modality and for actions, and those of other programs.
const WAKE_NOTIFIERS: usize = rapid_core::modality::MAX_MODALITIES + 1 + MAX_NODES;
/// Maximum number of processes on the bus: `rapid`, and subscribers or publishers of other programs.
const MAX_NODES: usize = 32;

/// Address space that a run needs besides the bus: stacks and heaps of its threads.
const OTHER_ADDRESSES: u64 = 512 << 20;

/// A [`SampleHeader`] as the user header of a topic.
#[derive(Debug, Clone, Copy, Default)]
#[repr(transparent)]
pub struct Header(pub SampleHeader);

// SAFETY: `SampleHeader` is `repr(C)`, holds only integers, no padding and no pointers.
unsafe impl ZeroCopySend for Header {
    unsafe fn type_name() -> &'static str {
        // The name under which other languages describe the same 56 bytes.
        "RapidSampleHeader"
    }
}

impl Deref for Header {
    type Target = SampleHeader;

    fn deref(&self) -> &SampleHeader {
        &self.0
    }
}

/// The node and all its topics. No topic is closed during a run; one is opened for an entry that is added ([`Extension`]).
pub struct Bus {
    // Declared in the order they must be dropped: ports, services, node.
    /// They live as long as the bus. Samples that a reader has not fetched are lost with their writer (iceoryx2 0.10), so a
    /// writer that ended with its device would take the last samples along.
    writers: Vec<(TopicId, Arc<Writer>)>,
    /// `None` without an actuator.
    actions: Option<Arc<Actions>>,
    topics: Vec<(TopicSpec, TopicFactory)>,
    wake: EventFactory<Service>,
    ingresses: Vec<(ModalityId, Arc<Ingress>)>,
    instance: Option<String>,
    home: Arc<Home>,
}

impl std::fmt::Debug for Bus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.topics.iter().map(|(spec, _)| spec)).finish()
    }
}

impl Bus {
    /// Removes the files of other instances than `instance` that have no live process, which frees their memory for
    /// this one. Blocks while it scans the files.
    pub fn clear_others(instance: Option<&str>) {
        home::clear_others(instance);
    }

    /// Opens the node and every topic of `registry`, with space in shared memory for all of them. Removes the files of
    /// killed processes.
    ///
    /// `instance` separates a second rig on the same machine, or a test, from the others.
    ///
    /// # Errors
    /// When a topic is in use with another layout, a file of the bus is damaged, or the system lacks memory or
    /// descriptors.
    pub fn open(registry: &Registry, instance: Option<&str>) -> Result<Self, BusError> {
        let specs: Vec<_> = specs(registry).collect();
        let need = specs.iter().map(TopicSpec::room).fold(space::BOOKS, u64::saturating_add);
        error::addresses(need.saturating_add(OTHER_ADDRESSES))?;
        let home = Arc::new(Home::open(instance, need)?);
        Self::open_at(&home, registry, specs, instance).map_err(|error| home.explain(error))
    }

    fn open_at(
        home: &Arc<Home>,
        registry: &Registry,
        specs: Vec<TopicSpec>,
        instance: Option<&str>,
    ) -> Result<Self, BusError> {
        let node = home.node();
        let topics = specs.into_iter().map(|spec| open_topic(node, spec)).collect::<Result<Vec<_>, _>>()?;
        let wake = open_wake(node, WAKE_SERVICE, WAKE_NOTIFIERS)?;
        let action = topics.iter().find(|(spec, _)| spec.id == TopicId::Action);
        let action = action.map(|topic| Ok((topic, open_wake(node, &topic.0.name, MAX_NODES)?))).transpose()?;
        let writers = topics
            .iter()
            .map(|(spec, factory)| {
                let own = action.as_ref().filter(|(topic, _)| topic.0.id == spec.id).map(|(_, wake)| wake);
                Ok((spec.id, Arc::new(Writer::open(spec, factory, &wake, own)?)))
            })
            .collect::<Result<Vec<_>, BusError>>()?;
        let ingresses = registry
            .devices
            .iter()
            .filter(|device| matches!(device.node, NodeSpec::Process(_)))
            .map(|device| Ok((device.id, Arc::new(Ingress::open(node, device)?))))
            .collect::<Result<Vec<_>, BusError>>()?;
        let writer = writers.iter().find(|(id, _)| *id == TopicId::Action);
        let actions = action
            .zip(writer)
            .map(|(((spec, factory), wake), (_, writer))| Actions::open(spec, factory, &wake, writer).map(Arc::new))
            .transpose()?;
        let instance = instance.map(str::to_owned);
        Ok(Self { writers, actions, topics, wake, ingresses, instance, home: Arc::clone(home) })
    }

    /// The instance that separates this rig from others on the machine, if any.
    pub fn instance(&self) -> Option<&str> {
        self.instance.as_deref()
    }

    /// Where the program that reads modality `id` publishes; `None` if no program does.
    pub fn ingress(&self, id: ModalityId) -> Option<Arc<Ingress>> {
        self.ingresses.iter().find(|(modality, _)| *modality == id).map(|(_, ingress)| Arc::clone(ingress))
    }

    /// What programs need to know to take part in this bus.
    pub fn membership(&self) -> Membership {
        Membership { home: Arc::clone(&self.home) }
    }

    /// The one writer of a topic; `None` if the registry has no such topic.
    pub fn writer(&self, id: TopicId) -> Option<Arc<Writer>> {
        self.writers.iter().find(|(topic, _)| *topic == id).map(|(_, writer)| Arc::clone(writer))
    }

    /// A consumer of every topic, starting now.
    ///
    /// # Errors
    /// When the topics have no free slot for another subscriber.
    pub fn inbox(&self) -> Result<Inbox, BusError> {
        let queues = self.queues()?;
        Inbox::open(queues, &self.wake)
    }

    /// The same for a consumer that never waits for samples, and that no sample wakes.
    ///
    /// # Errors
    /// As [`Self::inbox`].
    pub fn queues(&self) -> Result<Queues, BusError> {
        Queues::open(&self.topics, self.writers.iter().map(|(_, writer)| writer.as_ref()))
    }

    /// The observations from now on, which are in no [`Queues`] by themselves.
    ///
    /// # Errors
    /// As [`Self::inbox`].
    pub fn observations(&self) -> Result<Option<Subscription>, BusError> {
        let mut topics = self.topics.iter().zip(&self.writers);
        let topic = topics.find(|((spec, _), _)| spec.id == TopicId::Observation);
        let Some(((spec, factory), (_, writer))) = topic else { return Ok(None) };
        Subscription::open(spec, factory, writer).map(Some)
    }

    /// Actions for the actuator; `None` without an actuator in the registry.
    pub fn actions(&self) -> Option<Arc<Actions>> {
        self.actions.clone()
    }

    /// Bytes of shared memory that the pools of all topics reserve.
    pub fn reserved_bytes(&self) -> u64 {
        self.topics.iter().map(|(spec, _)| spec.pool_bytes()).sum()
    }
}

/// What a program needs to join the bus.
#[derive(Clone)]
pub struct Membership {
    home: Arc<Home>,
}

impl std::fmt::Debug for Membership {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Membership").field("prefix", &self.prefix()).finish()
    }
}

impl Membership {
    /// iceoryx2's `global.root_path` of this bus: usually its default; another one if another user has that.
    pub fn root(&self) -> String {
        self.home.node().config().global.root_path().to_string()
    }

    /// iceoryx2's `global.prefix` of this bus: a program with another prefix is on another bus.
    pub fn prefix(&self) -> String {
        self.home.node().config().global.prefix.to_string()
    }

    /// Opens the topic of an added entry, as [`Bus::open`] does those of the registry. Blocks while the system reserves
    /// its memory.
    ///
    /// # Errors
    /// When the topic is in use with another layout, or the system lacks memory or descriptors; then nothing is left
    /// of it.
    pub fn extend(&self, device: &DeviceSpec) -> Result<Extension, BusError> {
        Extension::open(&self.home, device)
    }

    /// Releases what killed programs held of the bus: shared memory and subscriber slots. Blocks while it scans the
    /// files.
    pub fn sweep(&self) {
        self.home.sweep();
    }
}

/// The topics of a rig.
fn specs(registry: &Registry) -> impl Iterator<Item = TopicSpec> {
    let action = registry.actuator().map(|_| TopicSpec::action());
    let own = [TopicSpec::mask(), TopicSpec::observation()];
    registry.devices.iter().map(TopicSpec::of_device).chain(own).chain(action)
}

fn open_topic(node: &Node<Service>, spec: TopicSpec) -> Result<(TopicSpec, TopicFactory), BusError> {
    let factory = node
        .service_builder(&service_name(&spec.name)?)
        .publish_subscribe::<[u8]>()
        .user_header::<Header>()
        .max_publishers(2)
        .max_subscribers(MAX_SUBSCRIBERS)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(spec.depth)
        .subscriber_max_borrowed_samples(MAX_BORROWED)
        .history_size(0)
        .enable_safe_overflow(true)
        .open_or_create()
        .map_err(|error| topic_error(&spec.name, &error))?;
    Ok((spec, factory))
}

/// Opens an event service of that name.
fn open_wake(node: &Node<Service>, name: &str, notifiers: usize) -> Result<EventFactory<Service>, BusError> {
    let service = node
        .service_builder(&service_name(name)?)
        .event()
        .max_notifiers(notifiers)
        .max_listeners(MAX_NODES)
        .max_nodes(MAX_NODES)
        .event_id_max_value(255)
        .open_or_create();
    service.map_err(|error| topic_error(name, &error))
}

fn service_name(name: &str) -> Result<ServiceName, BusError> {
    ServiceName::new(name).map_err(|error| topic_error(name, &error))
}

#[cfg(test)]
mod tests;
