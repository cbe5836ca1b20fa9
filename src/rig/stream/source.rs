//! The source of a stream's samples: a driver, or a program.

use std::sync::Arc;
use std::time::Duration;

use rapid_core::action::{ActionSource, ActuatorNotice, Order};
use rapid_core::clip::ClipNotice;
use rapid_core::permission::Attended;
use rapid_core::provenance::Negotiated;
use rapid_devices::driver::{ClockOffset, Driver, DriverError, Reading};
use rapid_registry::NodeSpec;
use rapid_status::Episode;
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::{CLOSE_LIMIT, Stream};
use crate::rig::worker::{MOST_SILENT_BEATS, Worker};

/// The source of a stream's samples.
#[derive(Debug)]
pub(super) enum SampleSource {
    Driver(Driver),
    Worker(Box<Worker>),
}

impl SampleSource {
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

    pub(super) fn clock(&self) -> Option<ClockOffset> {
        if let Self::Driver(driver) = self { driver.clock() } else { None }
    }

    pub(super) fn description(&self) -> String {
        match self {
            Self::Driver(driver) => driver.description(),
            Self::Worker(worker) => worker.description(),
        }
    }

    /// The driver, unless a program sends: a program that moves something subscribes to actions itself, and learns of
    /// episodes by its hooks.
    const fn driver(&mut self) -> Option<&mut Driver> {
        if let Self::Driver(driver) = self { Some(driver) } else { None }
    }

    pub(super) fn command(&mut self, target: &[f64]) -> Result<(), DriverError> {
        self.driver().map_or(Ok(()), |driver| driver.command(target))
    }

    pub(super) fn order(&mut self, order: Order) -> Result<(), DriverError> {
        self.driver().map_or(Ok(()), |driver| driver.order(order))
    }

    /// Makes it carry out these orders and actions. Returns whether it takes them itself.
    pub(super) fn attend(&mut self, orders: &Arc<Attended>, actions: &Arc<dyn ActionSource>) -> bool {
        self.driver().is_some_and(|driver| driver.attend(orders, actions))
    }

    pub(super) fn notices(&mut self) -> Option<mpsc::Receiver<ActuatorNotice>> {
        self.driver()?.notices()
    }

    pub(super) fn clips(&mut self) -> Option<mpsc::Receiver<ClipNotice>> {
        self.driver()?.clips()
    }

    pub(super) fn record(&mut self, episode: Option<&Arc<Episode>>) -> Result<(), DriverError> {
        self.driver().map_or(Ok(()), |driver| driver.record(episode))
    }

    /// Called when the stream was asked to stop.
    pub(super) async fn close(self) {
        match self {
            Self::Driver(driver) => drop(timeout(CLOSE_LIMIT, driver.close()).await),
            Self::Worker(worker) => drop(worker),
        }
    }

    pub(super) fn negotiated(&self) -> Negotiated {
        match self {
            Self::Driver(driver) => driver.negotiated(),
            // Only the program knows what it agrees with its device.
            Self::Worker(worker) => Negotiated { card: Some(worker.description()), ..Negotiated::default() },
        }
    }

    /// A source that is silent for this long is reopened.
    pub(super) fn patience(&self, stall_after: Duration) -> Option<Duration> {
        match self {
            Self::Driver(_) => None,
            Self::Worker(_) => Some(stall_after * MOST_SILENT_BEATS),
        }
    }
}
