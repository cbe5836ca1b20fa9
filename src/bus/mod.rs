//! The bus: every modality and the mask as a topic in shared memory, open for the whole run.
//!
//! One iceoryx2 node; all topics are opened once from the registry, so that a plug or unplug re-wires
//! nothing. The payload is what the driver gave, the user header a [`SampleHeader`]; any process with
//! an iceoryx2 binding can subscribe. One event service wakes consumers: the event's id is the
//! modality's bit.
//!
//! Invariant: a writer never waits for a reader. A reader that falls `depth` samples behind loses
//! the oldest, and sees the hole in `SampleHeader::seq`.
//! Invariant: payloads lie in pools that are reserved when a topic is opened, and the handle of a
//! loan in memory that is used again (`shared`): once a thread has published a sample, no sample
//! allocates (`tests/stream_alloc.rs`). The locks of a topic's port are its stream's alone.
//! Invariant: writers live as long as the bus. What a reader has not fetched dies with its writer
//! (iceoryx2 0.10), so a writer that went with its device would take the last samples along.

mod actions;
mod inbox;
mod ingress;
mod orders;
mod place;
mod service;
mod shared;
mod topic;
mod writer;

use std::path::PathBuf;
use std::sync::Arc;

use iceoryx2::config::Config;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::event::PortFactory as EventFactory;

use crate::modality::ModalityId;
use crate::registry::{MAX_BORROWED, MAX_SUBSCRIBERS, NodeSpec, Registry};
use crate::sample::SampleHeader;

use service::Service;

pub use actions::Actions;
pub use inbox::{Foreign, Inbox};
pub use ingress::{Given, Ingress, Watch};
pub use orders::give as give_order;
pub use topic::{TopicId, TopicSpec};
pub use writer::Writer;

type TopicFactory = iceoryx2::service::port_factory::publish_subscribe::PortFactory<Service, [u8], SampleHeader>;

/// Name of the event service that wakes consumers.
const WAKE_SERVICE: &str = "/rapid/wake";
/// Processes that may take part at once: `rapid`, and subscribers or publishers of other programs.
const MAX_NODES: usize = 32;

// SAFETY: `SampleHeader` is `repr(C)`, holds only integers, no padding and no pointers.
unsafe impl ZeroCopySend for SampleHeader {
    unsafe fn type_name() -> &'static str {
        // The name under which other languages describe the same 56 bytes.
        "RapidSampleHeader"
    }
}

/// Why the bus cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// A topic could not be opened.
    #[error("topic {topic}: {reason}; if a program of another version still uses it, end that program")]
    Topic {
        /// The topic.
        topic: String,
        /// What iceoryx2 says.
        reason: String,
    },
    /// All places of a topic's subscribers are taken.
    #[error("topic {topic}: {MAX_SUBSCRIBERS} programs subscribe already, and no more may; end one")]
    Full {
        /// The topic.
        topic: String,
    },
    /// What the bus lives in is another user's.
    #[error(
        "shared-memory bus: {}: {what}; end the programs that use it and remove it (`sudo rm -r {}`), or run rapid as \
         that user", path.display(), path.display()
    )]
    Foreign {
        /// Folder or file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The node could not be created.
    #[error("shared-memory bus: {0}")]
    Node(String),
    /// A sample is larger than the topic allows.
    #[error("a sample of {size} bytes does not fit topic {topic} (at most {max}); raise max_bytes of the device")]
    TooLarge {
        /// The topic.
        topic: String,
        /// Bytes of the sample.
        size: usize,
        /// Bytes allowed.
        max: usize,
    },
    /// A sample could not be sent or received.
    #[error("topic {topic}: {reason}")]
    Transfer {
        /// The topic.
        topic: String,
        /// What iceoryx2 says.
        reason: String,
    },
}

/// The node and all its topics.
pub struct Bus {
    // Declared in the order they must be dropped: ports, services, node.
    writers: Vec<(TopicId, Arc<Writer>)>,
    /// None without an actuator.
    actions: Option<Arc<Actions>>,
    topics: Vec<(TopicSpec, TopicFactory)>,
    wake: EventFactory<Service>,
    ingresses: Vec<(ModalityId, Arc<Ingress>)>,
    instance: Option<String>,
    node: Arc<Node<Service>>,
}

impl std::fmt::Debug for Bus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.topics.iter().map(|(spec, _)| spec)).finish()
    }
}

