//! Scenario files: TOML that lists simulated devices and events.
//!
//! The format is documented, and run by a test, in docs/scenarios.md.
//!
//! An entry without a serial number or port gets an invented one: `SIM-<name>`, a port of bus 9.
//!
//! Invariant: no text causes a panic; all problems are reported at once.
//! Invariant: in an accepted scenario a device is only plugged while unplugged and unplugged while
//! plugged, at every repetition.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use super::diagnostic::{RegistryErrors, did_you_mean};
use super::parse::is_port;
use super::scenario::{Scenario, ScenarioAction, ScenarioDevice, ScenarioEvent};
use super::section::{Section, file_label, read, read_file};
use super::spec::{DeviceSpec, NodeSpec, Registry};
use crate::device::{LanIdentity, UsbIdentity};
use crate::simulation::{SimFaults, SimSource};

const DEVICE_KEYS: [&str; 14] = [
    "name",
    "like",
    "seed",
    "plugged",
    "hz",
    "bytes",
    "vid",
    "pid",
    "serial",
    "port",
    "firmware",
    "manufacturer",
    "product",
    "fault",
];
const ACTIONS: [&str; 4] = ["plug", "unplug", "silence", "resume"];
const EVENT_KEYS: [&str; 6] = ["at", "plug", "unplug", "silence", "resume", "port"];
/// Most bytes that a simulated camera adds to each picture: its name.
const PICTURE_NAME_BYTES: usize = 64;
const LONGEST: Duration = Duration::from_hours(7 * 24);

impl Scenario {
    /// Reads a scenario file for the devices of `registry`.
    ///
    /// # Errors
    /// When the file cannot be read or is invalid: then all problems.
    pub fn load(path: &Path, registry: &Registry) -> Result<Self, RegistryErrors> {
        let text = read_file(path, "`rapid --sim` without a file plays the demonstration; name a scenario file")?;
        Self::parse(&text, Some(path), registry)
    }

    /// Reads the text of a scenario; `path` names it in messages.
    ///
    /// # Errors
    /// All problems of the text.
    pub fn parse(text: &str, path: Option<&Path>, registry: &Registry) -> Result<Self, RegistryErrors> {
        read(&file_label(path, "scenario"), text, |root| {
            root.allow(&["repeat", "device", "event"]);
            let repeat = root.duration("repeat", Duration::from_millis(10)..=LONGEST);
            let devices = if root.has("device") { devices(root, registry) } else { every_entry(registry) };
            let sections = root.tables("event").unwrap_or_default();
            let mut events: Vec<_> = sections.into_iter().filter_map(|section| event(section, &devices)).collect();
            // Stable: the order in the file decides between equal times.
            events.sort_by_key(|event| event.event.at);
            check_order(&events, &devices, repeat);
            Ok(Self { devices, events: events.into_iter().map(|placed| placed.event).collect(), repeat })
        })
    }

    /// Every entry is plugged in, and there are no events.
    pub fn quiet(registry: &Registry) -> Self {
        Self { devices: every_entry(registry), events: Vec::new(), repeat: None }
    }

    /// What `rapid --sim` plays without a file: everything is plugged; the second camera, or if
    /// there is none the last device, is unplugged at 3 s and plugged again at 6 s, every 12 s.
    pub fn demo(registry: &Registry) -> Self {
        let mut cameras = registry.devices.iter().filter(|device| matches!(device.node, NodeSpec::Camera(_)));
        let star = cameras.nth(1).or(registry.devices.last());
        let event = |seconds, action| {
            let device = star?.name.clone();
            Some(ScenarioEvent { at: Duration::from_secs(seconds), device, action })
        };
        let unplug = event(3, ScenarioAction::Unplug);
        let plug = event(6, ScenarioAction::Plug { port: None });
        Self {
            devices: every_entry(registry),
            events: unplug.into_iter().chain(plug).collect(),
            repeat: Some(Duration::from_secs(12)),
        }
    }
}

fn every_entry(registry: &Registry) -> Vec<ScenarioDevice> {
    let mut devices: Vec<_> = registry.devices.iter().map(|spec| standing_for(spec, &spec.name)).collect();
    invent_ports(&mut devices);
    devices
}

fn devices(root: &Section<'_>, registry: &Registry) -> Vec<ScenarioDevice> {
    let mut devices = Vec::new();
    let mut ports: BTreeMap<String, usize> = BTreeMap::new();
    for section in root.tables("device").unwrap_or_default() {
        let Some(device) = device(&section, registry) else { continue };
        if devices.iter().any(|earlier: &ScenarioDevice| earlier.name == device.name) {
            let message = format!("{:?} is already a device of this scenario", device.name);
            let fix = format!("give it another name and like = {:?}", device.name);
            section.report("name", message, fix);
        }
        if !device.usb.port.is_empty() {
            if let Some(line) = ports.get(&device.usb.port) {
                let message = format!("port {} is already used by the device on line {line}", device.usb.port);
                section.report("port", message, "give each device a separate port: port = \"1-4\"");
            }
            ports.insert(device.usb.port.clone(), section.line());
        }
        devices.push(device);
    }
    invent_ports(&mut devices);
    devices
}

