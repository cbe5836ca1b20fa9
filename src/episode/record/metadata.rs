//! The metadata of an episode: the record `rapid` at its beginning and
//! `rapid/summary` at its end. Values are text; those that are JSON are marked as such here.

use std::collections::BTreeMap;

use rapid_core::mask::PhysicalMask;
use rapid_core::time::{Stamp, WallClock, nanoseconds};
use rapid_registry::{ModuleSpec, Registry};
use rapid_status::Verdict;
use serde::Serialize;
use serde_json::{Map, Value, json};

use super::provenance::Units;
use super::publishers;
use super::quality::{Quality, Spread};
use super::sources::{self, REPLAY_OF};
use super::verdict::Facts;
use crate::{BOOT_ID, text_map};

/// Key of the record at the end: why the episode is not whole.
pub(super) const CUT_SHORT: &str = "cut_short";
/// Key of both records: which policy was at the controls.
pub(super) const POLICY: &str = "policy";

/// The record at the beginning.
///
/// `configuration` `{modules, present}` names the modules mounted and the modalities whose bits were set.
/// JSON: `layout` `{name: bit}`, `modalities` `[{name, bit, topic, kind, shape, when_stale,
/// latency_ns}]`, `serials` `{name: serial or null}` of what was attached when the episode began,
/// `provenance` (see [`Units::epochs`]) of what ran then, `tags` `{key: value}`, `policy` `{name, hash,
/// dry_run}` of the policy at the controls, absent if none was; `replay_of` `[{file, begin_ns, verdict, reasons}]` of
/// the recordings that were replayed, absent if none was. `boot_id` is the boot of this machine (proc(5)).
///
/// A message's `log_time` is its capture time as the kernel gave it. The latency is taken off when
/// a frame's samples are chosen: a sample stands for the moment `log_time - latency_ns`.
pub(super) fn beginning(
    registry: &Registry,
    task: &str,
    configuration: &Configuration,
    units: &Units,
    clock: WallClock,
    begin: Stamp,
) -> BTreeMap<String, String> {
    let layout: Map<String, Value> =
        registry.devices.iter().map(|device| (device.name.clone(), device.id.bit().into())).collect();
    let modalities: Vec<Value> = registry
        .devices
        .iter()
        .map(|device| {
            let modality = device.modality();
            json!({
                "name": device.name, "bit": device.id.bit(), "topic": device.topic,
                "kind": modality.kind, "shape": modality.shape, "when_stale": device.when_stale.word(),
                "latency_ns": nanoseconds(device.latency),
            })
        })
        .collect();
    let tags: Map<String, Value> =
        configuration.tags.iter().map(|(key, value)| (key.clone(), value.clone().into())).collect();
    let host = rustix::system::uname();
    let mut report = text_map([
        ("software", concat!("rapid ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("rig", registry.rig.name.clone()),
        ("task", task.to_owned()),
        ("tags", Value::Object(tags).to_string()),
        (CONFIGURATION, json!(configuration).to_string()),
        ("layout", Value::Object(layout).to_string()),
        ("modalities", Value::Array(modalities).to_string()),
        ("serials", units.serials().to_string()),
        ("provenance", json!(units.epochs(begin)).to_string()),
        ("commit", option_env!("RAPID_COMMIT").unwrap_or_default().to_owned()),
        ("kernel", host.release().to_string_lossy().into_owned()),
        ("host", host.nodename().to_string_lossy().into_owned()),
        ("registry", registry.text.clone()),
        ("observation_hz", registry.rig.observation_hz.to_string()),
        ("sync_window_ns", registry.rig.sync_window.as_nanos().to_string()),
        ("begin_wall_ns", clock.wall_ns(begin).to_string()),
        ("begin_monotonic_ns", begin.0.to_string()),
        ("wall_minus_monotonic_ns", clock.wall_ns(Stamp(0)).to_string()),
    ]);
    report.extend(units.policy().map(|policy| (POLICY.to_owned(), policy.to_string())));
    report.extend(replay_of(units, begin));
    // A repair trusts what was written last only where the kernel that wrote it still runs.
    report.extend(crate::boot_id().map(|id| (BOOT_ID.to_owned(), id)));
    report
}

/// Contents of the record at the end.
#[derive(Debug)]
pub(super) struct Ending<'a> {
    /// What the verdict follows from.
    pub(super) facts: &'a Facts<'a>,
    /// Messages written, those of the frame index included.
    pub(super) messages: u64,
    /// Ticks written.
    pub(super) frames: u64,
    /// Between the earliest and the latest sample of a frame.
    pub(super) skew: Option<Spread>,
    pub(super) verdict: &'a Verdict,
    /// Why the episode is not whole, if it is not.
    pub(super) cut_short: Option<&'a str>,
    /// Everything that was attached or ran at some time.
    pub(super) units: &'a Units,
    pub(super) begin: Stamp,
}

/// The record at the end.
///
/// `cut_short` is the reason why the recorder ended the episode before its time, and is absent where it did
/// not. `verdict` is GOOD, SUSPECT or BAD. JSON: `reasons` `["..."]`, why it is not GOOD; `sensors`
/// `{registered, recorded, without}`; `modalities`
/// `{name: {samples, bytes, lost, dropped, damaged, ...}}`, the fields of [`Quality`]; `skew_ms` `{p50,
/// p95, p99, max}` between the earliest and the latest sample of a frame, or null; `serials` and
/// `provenance` as at the beginning, of whatever was attached or ran at some time; `policy` and `replay_of` likewise;
/// `publishers` `[{topic, process, command, samples}]` of other programs that published on our topics, absent if none did.
pub(super) fn end(ending: &Ending<'_>) -> BTreeMap<String, String> {
    let Facts { modalities, missing, publishers, seconds, .. } = *ending.facts;
    let reports: Map<String, Value> =
        modalities.iter().map(|judged| (judged.name.to_owned(), json!(judged.quality))).collect();
    let sum = |count: fn(&Quality) -> u64| {
        modalities.iter().map(|judged| count(judged.quality)).fold(0, u64::saturating_add).to_string()
    };
    let mut report = text_map([
        ("verdict", ending.verdict.grade.word().to_owned()),
        ("reasons", json!(ending.verdict.reasons).to_string()),
        ("sensors", json!(ending.verdict.sensors).to_string()),
        ("duration_s", seconds.to_string()),
        ("messages", ending.messages.to_string()),
        ("frames", ending.frames.to_string()),
        ("lost", sum(|quality| quality.lost)),
        ("dropped", sum(|quality| quality.dropped)),
        ("damaged", sum(|quality| quality.damaged)),
        ("masks_dropped", missing.masks.to_string()),
        ("actions_dropped", missing.actions.to_string()),
        ("events_missed", missing.events.to_string()),
        ("modalities", Value::Object(reports).to_string()),
        ("skew_ms", json!(ending.skew).to_string()),
        ("serials", ending.units.serials().to_string()),
        ("provenance", json!(ending.units.epochs(ending.begin)).to_string()),
    ]);
    report.extend(ending.units.policy().map(|policy| (POLICY.to_owned(), policy.to_string())));
    report.extend(replay_of(ending.units, ending.begin));
    let others = (!publishers.is_empty()).then(|| json!(publishers).to_string());
    report.extend(others.map(|others| (publishers::KEY.to_owned(), others)));
    report.extend(ending.cut_short.map(|reason| (CUT_SHORT.to_owned(), reason.to_owned())));
    report
}

/// The recordings that were replayed.
fn replay_of(units: &Units, begin: Stamp) -> Option<(String, String)> {
    let replayed = sources::replayed(&units.epochs(begin));
    (!replayed.is_empty()).then(|| (REPLAY_OF.to_owned(), json!(replayed).to_string()))
}

/// The configuration an episode is recorded with: modules, tags, and the sensors that were present. As JSON the value of
/// [`CONFIGURATION`] in the metadata of an episode's beginning.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub(super) struct Configuration {
    /// Mounted modules, one for each slot: those whose sensors are all present and of no other module, and those named.
    pub(super) modules: Vec<String>,
    /// Modalities whose bits are set when the episode begins, ascending by bit.
    pub(super) present: Vec<String>,
    /// Those of the user, then those of the modules whose keys the user did not use.
    #[serde(skip)]
    pub(super) tags: Vec<(String, String)>,
    /// Modules that were named although another one reports by its sensors that it is in their slot: both names.
    #[serde(skip)]
    pub(super) contradicted: Vec<(String, String)>,
}

