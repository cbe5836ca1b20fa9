//! Orders to the actuator from other programs: service `/rapid/arm`, a request of one byte, 1 to arm and 0 to
//! disarm, answered with the same byte by whoever takes it.
//!
//! A sample would not do: its publisher ends with the program that gives the order, and a subscriber that looks
//! a moment later finds neither.
//!
//! Invariant: an order counts as given only when the actuator has taken it.
//! Invariant: an arm is carried out only while who gave it waits for the answer: later it has been told that
//! nobody took it. To disarm is right all the same.

use std::time::{Duration, Instant};

use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::request_response::PortFactory;

use super::error::topic_error;
use super::guard::{Guarded, contained};
use super::home::Home;
use super::room::BOOKS;
use super::{BusError, MAX_NODES, Service, service_name};
use crate::action::Order;

/// The service.
const TOPIC: &str = "/rapid/arm";
/// Programs that give orders at a time.
const CLIENTS: usize = 8;
/// Orders that are taken at a time: who floods the service must not keep the actuator from its actions.
const AT_A_TIME: usize = 4 * CLIENTS;
/// Whoever reads an actuator looks for orders many times a second.
const ANSWER_LIMIT: Duration = Duration::from_secs(2);
/// After this without an answer, what is damaged may be why.
const DOUBT: Duration = Duration::from_millis(500);
const LOOK: Duration = Duration::from_millis(5);

/// Their receiver.
pub(super) struct Orders {
    server: Guarded<Server<Service, u8, (), u8, ()>>,
}

impl Orders {
    pub(super) fn open(node: &Node<Service>) -> Result<Self, BusError> {
        let server = service(node)?.server_builder().create().map_err(|error| topic_error(TOPIC, &error))?;
        Ok(Self { server: Guarded::new(server) })
    }

    /// Hands what waits to `take`, oldest first, and answers what it took. What is neither order is none.
    ///
    /// # Errors
    /// The first of `take`, whose order is not answered.
    pub(super) fn hand_over<E>(&self, take: &mut dyn FnMut(Order) -> Result<(), E>) -> Result<(), E> {
        for _ in 0..AT_A_TIME {
            let Ok(Ok(Some(request))) = contained(|| self.server.receive()) else { break };
            let request = Guarded::new(request);
            let (given, waits) = (**request, contained(|| request.is_connected()).unwrap_or(false));
            let Some(order) = order(given).filter(|order| *order == Order::Disarm || waits) else { continue };
            take(order)?;
            // Who is gone needs no answer.
            let _ = contained(|| request.send_copy(given));
        }
        Ok(())
    }

    /// Forgets what waits, unanswered; says whether an order was among it.
    pub(super) fn discard(&self) -> bool {
        let mut found = false;
        while let Ok(Ok(Some(request))) = contained(|| self.server.receive()) {
            found |= order(**Guarded::new(request)).is_some();
        }
        found
    }
}

const fn order(request: u8) -> Option<Order> {
    match request {
        0 => Some(Order::Disarm),
        1 => Some(Order::Arm),
        _ => None,
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
    let home = Home::open(instance, BOOKS)?;
    let given = contained(|| give_through(home.node(), order, ANSWER_LIMIT, &|| home.unreadable()));
    given.and_then(|given| given).map_err(|error| home.explain(error))
}

/// Fails with what is `damaged` when no answer comes.
fn give_through(
    node: &Node<Service>,
    order: Order,
    limit: Duration,
    damaged: &dyn Fn() -> Option<BusError>,
) -> Result<bool, BusError> {
    let service = service(node)?;
    // Whoever has an actuator is there to receive.
    if service.dynamic_config().number_of_servers() == 0 {
        return damaged().map_or(Ok(false), Err);
    }
    let client = service.client_builder().create().map_err(|error| topic_error(TOPIC, &error))?;
    let asked = client.send_copy(u8::from(order == Order::Arm)).map_err(|error| topic_error(TOPIC, &error))?;
    let begun = Instant::now();
    let mut looked = false;
    loop {
        if asked.receive().map_err(|error| topic_error(TOPIC, &error))?.is_some() {
            return Ok(true);
        }
        if !looked && begun.elapsed() >= DOUBT {
            looked = true;
            if let Some(error) = damaged() {
                return Err(error);
            }
        }
        if begun.elapsed() >= limit {
            return Ok(false);
        }
        std::thread::sleep(LOOK);
    }
}

#[cfg(test)]
mod tests;