fn device(section: &Section<'_>, registry: &Registry) -> Option<ScenarioDevice> {
    section.allow(&DEVICE_KEYS);
    section.need("name", "write name = the device's name in devices.toml");
    let name = section.text("name")?;
    let (key, entry) = if section.has("like") { ("like", section.text("like")?) } else { ("name", name) };
    let Some(spec) = registry.named(entry) else {
        let fix = did_you_mean(entry, registry.devices.iter().map(|device| &device.name), "registered are");
        return section.refuse(key, format!("{entry:?} is not in the registry"), fix);
    };
    let mut device = standing_for(spec, name);
    let seed = section.integer("seed", 0..=i64::MAX);
    let hz = section.integer("hz", 1..=10_000);
    let most = spec.max_bytes.saturating_sub(PICTURE_NAME_BYTES) as u64;
    let bytes = section.size("bytes", 0..=most).and_then(|bytes| usize::try_from(bytes).ok());
    if let (Some(filled), SimSource::Camera { bytes, .. }) = (bytes, &mut device.source) {
        *bytes = filled;
    } else if section.has("bytes") && !matches!(device.source, SimSource::Camera { .. }) {
        let message = format!("{entry:?} sends no pictures, only they have a size");
        section.report("bytes", message, "leave bytes out");
    }
    match &mut device.source {
        SimSource::Camera { fps: rate, seed: chosen, .. }
        | SimSource::Depth { fps: rate, seed: chosen, .. }
        | SimSource::Serial { hz: rate, seed: chosen, .. } => {
            *rate = hz.unwrap_or(*rate);
            *chosen = seed.unwrap_or(*chosen);
        }
        SimSource::Task { .. } | SimSource::Process | SimSource::Replay { .. } => {}
    }
    device.plugged = section.flag("plugged").unwrap_or(true);
    device.usb.vid = section.usb_id("vid").unwrap_or(device.usb.vid);
    device.usb.pid = section.usb_id("pid").unwrap_or(device.usb.pid);
    if let Some(serial) = section.text("serial") {
        // The identity that a device reports is never an error of the file.
        device.usb.serial = (!serial.is_empty()).then(|| serial.to_owned());
    }
    if let Some(port) = port(section) {
        device.usb.port = port;
    }
    device.faults = faults(section);
    let usb = &mut device.usb;
    for (key, place) in
        [("firmware", &mut usb.firmware), ("manufacturer", &mut usb.manufacturer), ("product", &mut usb.product)]
    {
        if let Some(text) = section.text(key) {
            *place = (!text.is_empty()).then(|| text.to_owned());
        }
    }
    Some(device)
}

fn faults(section: &Section<'_>) -> SimFaults {
    let Some(table) = section.table("fault") else { return SimFaults::default() };
    let every = ["truncate_every", "duplicate_every", "lose_every"];
    let mut known = every.to_vec();
    known.extend(["freeze_at", "delay", "latency", "clock_ppm", "close"]);
    table.allow(&known);
    // At least 2: a device that loses all samples would send none.
    let [truncate_every, duplicate_every, lose_every] = every.map(|key| table.integer(key, 2..=1_000_000));
    SimFaults {
        freeze_at: table.duration("freeze_at", Duration::ZERO..=LONGEST),
        truncate_every,
        duplicate_every,
        lose_every,
        delay: table.duration("delay", Duration::ZERO..=Duration::from_secs(10)).unwrap_or_default(),
        latency: table.duration("latency", Duration::ZERO..=Duration::from_secs(1)).unwrap_or_default(),
        clock_ppm: table.integer("clock_ppm", -100_000..=100_000).unwrap_or_default(),
        close: table.duration("close", Duration::ZERO..=Duration::from_secs(10)).unwrap_or_default(),
    }
}

fn port(section: &Section<'_>) -> Option<String> {
    let port = section.text("port")?;
    if is_port(port) {
        return Some(port.to_owned());
    }
    let fix = "write it as the kernel does, bus-port.port, for example port = \"1-2.3\"";
    section.refuse("port", format!("{port:?} is not a USB port path"), fix)
}

/// An event and its position in the file.
struct Placed<'a> {
    section: Section<'a>,
    key: &'static str,
    event: ScenarioEvent,
}

