//! Hot-plug: a stream of what is plugged in and pulled out, whatever the source.
//!
//! `udev` watches the machine, `lan` the network, `script` plays a scenario; all yield the same [`HotplugEvent`]s and
//! nothing beyond can tell them apart.
//!
//! Invariant: what is attached when the stream begins is told as `Added` before anything else.
//! Invariant: a node told twice as `Added` without a removal between is the same attachment.

#[cfg(feature = "lan")]
pub mod lan;
pub mod script;
pub mod udev;

use std::path::PathBuf;
use std::pin::Pin;

use futures::Stream;

use crate::provenance::UnplugSource;
use crate::registry::Attachment;
use crate::time::Stamp;

/// Something was plugged in or pulled out.
#[derive(Debug, Clone, PartialEq)]
pub enum HotplugEvent {
    /// A node is there and may be opened: rules and permissions are in place.
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

/// Why plugging can no longer be watched.
#[derive(Debug, thiserror::Error)]
pub enum HotplugError {
    /// The netlink sockets or sysfs.
    #[error("watching for plugged devices: {0}; is /sys mounted, and udev running?")]
    Io(#[from] std::io::Error),
}

/// A source of events.
pub type HotplugStream = Pin<Box<dyn Stream<Item = Result<HotplugEvent, HotplugError>> + Send>>;
