//! Orders to the actuator from other programs: topic `/rapid/arm`, one byte, 1 to arm and 0 to disarm.

use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::{BusError, MAX_NODES, Service, config, service_name, topic_error};
use crate::action::Order;

/// The topic.
const TOPIC: &str = "/rapid/arm";
/// Orders that may wait.
const DEPTH: usize = 8;

/// Their receiver.
pub(super) struct Orders {
    subscriber: Subscriber<Service, u8, ()>,
}

impl Orders {
    pub(super) fn open(node: &Node<Service>) -> Result<Self, BusError> {
        let subscriber = service(node)?.subscriber_builder().create();
        Ok(Self { subscriber: subscriber.map_err(|error| topic_error(TOPIC, &error))? })
    }

    /// The oldest that waits. What is neither order is none.
    pub(super) fn next(&self) -> Option<Order> {
        loop {
            match *self.subscriber.receive().ok()?? {
                0 => return Some(Order::Disarm),
                1 => return Some(Order::Arm),
                _ => {}
            }
        }
    }
}

fn service(node: &Node<Service>) -> Result<PortFactory<Service, u8, ()>, BusError> {
    node.service_builder(&service_name(TOPIC)?)
        .publish_subscribe::<u8>()
        .max_publishers(DEPTH)
        .max_subscribers(1)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(DEPTH)
        .history_size(0)
        .enable_safe_overflow(true)
        .open_or_create()
        .map_err(|error| topic_error(TOPIC, &error))
}

/// Gives an order to the actuator of the `rapid` that runs as `instance`. Says whether one is there to take
/// it.
///
/// # Errors
/// When the bus cannot be used.
pub fn give(instance: Option<&str>, order: Order) -> Result<bool, BusError> {
    let node = NodeBuilder::new()
        .config(&config(instance)?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Service>()
        .map_err(|error| BusError::Node(error.to_string()))?;
    let publisher = service(&node)?.publisher_builder().create().map_err(|error| topic_error(TOPIC, &error))?;
    let sent = publisher.send_copy(u8::from(order == Order::Arm)).map_err(|error| topic_error(TOPIC, &error))?;
    Ok(sent > 0)
}