fn event<'a>(section: Section<'a>, devices: &[ScenarioDevice]) -> Option<Placed<'a>> {
    section.allow(&EVENT_KEYS);
    section.need("at", "write at = the time from the beginning, for example at = \"3s\"");
    let at = section.duration("at", Duration::ZERO..=LONGEST);
    let given: Vec<&'static str> = ACTIONS.into_iter().filter(|action| section.has(action)).collect();
    let [key] = given.as_slice() else {
        let message = match given.as_slice() {
            [] => "nothing happens in this event".to_owned(),
            several => format!("{} in one event", several.join(" and ")),
        };
        section.report_at(section.at, message, "write exactly one of plug, unplug, silence, resume");
        return None;
    };
    let name = section.text(key)?;
    if !devices.iter().any(|device| device.name == name) {
        let fix = did_you_mean(name, devices.iter().map(|device| &device.name), "devices of this scenario");
        return section.refuse(key, format!("{name:?} is not a device of this scenario"), fix);
    }
    let port = port(&section);
    let action = match *key {
        "plug" => ScenarioAction::Plug { port },
        "unplug" => ScenarioAction::Unplug,
        "silence" => ScenarioAction::Silence,
        _ => ScenarioAction::Resume,
    };
    if section.has("port") && *key != "plug" {
        section.report("port", format!("a port has no meaning with {key}"), "give a port with plug only");
    }
    let event = ScenarioEvent { at: at?, device: name.to_owned(), action };
    Some(Placed { section, key, event })
}

/// Checks the sequence of the events.
fn check_order(events: &[Placed<'_>], devices: &[ScenarioDevice], repeat: Option<Duration>) {
    // Devices with their port while plugged, and their present or last port.
    let begin: BTreeMap<&str, bool> = devices.iter().map(|device| (device.name.as_str(), device.plugged)).collect();
    let mut plugged = begin.clone();
    let mut ports: BTreeMap<&str, &str> =
        devices.iter().map(|device| (device.name.as_str(), device.usb.port.as_str())).collect();
    for placed in events {
        let ScenarioEvent { at, device, action } = &placed.event;
        let report = |message: String, fix: &str| placed.section.report(placed.key, message, fix);
        let Some(state) = plugged.get(device.as_str()).copied() else { continue };
        match (action, state) {
            (ScenarioAction::Plug { .. }, true) => {
                let message = format!("{device} is already plugged at {at:?}");
                report(message, "unplug it before, or write plugged = false at its [[device]]");
            }
            (ScenarioAction::Unplug | ScenarioAction::Silence | ScenarioAction::Resume, false) => {
                report(format!("{device} is not plugged at {at:?}"), "plug it before");
            }
            _ => {}
        }
        if let ScenarioAction::Plug { port } = action {
            if let Some(port) = port.as_deref() {
                ports.insert(device, port);
            }
            let own = ports.get(device.as_str()).copied();
            let holder = ports.iter().find(|(name, port)| {
                **name != device.as_str() && Some(**port) == own && plugged.get(*name).copied().unwrap_or(false)
            });
            if let Some((holder, port)) = holder {
                report(format!("port {port} is taken by {holder} at {at:?}"), "name another port");
            }
            plugged.insert(device, true);
        } else if *action == ScenarioAction::Unplug {
            plugged.insert(device, false);
        }
    }
    let Some(repeat) = repeat else { return };
    for placed in events.iter().filter(|placed| placed.event.at >= repeat) {
        let message = "it never happens: the events repeat before it".to_owned();
        placed.section.report("at", message, "make repeat longer than the time of every event");
    }
    for (name, state) in begin {
        if plugged.get(name).is_some_and(|end| *end != state)
            && let Some(last) = events.iter().rfind(|placed| placed.event.device == name)
        {
            let message =
                format!("with repeat {name} must end as it began: {}", if state { "plugged" } else { "unplugged" });
            last.section.report(last.key, message, "add the event that undoes this one");
        }
    }
}

/// A simulated device with an entry's identity and format; its port may still be empty.
fn standing_for(spec: &DeviceSpec, name: &str) -> ScenarioDevice {
    let source = spec.node.of_kind().simulated(u64::from(spec.id.bit()));
    let expected = spec.identity.usb();
    let lan = expected.is_none().then(|| LanIdentity {
        entry: spec.name.clone(),
        address: format!("sim:{name}"),
        instance: None,
    });
    let usb = UsbIdentity {
        vid: expected.map_or(0, |expected| expected.vid),
        pid: expected.map_or(0, |expected| expected.pid),
        serial: Some(spec.identity.serial().map_or_else(|| format!("SIM-{name}"), str::to_owned)),
        port: expected.and_then(|expected| expected.port.clone()).unwrap_or_default(),
        product: Some(format!("simulated {}", spec.name)),
        manufacturer: Some("rapid".to_owned()),
        firmware: Some("1.00".to_owned()),
    };
    ScenarioDevice { name: name.to_owned(), usb, lan, source, plugged: true, faults: SimFaults::default() }
}

/// Ports of a bus no rig has, for devices without a declared port.
fn invent_ports(devices: &mut [ScenarioDevice]) {
    let mut taken: Vec<String> = devices.iter().map(|device| device.usb.port.clone()).collect();
    for device in devices.iter_mut().filter(|device| device.usb.port.is_empty()) {
        let port = (1..=taken.len() + 1).map(|number| format!("9-{number}")).find(|port| !taken.contains(port));
        device.usb.port = port.unwrap_or_default();
        taken.push(device.usb.port.clone());
    }
}

#[cfg(test)]
mod tests;
