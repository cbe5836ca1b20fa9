//! What a file says about itself: the metadata records `rapid` at its beginning and
//! `rapid/summary` at its end. Values are text; those that are JSON say so here.

use std::collections::BTreeMap;

use serde_json::{Map, Value, json};

use super::configuration::{self, Configuration};
use super::provenance::Units;
use super::publishers::{self, Publisher};
use super::quality::{Quality, Spread};
use crate::episode_format::{self, BOOT_ID};
use crate::registry::{DeviceSpec, Registry, WhenStale};
use crate::status::Verdict;
use crate::time::{Stamp, WallClock, nanoseconds};

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
/// dry_run}` of the policy at the controls, absent if none was. `boot_id` is the boot of this machine (proc(5)).
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
            let when_stale = match device.when_stale {
                WhenStale::Hold => "hold",
                WhenStale::Zero => "zero",
            };
            json!({
                "name": device.name, "bit": device.id.bit(), "topic": device.topic,
                "kind": modality.kind, "shape": modality.shape, "when_stale": when_stale,
                "latency_ns": nanoseconds(device.latency),
            })
        })
        .collect();
    let tags: Map<String, Value> =
        configuration.tags.iter().map(|(key, value)| (key.clone(), value.clone().into())).collect();
    let host = rustix::system::uname();
    let mut said = text_map([
        ("software", concat!("rapid ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("rig", registry.rig.name.clone()),
        ("task", task.to_owned()),
        ("tags", Value::Object(tags).to_string()),
        (configuration::KEY, json!(configuration).to_string()),
        ("layout", Value::Object(layout).to_string()),
        ("modalities", Value::Array(modalities).to_string()),
        ("serials", units.serials().to_string()),
        ("provenance", units.epochs(begin).to_string()),
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
    said.extend(units.policy().map(|policy| (POLICY.to_owned(), policy.to_string())));
    // A repair trusts what was written last only where the kernel that wrote it still runs.
    said.extend(episode_format::boot_id().map(|id| (BOOT_ID.to_owned(), id)));
    said
}

/// What the record at the end says.
#[derive(Debug)]
pub(super) struct Ending<'a> {
    /// Length in seconds.
    pub(super) seconds: f64,
    /// Messages written, those of the frame index included.
    pub(super) messages: u64,
    /// Ticks written.
    pub(super) frames: u64,
    /// Events that came faster than they were read.
    pub(super) events_missed: u64,
    /// Publications of the mask lost.
    pub(super) masks_dropped: u64,
    /// Actions lost.
    pub(super) actions_dropped: u64,
    /// Other programs that published on topics of ours.
    pub(super) publishers: &'a [Publisher],
    /// What each modality was like.
    pub(super) qualities: &'a [(&'a DeviceSpec, Quality)],
    /// Between the earliest and the latest sample of a frame.
    pub(super) skew: Option<Spread>,
    /// The verdict.
    pub(super) verdict: Verdict,
    /// Why the episode is not whole, if it is not.
    pub(super) cut_short: Option<&'a str>,
    /// Everything that was attached or ran at some time.
    pub(super) units: &'a Units,
    /// When the episode began.
    pub(super) begin: Stamp,
}

/// The record at the end.
///
/// `cut_short` says why the recorder ended the episode before its time, and is absent where it did
/// not. `verdict` is GOOD, SUSPECT or BAD. JSON: `reasons` `["..."]`, why it is not GOOD; `sensors`
/// `{registered, recorded, without}`; `modalities`
/// `{name: {samples, bytes, lost, dropped, damaged, ...}}`, the fields of [`Quality`]; `skew_ms` `{p50,
/// p95, p99, max}` between the earliest and the latest sample of a frame, or null; `serials` and
/// `provenance` as at the beginning, of whatever was attached or ran at some time; `policy` likewise;
/// `publishers` `[{topic, process, command, samples}]` of other programs that published on our topics, absent if none did.
pub(super) fn end(ending: &Ending<'_>) -> BTreeMap<String, String> {
    let modalities: Map<String, Value> =
        ending.qualities.iter().map(|(device, quality)| (device.name.clone(), json!(quality))).collect();
    let sum = |count: fn(&Quality) -> u64| {
        ending.qualities.iter().map(|(_, quality)| count(quality)).fold(0, u64::saturating_add).to_string()
    };
    let mut said = text_map([
        ("verdict", ending.verdict.grade.word().to_owned()),
        ("reasons", json!(ending.verdict.reasons).to_string()),
        ("sensors", json!(ending.verdict.sensors).to_string()),
        ("duration_s", ending.seconds.to_string()),
        ("messages", ending.messages.to_string()),
        ("frames", ending.frames.to_string()),
        ("lost", sum(|quality| quality.lost)),
        ("dropped", sum(|quality| quality.dropped)),
        ("damaged", sum(|quality| quality.damaged)),
        ("masks_dropped", ending.masks_dropped.to_string()),
        ("actions_dropped", ending.actions_dropped.to_string()),
        ("events_missed", ending.events_missed.to_string()),
        ("modalities", Value::Object(modalities).to_string()),
        ("skew_ms", json!(ending.skew).to_string()),
        ("serials", ending.units.serials().to_string()),
        ("provenance", ending.units.epochs(ending.begin).to_string()),
    ]);
    said.extend(ending.units.policy().map(|policy| (POLICY.to_owned(), policy.to_string())));
    let others = (!ending.publishers.is_empty()).then(|| json!(ending.publishers).to_string());
    said.extend(others.map(|others| (publishers::KEY.to_owned(), others)));
    said.extend(ending.cut_short.map(|reason| (CUT_SHORT.to_owned(), reason.to_owned())));
    said
}

fn text_map<const N: usize>(pairs: [(&str, String); N]) -> BTreeMap<String, String> {
    pairs.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}
