//! Stage discovery: devices plugged in and unplugged, on this machine, on the network or in a scenario.
//!
//! Invariant: an entry that is added during the run is searched for on the network from then on, and no other search is
//! interrupted by that.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt;
use rapid_devices::driver::camera;
use rapid_devices::hotplug::HotplugStream;
#[cfg(feature = "lan")]
use rapid_devices::hotplug::lan::LanMonitor;
use rapid_devices::hotplug::script::Script;
use rapid_devices::hotplug::udev::{Ask, UdevMonitor};
use rapid_registry::{DeviceSpec, Registry};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::stage::Stage;
use super::{AppError, Devices};

/// Created by udev's daemon when it starts.
const UDEV: &str = "/run/udev/control";
/// Events that may wait for the rig, which takes them immediately.
const DEPTH: usize = 64;

/// The stage, and what the other stages need of it.
pub(super) struct Discovery {
    pub(super) stage: Stage,
    /// What was plugged in and unplugged, for the rig. It ends when the stage does.
    pub(super) plugged: HotplugStream,
    /// Receives the names of simulated devices that are to be unplugged, or plugged in again.
    pub(super) replugs: mpsc::UnboundedSender<String>,
    /// Receives the entries that the run takes over.
    pub(super) additions: mpsc::UnboundedSender<Vec<Arc<DeviceSpec>>>,
}

/// Starts to watch. A scenario begins once `loaded` is cancelled: how long a policy takes to load depends on the machine, and
/// what happens to its sensors must not.
///
/// # Errors
/// When plug events of this machine cannot be received.
pub(super) fn start(devices: Devices, registry: &Registry, loaded: CancellationToken) -> Result<Discovery, AppError> {
    let (replugs, requests) = mpsc::unbounded_channel();
    let (additions, mut added) = mpsc::unbounded_channel::<Vec<Arc<DeviceSpec>>>();
    let (is_real, cooldown) = (matches!(devices, Devices::Machine), registry.rig.cooldown);
    let mut source = open(devices, registry, requests, loaded)?;
    let (events, to_rig) = mpsc::channel(DEPTH);
    let stage = Stage::start("discovery", |stop| async move {
        loop {
            let event = tokio::select! {
                biased;
                () = stop.cancelled() => return Ok(()),
                event = source.next() => event,
                // A scenario has its devices from the start.
                Some(added) = added.recv(), if is_real => {
                    source = with_lan(source, added.iter().map(Arc::as_ref), cooldown);
                    continue;
                }
            };
            let Some(event) = event else { return Ok(()) };
            // An error ends the rig, which reports it; no reader is left once the rig has ended.
            if events.send(event).await.is_err() {
                return Ok(());
            }
        }
    });
    let received = futures::stream::unfold(to_rig, |mut to_rig| async { Some((to_rig.recv().await?, to_rig)) });
    Ok(Discovery { stage, plugged: Box::pin(received), replugs, additions })
}

fn open(
    devices: Devices,
    registry: &Registry,
    requests: mpsc::UnboundedReceiver<String>,
    loaded: CancellationToken,
) -> Result<HotplugStream, AppError> {
    if let Devices::Simulated(scenario) = devices {
        let script = async move {
            loaded.cancelled().await;
            Script::with_requests(scenario, requests)
        };
        return Ok(Box::pin(futures::stream::once(script).flatten()));
    }
    #[cfg(feature = "motors")]
    rapid_devices::driver::can::prepare(registry);
    if !Path::new(UDEV).exists() {
        tracing::warn!("no udev runs here ({UDEV} is missing): USB devices are not detected; start systemd-udevd");
    }
    let machine = UdevMonitor::open(Ask::from_registry(registry, camera::formats))?;
    Ok(with_lan(Box::pin(machine), &registry.devices, registry.rig.cooldown))
}

/// Events of the network beside those of `source`, if any of these entries is found there.
fn with_lan<'a>(
    source: HotplugStream,
    devices: impl IntoIterator<Item = &'a DeviceSpec>,
    cooldown: Duration,
) -> HotplugStream {
    #[cfg(feature = "lan")]
    if let Some(lan) = LanMonitor::open(devices, cooldown) {
        return Box::pin(futures::stream::select(source, lan));
    }
    #[cfg(not(feature = "lan"))]
    let _ = (devices, cooldown);
    source
}
