//! A recorded episode as a scenario: its modalities as devices, its mask as plugs and unplugs.

use std::path::Path;
use std::time::Duration;

use super::episode::{EpisodeDescription, describe};
use super::{DriverError, fatal};
use crate::modality::ModalityId;
use crate::registry::scenario::{Scenario, ScenarioAction, ScenarioDevice, ScenarioEvent, SimFaults, SimSource};
use crate::registry::{DeviceSpec, LanIdentity, Registry, UsbIdentity};

/// A device is attached before its first sample, with which its bit begins: by this much.
const LEAD: Duration = Duration::from_millis(100);

/// A recorded episode, to be played.
#[derive(Debug, Clone, PartialEq)]
pub struct Replayed {
    /// The registry it was recorded with.
    pub registry: Registry,
    /// Each modality is a device that plays its topic and is plugged and unplugged as the recorded
    /// mask says.
    pub scenario: Scenario,
    /// From its first message to its last.
    pub length: Duration,
}

/// Makes devices of a recorded episode; blocks.
///
/// # Errors
/// When the file cannot be read, or does not hold the registry and the layout.
pub fn scenario(file: &Path) -> Result<Replayed, DriverError> {
    let episode = describe(file)?;
    if episode.layout.is_empty() || episode.registry.is_empty() {
        return Err(fatal(file, "holds no layout and registry: it was not recorded by rapid"));
    }
    let loaded = Registry::parse(&episode.registry, None)
        .map_err(|errors| fatal(file, format!("the registry in it cannot be read: {errors}")))?;
    let registry = loaded.registry;
    let device = |spec: &DeviceSpec| ScenarioDevice {
        name: spec.name.clone(),
        usb: usb_identity(spec),
        lan: lan_identity(spec),
        source: SimSource::Replay { file: file.to_owned(), topic: spec.topic.clone(), begin_ns: episode.begin_ns },
        plugged: episode.mask.first().is_some_and(|(_, mask)| mask.contains(spec.id)),
        faults: SimFaults::default(),
    };
    let mut events: Vec<_> =
        registry.devices.iter().flat_map(|spec| plug_events(&episode, &spec.name, spec.id)).collect();
    events.sort_by_key(|event| event.at);
    let devices = registry.devices.iter().map(device).collect();
    let length = Duration::from_nanos(episode.end_ns.saturating_sub(episode.begin_ns));
    Ok(Replayed { registry, scenario: Scenario { devices, events, repeat: None }, length })
}

/// Plugs and unplugs of one modality, from the changes of its bit.
fn plug_events(episode: &EpisodeDescription, name: &str, id: ModalityId) -> Vec<ScenarioEvent> {
    let mut events: Vec<ScenarioEvent> = Vec::new();
    for pair in episode.mask.windows(2) {
        let [(_, before), (time, after)] = pair else { continue };
        let at = Duration::from_nanos(time.saturating_sub(episode.begin_ns));
        let earliest = events.last().map_or(Duration::ZERO, |event| event.at);
        let (at, action) = match (before.contains(id), after.contains(id)) {
            (false, true) => (at.saturating_sub(LEAD).max(earliest), ScenarioAction::Plug { port: None }),
            (true, false) => (at, ScenarioAction::Unplug),
            _ => continue,
        };
        events.push(ScenarioEvent { at, device: name.to_owned(), action });
    }
    events
}

/// A device on the network is found by its entry.
fn lan_identity(spec: &DeviceSpec) -> Option<LanIdentity> {
    let found = || LanIdentity { entry: spec.name.clone(), address: String::from("replay"), instance: None };
    spec.identity.usb().is_none().then(found)
}

/// What the entry says the device is; a port is made up where it names none.
fn usb_identity(spec: &DeviceSpec) -> UsbIdentity {
    let identity = spec.identity.usb();
    UsbIdentity {
        vid: identity.map_or(0, |usb| usb.vid),
        pid: identity.map_or(0, |usb| usb.pid),
        serial: spec.identity.serial().map(str::to_owned),
        port: identity.and_then(|usb| usb.port.clone()).unwrap_or_else(|| format!("9-{}", spec.id.bit() + 1)),
        product: Some(String::from("replay")),
        ..UsbIdentity::default()
    }
}
