//! Stage discovery: devices plugged in and unplugged, on this machine, on the network or in a scenario.

use std::path::Path;

use futures::StreamExt;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::stage::Stage;
use super::{AppError, Devices};
use crate::driver::camera;
use crate::hotplug::HotplugStream;
#[cfg(feature = "lan")]
use crate::hotplug::lan::LanMonitor;
use crate::hotplug::script::Script;
use crate::hotplug::udev::{Ask, UdevMonitor};
use crate::registry::Registry;

/// Created by udev's daemon when it starts.
const UDEV: &str = "/run/udev/control";
/// Events that may wait for the rig, which takes them immediately.
const DEPTH: usize = 64;

/// Starts to watch; also returns the stream for the rig, which ends when the stage does. `requests` name simulated
/// devices that are to be unplugged, or plugged in again. A scenario begins once `loaded` is cancelled: how long a policy
/// takes to load depends on the machine, and what happens to its sensors must not.
///
/// # Errors
/// When plug events of this machine cannot be received.
pub(super) fn start(
    devices: Devices,
    registry: &Registry,
    requests: mpsc::UnboundedReceiver<String>,
    loaded: CancellationToken,
) -> Result<(Stage, HotplugStream), AppError> {
    let mut source = open(devices, registry, requests, loaded)?;
    let (events, to_rig) = mpsc::channel(DEPTH);
    let stage = Stage::start("discovery", |stop| async move {
        loop {
            let event = tokio::select! {
                biased;
                () = stop.cancelled() => return Ok(()),
                event = source.next() => event,
            };
            let Some(event) = event else { return Ok(()) };
            // An error ends the rig, which reports it; no reader is left once the rig has ended.
            if events.send(event).await.is_err() {
                return Ok(());
            }
        }
    });
    let received = futures::stream::unfold(to_rig, |mut to_rig| async { Some((to_rig.recv().await?, to_rig)) });
    Ok((stage, Box::pin(received)))
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
    crate::driver::can::prepare(registry);
    if !Path::new(UDEV).exists() {
        tracing::warn!("no udev runs here ({UDEV} is missing): USB devices are not detected; start systemd-udevd");
    }
    let machine = UdevMonitor::open(Ask::of(registry, camera::formats))?;
    #[cfg(feature = "lan")]
    if let Some(lan) = LanMonitor::open(registry) {
        return Ok(Box::pin(futures::stream::select(machine, lan)));
    }
    Ok(Box::pin(machine))
}
