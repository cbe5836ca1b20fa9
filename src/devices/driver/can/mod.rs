//! CAN: frames to and from a bus, over whatever adapter there is.
//!
//! [`slcan`] and [`damiao_serial`] are the protocols of two kinds of adapters on a serial line, without I/O;
//! [`netlink`] brings a network interface up. A [`link::Link`] is an open adapter of any kind, for a
//! thread of its own; a [`link::AsyncLink`] is one for a task. [`raw`] is the driver of a bus whose frames are
//! recorded unchanged.

mod brakes;
mod claim;
pub mod damiao_serial;
pub mod guard;
mod line;
pub mod link;
pub mod motors;
pub mod netlink;
pub mod outcome;
pub mod raw;
pub mod slcan;
mod socket;

use rapid_registry::{CanAdapter, NodeSpec, Registry};

/// Makes the kernel load its CAN modules if an entry needs them, so that the first plug does not wait for that. Returns
/// at once; errors are reported when an adapter is opened.
pub fn prepare(registry: &Registry) {
    let is_socket = |node: &NodeSpec| matches!(node, NodeSpec::Can(can) if can.adapter == CanAdapter::SocketCan);
    if registry.devices.iter().any(|device| is_socket(&device.node)) {
        tokio::task::spawn_blocking(socket::load);
    }
}
