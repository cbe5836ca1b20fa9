//! Hot-plug: a stream of devices plugged in and unplugged, from any source.
//!
//! `udev` monitors the machine, `lan` the network, `script` plays a scenario; all yield the same [`HotplugEvent`]s, and
//! their consumers cannot distinguish them.
//!
//! Invariant: devices attached when the stream begins are reported as `Added` before anything else.
//! Invariant: a node reported twice as `Added` without a removal in between is the same attachment.

#[cfg(feature = "lan")]
pub mod lan;
pub mod script;
pub mod udev;

use std::path::PathBuf;
use std::pin::Pin;

use futures::Stream;
use rapid_core::provenance::UnplugSource;
use rapid_core::time::Stamp;
use rapid_registry::device::Attachment;

/// A device was plugged in or unplugged.
#[derive(Debug, Clone, PartialEq)]
pub enum HotplugEvent {
    /// A node is present and may be opened: rules and permissions are in place.
    Added(Attachment),
    /// Everything at or below this path in sysfs is gone.
    Removed {
        /// A node, its USB device, or a hub above it.
        syspath: PathBuf,
        /// When the source reported it, for the log and the bench.
        noticed: Stamp,
        /// What reported it first.
        source: UnplugSource,
    },
}

/// Why hot-plug events can no longer be monitored.
#[derive(Debug, thiserror::Error)]
pub enum HotplugError {
    /// The netlink sockets or sysfs.
    #[error("watching for plugged devices: {0}; is /sys mounted, and udev running?")]
    Io(#[from] std::io::Error),
}

/// A source of events.
pub type HotplugStream = Pin<Box<dyn Stream<Item = Result<HotplugEvent, HotplugError>> + Send>>;
