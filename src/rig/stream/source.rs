//! Where the samples of a stream come from: a driver, or a program.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::timeout;

use super::{CLOSE_LIMIT, Stream};
use crate::action::{ActionSource, ActuatorNotice, Order};
use crate::driver::{Driver, DriverError, Reading};
use crate::permission::Attended;
use crate::provenance::Negotiated;
use crate::registry::NodeSpec;
use crate::rig::worker::{MOST_SILENT_BEATS, Worker};
use crate::status::Episode;

/// Where the samples of a stream come from.
#[derive(Debug)]
pub(super) enum Source {
    Driver(Driver),
    Worker(Box<Worker>),
}

impl Source {
    pub(super) async fn open(stream: &Stream) -> Result<Self, DriverError> {
        let Stream { spec, attachment, epoch, seat, .. } = stream;
        match (&spec.node, seat) {
            // A recorded topic needs no program.
            (NodeSpec::Process(process), Some(seat)) if !attachment.node.is_recording() => {
                Ok(Self::Worker(Box::new(Worker::open(seat, spec, process, attachment, *epoch).await?)))
            }
            _ => Ok(Self::Driver(Driver::open(spec, &attachment.node).await?)),
        }
    }

    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        match self {
            Self::Driver(driver) => driver.read().await,
            Self::Worker(worker) => worker.read().await,
        }
    }

    pub(super) fn description(&self) -> String {
        match self {
            Self::Driver(driver) => driver.description(),
            Self::Worker(worker) => worker.description(),
        }
    }

    pub(super) fn command(&mut self, target: &[f64]) -> Result<(), DriverError> {
        match self {
            Self::Driver(driver) => driver.command(target),
            // A program that moves something subscribes to actions itself.
            Self::Worker(_) => Ok(()),
        }
    }

    pub(super) fn order(&mut self, order: Order) -> Result<(), DriverError> {
        match self {
            Self::Driver(driver) => driver.order(order),
            Self::Worker(_) => Ok(()),
        }
    }

    /// Has it carry out these orders and actions. Returns whether it takes them itself.
    pub(super) fn attend(&mut self, orders: &Arc<Attended>, actions: &Arc<dyn ActionSource>) -> bool {
        match self {
            Self::Driver(driver) => driver.attend(orders, actions),
            Self::Worker(_) => false,
        }
    }

    pub(super) fn notices(&mut self) -> Option<mpsc::Receiver<ActuatorNotice>> {
        match self {
            Self::Driver(driver) => driver.notices(),
            Self::Worker(_) => None,
        }
    }

    /// Passes episodes on to the hooks of a program.
    pub(super) fn record(&mut self, episode: Option<&Arc<Episode>>) -> Result<(), DriverError> {
        match self {
            Self::Driver(driver) => driver.record(episode),
            Self::Worker(_) => Ok(()),
        }
    }

    /// The stream was asked to stop.
    pub(super) async fn close(self) {
        match self {
            Self::Driver(driver) => drop(timeout(CLOSE_LIMIT, driver.close()).await),
            Self::Worker(worker) => drop(worker),
        }
    }

    pub(super) fn negotiated(&self) -> Negotiated {
        match self {
            Self::Driver(driver) => driver.negotiated(),
            // What a program agrees with its device, only the program knows.
            Self::Worker(worker) => Negotiated { card: Some(worker.description()), ..Negotiated::default() },
        }
    }

    /// A source that is silent for this long is opened again.
    pub(super) fn patience(&self, stall_after: Duration) -> Option<Duration> {
        match self {
            Self::Driver(_) => None,
            Self::Worker(_) => Some(stall_after * MOST_SILENT_BEATS),
        }
    }
}
