//! Replaces the drivers of a cargo feature that this program was built without: no value of it exists.

use std::convert::Infallible;
use std::future::Pending;
use std::path::PathBuf;
use std::sync::Arc;

use rapid_core::action::{ActionSource, ActuatorNotice, Order};
use rapid_core::permission::Attended;
use rapid_registry::device::DeviceNode;

use super::{Agreed, DriverError, Reading};
use tokio::sync::mpsc;

/// Never opened.
#[derive(Debug)]
pub struct Absent {
    pub(super) agreed: Agreed,
    never: Infallible,
}

impl Absent {
    pub const fn unlinked(_: &DeviceNode) -> Option<Pending<()>> {
        None
    }

    pub fn read(&mut self) -> Pending<Result<Reading<'_>, DriverError>> {
        match self.never {}
    }

    pub fn order(&mut self, _: Order) -> Result<(), DriverError> {
        match self.never {}
    }

    pub fn attend(&mut self, _: &Arc<Attended>) {
        match self.never {}
    }

    pub fn follow(&mut self, _: Arc<dyn ActionSource>) {
        match self.never {}
    }

    pub fn notices(&mut self) -> Option<mpsc::Receiver<ActuatorNotice>> {
        match self.never {}
    }

    pub fn record(&mut self, _: Option<PathBuf>) -> Result<(), DriverError> {
        match self.never {}
    }

    pub fn clock(&self) -> Option<super::ClockOffset> {
        match self.never {}
    }

    pub fn close(self) -> Pending<()> {
        match self.never {}
    }
}

/// Why a device of such a driver cannot be opened.
pub(super) fn not_built(feature: &str) -> DriverError {
    DriverError::Fatal(format!(
        "this rapid was built without `{feature}`: build it with `cargo build --release --features {feature}`, or \
         remove the entry"
    ))
}
