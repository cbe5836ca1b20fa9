//! The emulator: USB devices in user space, attached to the stock kernel's `vhci_hcd` over a socket pair.
//!
//! A `DeviceSpec` becomes a `Function` (what the device is) inside a `Device` (its attachment and beat); the script plugs and
//! unplugs. The kernel sees ordinary USB devices, so every driver, node and udev rule above is the real one.
//!
//! Invariant: a number (frame or line) is given out only to data that is sent whole, so a hole in what a reader got is the
//! reader's loss, never the emulator's.
//! Invariant: nothing a host asks of a device panics; what is unknown is stalled, as hardware does.

mod attachment;
pub mod can;
pub mod descriptor;
pub mod device;
pub mod feed;
pub mod frame;
pub mod function;
pub mod gpio;
pub mod lan;
pub mod log;
pub mod order;
pub mod pace;
pub mod reported;
pub mod script;
pub mod serial;
pub mod spec;
mod talk;
pub mod talker;
pub mod uvc;
pub mod wire;
