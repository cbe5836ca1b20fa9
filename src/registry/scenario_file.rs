//! Scenario files: TOML that says which simulated devices there are and what happens to them.
//!
//! ```toml
//! repeat = "12s"              # optional: after this time the events begin again
//!
//! [[device]]                  # optional: without any, every entry of the registry is simulated
//! name = "tactile_tip"        # an entry of the registry, whose identity and format it takes
//! seed = 7                    # chooses the pictures or values; default: the entry's bit
//! hz = 100                    # rate; default: the camera's fps, 100 for a serial line
//! bytes = "60kB"              # a camera's pictures are filled up to this size, as real scenes fill them
//! plugged = false             # when the scenario begins; default true
//! serial = "OTHER"            # also vid, pid, port, firmware, manufacturer, product: what it says it
//!                             # is; serial = "" for none
//!
//! [[device]]
//! name = "spare"              # any name, with
//! like = "tactile_tip"        # the entry whose format it takes
//! [device.fault]              # optional: what the device above does wrong
//! freeze_at = "3s"            # from then on it sends the same bytes
//! truncate_every = 10         # one sample in ten is cut in the middle
//! duplicate_every = 10        # one in ten is sent twice
//! lose_every = 10             # one in ten is lost, and the device says so
//! delay = "200ms"             # samples arrive so long after their capture
//! latency = "35ms"            # pictures show the light of `rapid calibrate` so long before their capture
//! clock_ppm = 500             # its clock runs fast, or slow if negative
//! close = "2s"                # closing it takes so long, as ending the recording of a GoPro does
//!
//! [[event]]                   # exactly one of plug, unplug, silence, resume
//! at = "3s"
//! unplug = "tactile_tip"
//!
//! [[event]]
//! at = "6s"
//! plug = "tactile_tip"
//! port = "1-4"                # optional, with plug: another port
//! ```
//!
//! An entry without a serial number or port gets an invented one: `SIM-<name>`, a port of bus 9.
//!
//! Invariant: no text makes this panic; all problems are reported at once.
//! Invariant: in a scenario that was accepted a device is only plugged while unplugged and the
//! reverse, at every repetition.

mod standing;

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use super::diagnostic::{RegistryErrors, did_you_mean};
use super::parse::{is_port, read_file};
use super::scenario::{Scenario, ScenarioAction, ScenarioDevice, ScenarioEvent, SimFaults, SimSource};
use super::section::{Problems, Section, file_label, read};
use super::spec::{NodeSpec, Registry};
use standing::{invent_ports, standing_for};

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
/// What a simulated camera adds to each picture, at the most: its name.
const PICTURE_NAME_BYTES: usize = 64;
const LONGEST: Duration = Duration::from_hours(7 * 24);

impl Scenario {
    /// Reads a scenario file for the devices of `registry`.
    ///
    /// # Errors
    /// When the file cannot be read or says something wrong: then all of it.
    pub fn load(path: &Path, registry: &Registry) -> Result<Self, RegistryErrors> {
        let text = read_file(path, "`rapid --sim` without a file plays the demonstration; name a scenario file")?;
        Self::parse(&text, Some(path), registry)
    }

    /// Reads the text of a scenario; `path` names it in messages.
    ///
    /// # Errors
    /// All that is wrong with the text.
    pub fn parse(text: &str, path: Option<&Path>, registry: &Registry) -> Result<Self, RegistryErrors> {
        let mut problems = Problems::new(file_label(path, "scenario"), text);
        let document = read(text, &mut problems);
        problems.check()?;
        let root = Section::new(document.get_ref(), 0, String::new());
        root.allow(&mut problems, &["repeat", "device", "event"]);
        let repeat = root.duration(&mut problems, "repeat", Duration::from_millis(10)..=LONGEST);
        let devices = if root.has("device") { devices(&root, registry, &mut problems) } else { every_entry(registry) };
        let mut events = events(&root, &devices, &mut problems);
        // Stable: the order in the file decides between equal times.
        events.sort_by_key(|event| event.event.at);
        check_order(&events, &devices, repeat, &mut problems);
        problems.check()?;
        Ok(Self { devices, events: events.into_iter().map(|placed| placed.event).collect(), repeat })
    }

    /// Every entry is plugged in, and nothing happens.
    #[must_use]
    pub(super) fn quiet(registry: &Registry) -> Self {
        Self { devices: every_entry(registry), events: Vec::new(), repeat: None }
    }

