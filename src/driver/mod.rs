//! Drivers: the edge. Bytes in from a device's node.
//!
//! A driver is an enum, not a trait object: its [`Reading`] lends bytes from the kernel's buffer
//! until the next read.
//!
//! Invariant: `read` is cancel-safe: dropping its future loses no sample.
//! Invariant: no driver blocks: what may block while opening runs on tokio's blocking pool.
//! Invariant: no bytes from a device make a driver panic.

use crate::registry::{DeviceNode, DeviceSpec};
use crate::sample::Encoding;
use crate::time::Stamp;

/// One sample as the device gave it, borrowed until the next read.
#[derive(Debug)]
pub struct Reading<'a> {
    /// Payload.
    pub bytes: &'a [u8],
    /// How the payload is encoded.
    pub encoding: Encoding,
    /// Capture time; from the kernel where it gives one, otherwise the moment of arrival.
    pub captured: Stamp,
    /// `sample::FLAG_*`.
    pub flags: u32,
    /// Image: pixels, otherwise 0.
    pub width: u32,
    /// Image: pixels, otherwise 0.
    pub height: u32,
    /// Samples the device or kernel says were lost since the last reading.
    pub lost: u64,
}

/// Why a device cannot be opened or read, by what to do next.
#[derive(Debug, thiserror::Error)]
pub enum DriverError {
    /// The device is no longer there: wait for it to be attached again.
    #[error("unplugged")]
    Gone,
    /// Trying again later may help.
    #[error("{0}")]
    Retry(String),
    /// Trying again cannot help before something is changed; the text says what.
    #[error("{0}")]
    Fatal(String),
}

/// An open device.
#[derive(Debug)]
pub enum Driver {}

impl Driver {
    /// Opens the node of `spec` and starts it.
    ///
    /// # Errors
    /// When the node is gone, cannot be opened, or cannot do what `spec` wishes.
    pub async fn open(spec: &DeviceSpec, node: &DeviceNode) -> Result<Self, DriverError> {
        let _ = (spec, node);
        Err(DriverError::Fatal("no driver".to_owned()))
    }

    /// The next sample. Waits as long as the device sends nothing.
    ///
    /// # Errors
    /// When the device is gone or cannot be read any more.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        match *self {}
    }

    /// What was agreed with the device: format, rate, driver, for the log and the recording.
    #[must_use]
    pub fn description(&self) -> String {
        match *self {}
    }
}
