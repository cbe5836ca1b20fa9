//! CAN: frames to and from a bus, over whatever adapter there is.
//!
//! [`slcan`] and [`damiao_serial`] are what two kinds of adapters speak on a serial line, without I/O;
//! [`netlink`] brings a network interface up. A [`link::Link`] is an open adapter of any kind, for a
//! thread of its own; a [`link::AsyncLink`] is one for a task. [`raw`] is the driver of a bus whose frames are
//! recorded as they come.

pub mod damiao_serial;
mod line;
pub mod link;
pub mod motors;
pub mod netlink;
pub mod raw;
pub mod slcan;
mod socket;
