//! All child processes of the rig: the spawner, the shared resources they report to, and the wait for the last one.

use std::ffi::OsString;
use std::sync::Arc;
use std::time::Duration;

use rapid_bus::{Bus, Membership};
use rapid_devices::driver::process::Spawner;
use rapid_registry::device::Attachment;
use rapid_registry::{DeviceSpec, NodeSpec, Registry};
use rapid_status::Board;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::logbook::Logbook;

/// How long a child has to end after SIGTERM.
pub(super) const TERM_LIMIT: Duration = Duration::from_secs(5);
/// A hook that has not ended by then is killed.
pub(super) const HOOK_LIMIT: Duration = Duration::from_secs(10);
/// Allowance for the kernel and a busy machine, beyond the time a program has to end.
pub(super) const MARGIN: Duration = Duration::from_secs(2);

#[derive(Debug, Clone)]
pub(super) struct Programs {
    pub(super) spawner: Spawner,
    pub(super) board: Arc<Board>,
    pub(super) logbook: Logbook,
    /// One task per child, and one per attended device.
    pub(super) tasks: TaskTracker,
    /// The run ends: no further programs are started.
    pub(super) closing: CancellationToken,
    /// Cancelled when children that are being ended get no more time.
    pub(super) hurry: CancellationToken,
}

impl Programs {
    /// `None` if no entry needs a program.
    pub(super) fn new(registry: &Registry, bus: &Bus, board: &Arc<Board>) -> Option<Self> {
        let mut devices = registry.devices.iter();
        devices.any(|device| matches!(device.node, NodeSpec::Process(_)) || !device.hooks.is_empty()).then(|| Self {
            spawner: Spawner::start(),
            board: Arc::clone(board),
            logbook: Logbook::start(bus.instance(), board),
            tasks: TaskTracker::new(),
            closing: CancellationToken::new(),
            hurry: CancellationToken::new(),
        })
    }

    /// Waits until every child has ended. The programs of devices have been asked to end, and no episode is in progress
    /// any more.
    pub(super) async fn ended(&self) {
        self.closing.cancel();
        self.tasks.close();
        // For a device removed a moment ago: the hook that just started, the two that follow it, and between them the
        // wait for its program.
        let limit = 3 * HOOK_LIMIT + TERM_LIMIT + 2 * MARGIN;
        if timeout(limit, self.tasks.wait()).await.is_err() {
            tracing::warn!(programs = self.tasks.len(), "did not end even when killed and are abandoned");
        }
        self.logbook.flush().await;
    }
}

/// Environment variables of a child; one without a value is unset.
pub(super) type Environment = Vec<(&'static str, Option<OsString>)>;

/// What a program needs to find the bus.
#[derive(Debug, Clone)]
pub(super) struct BusNames {
    /// iceoryx2's prefix.
    pub(super) prefix: String,
    /// iceoryx2's folder.
    pub(super) root: String,
}

impl BusNames {
    pub(super) fn from_membership(membership: &Membership) -> Self {
        Self { prefix: membership.prefix(), root: membership.root() }
    }
}

/// The variables that every child gets about its device.
pub(super) fn environment(spec: &DeviceSpec, attachment: &Attachment, topic: &str, bus: &BusNames) -> Environment {
    let text = |text: &str| Some(OsString::from(text));
    vec![
        ("DEVICE_NAME", text(&spec.name)),
        ("DEVICE_NODE", text(&attachment.node.label())),
        // Unset rather than set to a value that cannot be expressed.
        ("DEVICE_SERIAL", attachment.unit.serial().filter(|serial| !serial.contains('\0')).and_then(text)),
        ("DEVICE_ADDR", text(attachment.unit.place())),
        ("RAPID_TOPIC", text(topic)),
        ("RAPID_BIT", text(&spec.id.to_string())),
        ("RAPID_BUS_PREFIX", text(&bus.prefix)),
        ("RAPID_BUS_ROOT", text(&bus.root)),
    ]
}
