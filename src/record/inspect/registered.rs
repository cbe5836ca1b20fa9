//! The modalities of an episode, as its metadata name them.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::Value;

use super::super::quality::Measured;
use crate::modality::{ModalityId, ModalityKind};
use crate::registry::{Registry, VerdictSpec};
use crate::time::nanoseconds;

/// No registry is longer; the text of a hostile file may be.
const LONGEST_REGISTRY: usize = 1 << 20;
/// Patience with a modality that the registry gives none.
const STALL_AFTER: Duration = Duration::from_millis(500);

/// A modality of the registry in the file.
#[derive(Debug)]
pub(super) struct Registered {
    pub(super) name: String,
    pub(super) measured: Measured,
}

/// The modalities by the registry in the file, and the names of those that it expects.
pub(super) fn registered(about: &BTreeMap<String, String>) -> Option<(Vec<Registered>, Vec<String>)> {
    let text = about.get("registry").filter(|text| text.len() <= LONGEST_REGISTRY)?;
    let registry = Registry::parse(text, None).ok()?.registry;
    // Nothing is reserved: how large payloads are, a file is not believed.
    let measured = registry.devices.iter().map(|device| Registered {
        name: device.name.clone(),
        measured: Measured { id: device.id, limits: device.verdict, latency_ns: nanoseconds(device.latency) },
    });
    Some((measured.collect(), registry.rig.expect))
}

/// The modalities by their list, where this version does not understand the registry.
pub(super) fn listed(about: &BTreeMap<String, String>) -> Option<Vec<Registered>> {
    let list: Vec<Value> = serde_json::from_str(about.get("modalities")?).ok()?;
    let measured = |entry: &Value| {
        let name = entry.get("name")?.as_str()?.to_owned();
        let id = ModalityId::new(u8::try_from(entry.get("bit")?.as_u64()?).ok()?)?;
        let kind: ModalityKind = serde_json::from_value(entry.get("kind")?.clone()).ok()?;
        // Files of earlier versions have no latencies.
        let latency_ns = entry.get("latency_ns").and_then(Value::as_u64).unwrap_or(0);
        let measured = Measured { id, limits: VerdictSpec::of(kind, STALL_AFTER, None), latency_ns };
        Some(Registered { name, measured })
    };
    let mut modalities: Vec<Registered> = list.iter().map(measured).collect::<Option<_>>()?;
    modalities.sort_by_key(|modality| modality.measured.id);
    // A hostile list may name one twice.
    modalities.dedup_by_key(|modality| modality.measured.id);
    Some(modalities)
}