    /// What `rapid --sim` plays without a file: everything is plugged; the second camera, or for
    /// want of one the last device, is pulled at 3 s and plugged again at 6 s, every 12 s.
    #[must_use]
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

fn devices(root: &Section<'_>, registry: &Registry, problems: &mut Problems<'_>) -> Vec<ScenarioDevice> {
    let mut devices = Vec::new();
    let mut ports: BTreeMap<String, usize> = BTreeMap::new();
    for section in root.tables(problems, "device") {
        let Some(device) = device(&section, registry, problems) else { continue };
        if devices.iter().any(|earlier: &ScenarioDevice| earlier.name == device.name) {
            let message = format!("{:?} is already a device of this scenario", device.name);
            let fix = format!("give it a name of its own and like = {:?}", device.name);
            section.report(problems, "name", message, fix);
        }
        if !device.usb.port.is_empty() {
            if let Some(line) = ports.get(&device.usb.port) {
                let message = format!("port {} is already that of the device on line {line}", device.usb.port);
                section.report(problems, "port", message, "give each device a port of its own: port = \"1-4\"");
            }
            ports.insert(device.usb.port.clone(), problems.line(section.at));
        }
        devices.push(device);
    }
    invent_ports(&mut devices);
    devices
}

fn device(section: &Section<'_>, registry: &Registry, problems: &mut Problems<'_>) -> Option<ScenarioDevice> {
    section.allow(problems, &DEVICE_KEYS);
    if !section.has("name") {
        section.missing(problems, "name", "write name = the device's name in devices.toml");
    }
    let name = section.text(problems, "name")?.value;
    let (key, entry) =
        if section.has("like") { ("like", section.text(problems, "like")?.value) } else { ("name", name) };
    let Some(spec) = registry.named(entry) else {
        let known: Vec<&str> = registry.devices.iter().map(|device| device.name.as_str()).collect();
        let fix = did_you_mean(entry, &known, "registered are");
        section.report(problems, key, format!("{entry:?} is not in the registry"), fix);
        return None;
    };
    let mut device = standing_for(spec, name);
    let seed = section.integer(problems, "seed", 0..=i64::MAX).and_then(|seed| u64::try_from(seed.value).ok());
    let hz = section.integer(problems, "hz", 1..=10_000).and_then(|hz| u32::try_from(hz.value).ok());
    let most = spec.max_bytes.saturating_sub(PICTURE_NAME_BYTES) as u64;
    let bytes = section.size(problems, "bytes", 0..=most).and_then(|bytes| usize::try_from(bytes).ok());
    if let (Some(filled), SimSource::Camera { bytes, .. }) = (bytes, &mut device.source) {
        *bytes = filled;
    } else if section.has("bytes") && !matches!(device.source, SimSource::Camera { .. }) {
        let message = format!("{entry:?} sends no pictures, only they have a size");
        section.report(problems, "bytes", message, "leave bytes out");
    }
    match &mut device.source {
        SimSource::Camera { fps: rate, seed: chosen, .. } | SimSource::Serial { hz: rate, seed: chosen, .. } => {
            *rate = hz.unwrap_or(*rate);
            *chosen = seed.unwrap_or(*chosen);
        }
        SimSource::Task { .. } | SimSource::Process | SimSource::Replay { .. } => {}
    }
    device.plugged = section.flag(problems, "plugged").unwrap_or(true);
    device.usb.vid = section.usb_id(problems, "vid").unwrap_or(device.usb.vid);
    device.usb.pid = section.usb_id(problems, "pid").unwrap_or(device.usb.pid);
    if let Some(serial) = section.text(problems, "serial").map(|serial| serial.value) {
        // What a device says of itself is no mistake of the file, whatever it is.
        device.usb.serial = (!serial.is_empty()).then(|| serial.to_owned());
    }
    if let Some(port) = port(section, problems) {
        device.usb.port = port;
    }
    device.faults = faults(section, problems);
    let usb = &mut device.usb;
    for (key, place) in
        [("firmware", &mut usb.firmware), ("manufacturer", &mut usb.manufacturer), ("product", &mut usb.product)]
    {
        if let Some(text) = section.text(problems, key) {
            *place = (!text.value.is_empty()).then(|| text.value.to_owned());
        }
    }
    Some(device)
}

fn faults(section: &Section<'_>, problems: &mut Problems<'_>) -> SimFaults {
    let Some(table) = section.table(problems, "fault") else { return SimFaults::default() };
    let every = ["truncate_every", "duplicate_every", "lose_every"];
    let mut known = every.to_vec();
    known.extend(["freeze_at", "delay", "latency", "clock_ppm", "close"]);
    table.allow(problems, &known);
    // At least 2: of a device all of whose samples are lost none ever comes.
    let [truncate_every, duplicate_every, lose_every] =
        every.map(|key| u64::try_from(table.integer(problems, key, 2..=1_000_000)?.value).ok());
    SimFaults {
        freeze_at: table.duration(problems, "freeze_at", Duration::ZERO..=LONGEST),
        truncate_every,
        duplicate_every,
        lose_every,
        delay: table.duration(problems, "delay", Duration::ZERO..=Duration::from_secs(10)).unwrap_or_default(),
        latency: table.duration(problems, "latency", Duration::ZERO..=Duration::from_secs(1)).unwrap_or_default(),
        clock_ppm: table.integer(problems, "clock_ppm", -100_000..=100_000).map_or(0, |ppm| ppm.value),
        close: table.duration(problems, "close", Duration::ZERO..=Duration::from_secs(10)).unwrap_or_default(),
    }
}

fn port(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<String> {
    let port = section.text(problems, "port")?.value;
    if is_port(port) {
        return Some(port.to_owned());
    }
    let fix = "write it as the kernel does, bus-port.port, for example port = \"1-2.3\"";
    section.report(problems, "port", format!("{port:?} is not a USB port path"), fix);
    None
}

/// An event and where the file says it.
struct Placed<'a> {
    section: Section<'a>,
    key: &'static str,
    event: ScenarioEvent,
}

fn events<'a>(root: &Section<'a>, devices: &[ScenarioDevice], problems: &mut Problems<'_>) -> Vec<Placed<'a>> {
    let sections = root.tables(problems, "event");
    sections.into_iter().filter_map(|section| event(section, devices, problems)).collect()
}

fn event<'a>(section: Section<'a>, devices: &[ScenarioDevice], problems: &mut Problems<'_>) -> Option<Placed<'a>> {
    section.allow(problems, &EVENT_KEYS);
    if !section.has("at") {
        section.missing(problems, "at", "write at = the time from the beginning, for example at = \"3s\"");
    }
    let at = section.duration(problems, "at", Duration::ZERO..=LONGEST);
    let given: Vec<&'static str> = ACTIONS.into_iter().filter(|action| section.has(action)).collect();
    let [key] = given.as_slice() else {
        let message = match given.as_slice() {
            [] => "nothing happens in this event".to_owned(),
            several => format!("{} in one event", several.join(" and ")),
        };
        problems.report(section.at, &section.entry, message, "write exactly one of plug, unplug, silence, resume");
        return None;
    };
    let name = section.text(problems, key)?.value;
    if !devices.iter().any(|device| device.name == name) {
        let known: Vec<&str> = devices.iter().map(|device| device.name.as_str()).collect();
        let fix = did_you_mean(name, &known, "devices of this scenario");
        section.report(problems, key, format!("{name:?} is not a device of this scenario"), fix);
        return None;
    }
    let port = port(&section, problems);
    let action = match *key {
        "plug" => ScenarioAction::Plug { port },
        "unplug" => ScenarioAction::Unplug,
        "silence" => ScenarioAction::Silence,
        _ => ScenarioAction::Resume,
    };
    if section.has("port") && *key != "plug" {
        section.report(problems, "port", format!("a port has no meaning with {key}"), "give a port with plug only");
    }
    let event = ScenarioEvent { at: at?, device: name.to_owned(), action };
    Some(Placed { section, key, event })
}

/// Plays the events once on paper.
fn check_order(
    events: &[Placed<'_>],
    devices: &[ScenarioDevice],
    repeat: Option<Duration>,
    problems: &mut Problems<'_>,
) {
    // Device to its port while plugged, and its port now or last.
    let begin: BTreeMap<&str, bool> = devices.iter().map(|device| (device.name.as_str(), device.plugged)).collect();
    let mut plugged = begin.clone();
    let mut ports: BTreeMap<&str, &str> =
        devices.iter().map(|device| (device.name.as_str(), device.usb.port.as_str())).collect();
    for placed in events {
        let ScenarioEvent { at, device, action } = &placed.event;
        let report = |problems: &mut Problems<'_>, message: String, fix: &str| {
            placed.section.report(problems, placed.key, message, fix);
        };
        let Some(state) = plugged.get(device.as_str()).copied() else { continue };
        match (action, state) {
            (ScenarioAction::Plug { .. }, true) => {
                let message = format!("{device} is already plugged at {at:?}");
                report(problems, message, "unplug it before, or write plugged = false at its [[device]]");
            }
            (ScenarioAction::Unplug | ScenarioAction::Silence | ScenarioAction::Resume, false) => {
                report(problems, format!("{device} is not plugged at {at:?}"), "plug it before");
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
                report(problems, format!("port {port} is taken by {holder} at {at:?}"), "name another port");
            }
        }
        match action {
            ScenarioAction::Plug { .. } => drop(plugged.insert(device, true)),
            ScenarioAction::Unplug => drop(plugged.insert(device, false)),
            ScenarioAction::Silence | ScenarioAction::Resume => {}
        }
    }
    let Some(repeat) = repeat else { return };
    for placed in events.iter().filter(|placed| placed.event.at >= repeat) {
        let message = "it never happens: the events begin again before".to_owned();
        placed.section.report(problems, "at", message, "make repeat longer than the time of every event");
    }
    for (name, state) in begin {
        if plugged.get(name).is_some_and(|end| *end != state)
            && let Some(last) = events.iter().rfind(|placed| placed.event.device == name)
        {
            let message =
                format!("with repeat {name} must end as it began: {}", if state { "plugged" } else { "unplugged" });
            last.section.report(problems, last.key, message, "add the event that undoes this one");
        }
    }
}

#[cfg(test)]
mod tests;
