//! The emulator: USB devices in user space, attached to the stock kernel's `vhci_hcd` over a socket pair.
//!
//! A `DeviceSpec` becomes a `Function` (the device's function) inside a `Device` (its attachment and clock); the script
//! plugs and unplugs. The kernel sees ordinary USB devices, so every driver, node and udev rule above is the real one.
//!
//! Invariant: a number (frame or line) is assigned only to data that is sent completely, so a gap in a reader's data is
//! the reader's loss, never the emulator's.
//! Invariant: no request of a host causes a panic; unknown requests are stalled, as by hardware.

mod attachment;
pub mod cameras;
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
pub mod source;
pub mod spec;
mod talk;
pub mod talker;
pub mod uvc;
pub mod wire;
