//! What comes of sending and receiving on a CAN bus: a frame and its arrival, or an error.

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;

use crate::driver::DriverError;

/// Why a frame cannot be sent or received, classified by what to do next.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LinkError {
    /// The adapter is no longer there: wait for it to be attached again.
    #[error("unplugged")]
    Gone,
    /// The frame cannot be queued: the queue to the bus is full. Try again.
    #[error("the queue to the bus is full: nothing on the bus acknowledges frames, or more are sent than fit")]
    Full,
    /// The controller left the bus after too many errors. It may return by itself; the link stays open.
    #[error(
        "bus-off: the adapter left the bus after too many errors; check the wiring, the 120 ohm resistors at \
         both ends, and that all devices have one bit rate"
    )]
    BusOff,
    /// Opening again later may help.
    #[error("{0}")]
    Retry(String),
    /// Opening again cannot help until something is changed; the text names it.
    #[error("{0}")]
    Fatal(String),
}

impl LinkError {
    /// The same error for the reader of the device.
    pub fn into_driver(self) -> DriverError {
        match self {
            Self::Gone => DriverError::Gone,
            Self::Fatal(text) => DriverError::Fatal(text),
            Self::Retry(text) => DriverError::Retry(text),
            Self::Full | Self::BusOff => DriverError::Retry(self.to_string()),
        }
    }

    pub(super) fn of_driver(error: DriverError) -> Self {
        match error {
            DriverError::Gone | DriverError::Unlinked => Self::Gone,
            DriverError::Retry(text) => Self::Retry(text),
            DriverError::Fatal(text) => Self::Fatal(text),
        }
    }
}

/// When a frame arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Arrival {
    /// The moment, from the kernel where it gives one.
    pub at: Stamp,
    /// The kernel stamped it.
    pub from_kernel: bool,
}

/// A frame and its arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Received {
    /// The frame.
    pub frame: CanFrame,
    /// When it arrived.
    pub arrival: Arrival,
}

/// The controller left the bus (`CAN_ERR_BUSOFF`, linux/can/error.h).
pub const fn is_bus_off(frame: &CanFrame) -> bool {
    frame.error && frame.id & 0x40 != 0
}

/// The controller had no room for received frames (`CAN_ERR_CRTL` with `CAN_ERR_CRTL_RX_OVERFLOW`).
pub const fn is_overflow(frame: &CanFrame) -> bool {
    frame.error && frame.id & 0x4 != 0 && frame.data[1] & 0x1 != 0
}