/// Key of the configuration in the metadata of an episode's beginning.
pub(super) const CONFIGURATION: &str = "configuration";

impl Configuration {
    /// With the declared modules and tags, and the mask of the beginning.
    pub(super) fn new(registry: &Registry, report: &[String], tags: &[(String, String)], mask: PhysicalMask) -> Self {
        let is_present = |name: &String| registry.named(name).is_some_and(|device| mask.contains(device.id));
        let mut found = Self {
            modules: Vec::new(),
            present: registry.devices.iter().map(|device| device.name.clone()).filter(is_present).collect(),
            tags: tags.to_vec(),
            contradicted: Vec::new(),
        };
        let is_sensed = |module: &ModuleSpec| {
            // One that shares a sensor with another is not known by it.
            let is_shared = |name: &String| {
                registry.modules.iter().any(|other| other.name != module.name && other.devices.contains(name))
            };
            !module.devices.is_empty() && module.devices.iter().all(is_present) && !module.devices.iter().any(is_shared)
        };
        for module in &registry.modules {
            let in_its_slot = |other: &&ModuleSpec| other.mount == module.mount && is_sensed(other);
            let sensed = registry.modules.iter().find(in_its_slot).map(|other| &other.name);
            match sensed {
                // What a sensor reports is there, whatever was named.
                Some(sensed) if *sensed != module.name => {
                    if report.contains(&module.name) {
                        found.contradicted.push((module.name.clone(), sensed.clone()));
                    }
                    continue;
                }
                None if !report.contains(&module.name) => continue,
                Some(_) | None => {}
            }
            found.modules.push(module.name.clone());
            for (key, value) in &module.tags {
                if !found.tags.iter().any(|(own, _)| own == key) {
                    found.tags.push((key.clone(), value.clone()));
                }
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modules_are_declared_or_detected_and_bring_their_tags() {
        let modules = "\n[module.tactile]\nslot = \"tip\"\ntags = [\"finger=tactile\"]\ndevices = [\"tactile_tip\"]\n\
            [module.soft]\nslot = \"tip\"\ntags = [\"finger=soft\", \"colour=red\"]\n[module.never]\nslot = \"front\"\n";
        let registry = Registry::parse(&format!("{}{modules}", rapid_registry::BUILTIN), None).unwrap().registry;
        let of = |report: &[&str], tags: &[(&str, &str)], mask| {
            let report: Vec<String> = report.iter().map(|name| (*name).to_owned()).collect();
            let tags: Vec<_> = tags.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
            let found = Configuration::new(&registry, &report, &tags, PhysicalMask(mask));
            let tags: Vec<String> = found.tags.iter().map(|(key, value)| format!("{key}={value}")).collect();
            format!("{} | {} | {}", found.modules.join(" "), found.present.join(" "), tags.join(" "))
        };
        assert_eq!(of(&[], &[], 0b101), " | cam_wrist motor_state | ");
        assert_eq!(of(&[], &[], 0b011), "tactile | cam_wrist tactile_tip | finger=tactile");
        assert_eq!(of(&["soft"], &[], 0b001), "soft | cam_wrist | finger=soft colour=red");
        assert_eq!(of(&["soft"], &[("finger", "mine")], 0), "soft |  | finger=mine colour=red");
        assert_eq!(
            of(&["soft"], &[], 0b011),
            "tactile | cam_wrist tactile_tip | finger=tactile",
            "its sensor is there"
        );
        // Two mounts for one camera: which of them carries it is declared.
        let mounts = "[module.straight]\nslot = \"top\"\ntags = [\"wrist=straight\"]\ndevices = [\"cam_wrist\"]\n\
            [module.angled]\nslot = \"top\"\ntags = [\"wrist=angled\"]\ndevices = [\"cam_wrist\"]\n";
        let registry = Registry::parse(&format!("{}{mounts}", rapid_registry::BUILTIN), None).unwrap().registry;
        let of = |report: &[String]| Configuration::new(&registry, report, &[], PhysicalMask(0b001)).modules;
        assert_eq!(of(&[]), Vec::<String>::new());
        assert_eq!(of(&["angled".to_owned()]), ["angled"]);
    }
}
