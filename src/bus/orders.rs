//! Orders to the actuator from other programs: service `/rapid/arm`, a request of one byte, 1 to arm and 0 to
//! disarm, answered with the same byte by whoever takes it.
//!
//! A sample would not do: its publisher ends with the program that gives the order, and a subscriber that looks
//! a moment later finds neither.
//!
//! Invariant: an order counts as given only when the actuator's stream has taken it.

use std::time::{Duration, Instant};

use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::request_response::PortFactory;

use super::{BusError, MAX_NODES, Service, config, service_name, topic_error};
use crate::action::Order;

/// The service.
const TOPIC: &str = "/rapid/arm";
/// Programs that give orders at a time.
const CLIENTS: usize = 8;
/// Whoever reads an actuator looks for orders many times a second.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
const LOOK: Duration = Duration::from_millis(5);

/// Their receiver.
pub(super) struct Orders {
    server: Server<Service, u8, (), u8, ()>,
}

impl Orders {
    pub(super) fn open(node: &Node<Service>) -> Result<Self, BusError> {
        let server = service(node)?.server_builder().create();
        Ok(Self { server: server.map_err(|error| topic_error(TOPIC, &error))? })
    }

    /// The oldest that waits. What is neither order is none.
    pub(super) fn next(&self) -> Option<Order> {
        loop {
            let request = self.server.receive().ok()??;
            let order = match *request {
                0 => Order::Disarm,
                1 => Order::Arm,
                _ => continue,
            };
            // Who does not wait for the answer any more has been told that nobody took the order. To stop is
            // right all the same.
            if request.send_copy(*request).is_ok() || order == Order::Disarm {
                return Some(order);
            }
        }
    }

    /// Forgets what waits, unanswered.
    pub(super) fn discard(&self) {
        while let Ok(Some(_)) = self.server.receive() {}
    }
}

fn service(node: &Node<Service>) -> Result<PortFactory<Service, u8, (), u8, ()>, BusError> {
    node.service_builder(&service_name(TOPIC)?)
        .request_response::<u8, u8>()
        .max_servers(1)
        .max_clients(CLIENTS)
        .max_nodes(MAX_NODES)
        .open_or_create()
        .map_err(|error| topic_error(TOPIC, &error))
}

/// Gives an order to the actuator of the `rapid` that runs as `instance`. Says whether it was taken.
///
/// # Errors
/// When the bus cannot be used.
pub fn give(instance: Option<&str>, order: Order) -> Result<bool, BusError> {
    let node = NodeBuilder::new()
        .config(&config(instance)?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Service>()
        .map_err(|error| BusError::Node(error.to_string()))?;
    let client = service(&node)?.client_builder().create().map_err(|error| topic_error(TOPIC, &error))?;
    let asked = client.send_copy(u8::from(order == Order::Arm)).map_err(|error| topic_error(TOPIC, &error))?;
    let until = Instant::now() + ANSWER_LIMIT;
    loop {
        if asked.receive().map_err(|error| topic_error(TOPIC, &error))?.is_some() {
            return Ok(true);
        }
        if Instant::now() >= until {
            return Ok(false);
        }
        std::thread::sleep(LOOK);
    }
}
