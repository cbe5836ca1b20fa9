//! The rig: turns hot-plug events into running device streams and the physical mask.
//!
//! One task owns the lifecycle of every device. It applies hot-plug events, the reports and ends of streams, commands and
//! deadlines to it, and carries out its decisions.
//!
//! Invariant: only this module decides the mask.
//! Invariant: this task never waits for a device; a stream is asked to end and then forgotten.
//! Invariant: the end of a stream, by return or by panic, is an event like any other.

pub mod core;
mod hooks;
pub mod lifecycle;
mod logbook;
mod output;
mod owner;
pub mod presence;
mod programs;
mod stream;
mod worker;

pub use owner::Rig;

use std::sync::Arc;

use rapid_bus::Writer;
use rapid_core::modality::ModalityId;
use rapid_registry::device::Attachment;
use rapid_registry::{DeviceSpec, Registry};
use tokio::sync::oneshot;

use presence::PresenceError;
use rapid_devices::hotplug::HotplugError;

/// Why the rig cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// Hot-plug events can no longer be monitored.
    #[error(transparent)]
    Hotplug(#[from] HotplugError),
    /// The mask cannot be published.
    #[error(transparent)]
    Presence(#[from] PresenceError),
}

/// Commands to the rig.
#[derive(Debug)]
pub enum RigCommand {
    /// Start a failed device again.
    Restart(ModalityId),
    /// Take over an added entry, whose topic is open and which the board has.
    Register(Addition),
    /// Answer with every attached node, registered or not, in the order in which they were attached.
    Attached(oneshot::Sender<Vec<Attachment>>),
}

/// An entry that is added during a run, without a program, hooks or actions.
#[derive(Debug)]
pub struct Addition {
    /// The entry.
    pub device: Arc<DeviceSpec>,
    /// The registry with it.
    pub registry: Arc<Registry>,
    /// The writer of its topic.
    pub writer: Arc<Writer>,
}
