//! Stands in for the drivers of a cargo feature that this program was built without: no value of it exists.

use std::convert::Infallible;
use std::future::Pending;
use std::path::PathBuf;
use std::sync::Arc;

use super::{DriverError, Reading};
use tokio::sync::mpsc;

use crate::action::{ActionSource, ActuatorNotice, Order};
use crate::permission::Attended;
use crate::provenance::Negotiated;
use crate::registry::DeviceNode;

/// Never opened.
#[derive(Debug)]
pub struct Absent(Infallible);

impl Absent {
    #[must_use]
    pub const fn unlinked(_: &DeviceNode) -> Option<Pending<()>> {
        None
    }

    pub fn read(&mut self) -> Pending<Result<Reading<'_>, DriverError>> {
        match self.0 {}
    }

    pub fn order(&mut self, _: Order) -> Result<(), DriverError> {
        match self.0 {}
    }

    pub fn attend(&mut self, _: &Arc<Attended>) {
        match self.0 {}
    }

    pub fn follow(&mut self, _: Arc<dyn ActionSource>) {
        match self.0 {}
    }

    pub fn notices(&mut self) -> Option<mpsc::Receiver<ActuatorNotice>> {
        match self.0 {}
    }

    pub fn record(&mut self, _: Option<PathBuf>) -> Result<(), DriverError> {
        match self.0 {}
    }

    pub fn close(self) -> Pending<()> {
        match self.0 {}
    }

    #[must_use]
    pub fn description(&self) -> &str {
        match self.0 {}
    }

    #[must_use]
    pub fn negotiated(&self) -> Negotiated {
        match self.0 {}
    }
}

/// Why a device of such a driver cannot be opened.
pub(super) fn not_built(feature: &str) -> DriverError {
    DriverError::Fatal(format!(
        "this rapid was built without `{feature}`: build it with `cargo build --release --features {feature}`, or \
         remove the entry"
    ))
}