impl Bus {
    /// Opens the node and every topic of `registry`. Shared memory left behind by a killed process
    /// is reclaimed.
    ///
    /// `instance` keeps a second rig on the same machine, or a test, apart from the others.
    ///
    /// # Errors
    /// When a topic is in use with another layout, or shared memory is not to be had.
    pub fn open(registry: &Registry, instance: Option<&str>) -> Result<Self, BusError> {
        let config = config(instance)?;
        place::check(
            // Its path ends in a slash, behind which a link could not be told from what it means.
            &PathBuf::from(config.global.root_path().to_string()).components().collect::<PathBuf>(),
        )?;
        let node = NodeBuilder::new()
            .config(&config)
            // Signals belong to the program, not to a library.
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|error| {
                let prefix = config.global.prefix.to_string();
                place::in_the_way(&prefix).unwrap_or_else(|| BusError::Node(error.to_string()))
            })?;
        let action = registry.actuator().map(|_| TopicSpec::action());
        let specs = registry.devices.iter().map(TopicSpec::of_device).chain([TopicSpec::mask()]).chain(action);
        let topics = specs.map(|spec| open_topic(&node, spec)).collect::<Result<Vec<_>, _>>()?;
        let wake = node
            .service_builder(&service_name(WAKE_SERVICE)?)
            .event()
            .max_notifiers(crate::modality::MAX_MODALITIES + 1 + MAX_NODES)
            .max_listeners(MAX_NODES)
            .max_nodes(MAX_NODES)
            .event_id_max_value(255)
            .open_or_create()
            .map_err(|error| topic_error(WAKE_SERVICE, &error))?;
        let writers = topics
            .iter()
            .map(|(spec, factory)| Ok((spec.id, Arc::new(Writer::open(spec, factory, &wake)?))))
            .collect::<Result<Vec<_>, BusError>>()?;
        let ingresses = registry
            .devices
            .iter()
            .filter(|device| matches!(device.node, NodeSpec::Process(_)))
            .map(|device| Ok((device.id, Arc::new(Ingress::open(&node, device)?))))
            .collect::<Result<Vec<_>, BusError>>()?;
        let actions = topics.iter().find(|(spec, _)| spec.id == TopicId::Action);
        let actions = actions.map(|(spec, factory)| Actions::open(&node, spec, factory).map(Arc::new)).transpose()?;
        let instance = instance.map(str::to_owned);
        Ok(Self { writers, actions, topics, wake, ingresses, instance, node: Arc::new(node) })
    }

    /// What keeps this rig apart from others of the machine, if anything does.
    #[must_use]
    pub fn instance(&self) -> Option<&str> {
        self.instance.as_deref()
    }

    /// Where the program that reads modality `id` publishes; `None` if no program does.
    #[must_use]
    pub fn ingress(&self, id: ModalityId) -> Option<Arc<Ingress>> {
        self.ingresses.iter().find(|(modality, _)| *modality == id).map(|(_, ingress)| Arc::clone(ingress))
    }

    /// What programs need to know to take part in this bus.
    #[must_use]
    pub fn membership(&self) -> Membership {
        Membership { node: Arc::clone(&self.node) }
    }

    /// The one writer of a topic; `None` if the registry has no such topic.
    #[must_use]
    pub fn writer(&self, id: TopicId) -> Option<Arc<Writer>> {
        self.writers.iter().find(|(topic, _)| *topic == id).map(|(_, writer)| Arc::clone(writer))
    }

    /// A consumer of every topic, from now on.
    ///
    /// # Errors
    /// When more programs subscribe than the topics have room for.
    pub fn inbox(&self) -> Result<Inbox, BusError> {
        Inbox::open(&self.topics, self.writers.iter().map(|(_, writer)| writer.as_ref()), &self.wake)
    }

    /// What the actuator is told; `None` without an actuator in the registry.
    #[must_use]
    pub fn actions(&self) -> Option<Arc<Actions>> {
        self.actions.clone()
    }

    /// Bytes of shared memory that the pools of all topics reserve.
    #[must_use]
    pub fn reserved_bytes(&self) -> u64 {
        self.topics.iter().map(|(spec, _)| spec.pool_bytes()).sum()
    }
}

/// Who takes part in the bus.
#[derive(Clone)]
pub struct Membership {
    node: Arc<Node<Service>>,
}

impl std::fmt::Debug for Membership {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Membership").field("prefix", &self.prefix()).finish()
    }
}

impl Membership {
    /// iceoryx2's `global.prefix` of this bus: a program with another one is on another bus.
    #[must_use]
    pub fn prefix(&self) -> String {
        self.node.config().global.prefix.to_string()
    }

    /// Gives back what programs that were killed held of the bus: shared memory, their places at
    /// topics. Blocks for as long as files are looked through.
    pub fn sweep(&self) {
        let _ = self.node.try_cleanup_dead_nodes();
    }
}

fn config(instance: Option<&str>) -> Result<Config, BusError> {
    let mut config = Config::global_config().clone();
    if let Some(instance) = instance {
        let prefix = format!("iox2_{instance}_");
        config.global.prefix = FileName::new(prefix.as_bytes())
            .map_err(|error| BusError::Node(format!("instance name {instance:?}: {error:?}")))?;
    }
    Ok(config)
}

fn open_topic(node: &Node<Service>, spec: TopicSpec) -> Result<(TopicSpec, TopicFactory), BusError> {
    let factory = node
        .service_builder(&service_name(&spec.name)?)
        .publish_subscribe::<[u8]>()
        .user_header::<SampleHeader>()
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

fn service_name(name: &str) -> Result<ServiceName, BusError> {
    ServiceName::new(name).map_err(|error| topic_error(name, &error))
}

fn topic_error(topic: &str, error: &dyn std::fmt::Debug) -> BusError {
    BusError::Topic { topic: topic.to_owned(), reason: format!("{error:?}") }
}

#[cfg(test)]
mod tests;
