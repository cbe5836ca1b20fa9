//! The verdict on a file, by what it holds.
//!
//! What the file does not hold is taken from the recorder's summary where there is one: which of the
//! missing samples the device lost, and which samples the driver called damaged.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::{Map, Value};

use super::super::metadata::CUT_SHORT;
use super::super::publishers::Publishers;
use super::super::quality::{Frames, Measured, Measures, Seen, Spread};
use super::super::session::SETTLE;
use super::super::verdict::{Facts, FileState, Judged, Losses, judge};
use super::super::walk::{FileEnd, Walked};
use super::super::wire::{Proto, protobuf};
use super::ModalityReport;
use crate::mask::PhysicalMask;
use crate::modality::{MAX_MODALITIES, ModalityId, ModalityKind};
use crate::registry::{Registry, VerdictSpec};
use crate::status::{Grade, Verdict};
use crate::time::nanoseconds;

/// No registry is longer; the text of a hostile file may be.
const LONGEST_REGISTRY: usize = 1 << 20;
/// Patience with a modality of which the registry says nothing.
const STALL_AFTER: Duration = Duration::from_millis(500);

/// How a file came to its end.
#[derive(Debug)]
pub(super) struct Ending<'a> {
    /// What was found in it.
    pub(super) file: Walked,
    /// Length of the episode, seconds.
    pub(super) seconds: f64,
    /// The recorder's summary; empty without one.
    pub(super) summary: &'a BTreeMap<String, String>,
    /// It was made of one that was not whole.
    pub(super) repaired: bool,
}

/// Measures an episode while its file is read.
#[derive(Debug)]
pub(super) struct Judge {
    measures: Measures,
    begin_ns: u64,
    limits: Vec<Option<VerdictSpec>>,
    /// Modalities by name.
    layout: BTreeMap<String, ModalityId>,
    /// Next number of each modality, and how many are missing.
    numbers: Vec<(Option<u32>, u64)>,
    /// By the events of the file.
    publishers: Publishers,
}

impl Judge {
    /// A judge of the episode whose metadata say this; `None` if it is none of ours.
    pub(super) fn of(about: &BTreeMap<String, String>) -> Option<Self> {
        let number = |key: &str| about.get(key)?.parse::<u64>().ok();
        let begin_ns = number("begin_wall_ns")?;
        let hz = about.get("observation_hz")?.parse().ok()?;
        let modalities = registered(about).or_else(|| listed(about))?;
        let latency = Duration::from_nanos(modalities.iter().map(|measured| measured.latency_ns).max().unwrap_or(0));
        let window = Duration::from_nanos(number("sync_window_ns")?);
        let wait = window.saturating_add(SETTLE).saturating_add(latency);
        let mut limits = vec![None; MAX_MODALITIES];
        for measured in &modalities {
            if let Some(place) = limits.get_mut(measured.id.index()) {
                *place = Some(measured.limits);
            }
        }
        let measures = Measures::new(&modalities, Frames { begin_ns, hz, wait });
        let layout = objects(about, "layout")
            .filter_map(|(name, bit)| Some((name, ModalityId::new(u8::try_from(bit.as_u64()?).ok()?)?)));
        let layout = layout.collect();
        let mut judge = Self {
            measures,
            begin_ns,
            limits,
            layout,
            numbers: vec![(None, 0); MAX_MODALITIES],
            publishers: Publishers::default(),
        };
        for (device, _) in objects(about, "serials") {
            judge.plugged(&device, begin_ns, true);
        }
        Some(judge)
    }

    /// Takes that a device was plugged in, or out.
    pub(super) fn plugged(&mut self, device: &str, at_ns: u64, there: bool) {
        if let Some(id) = self.layout.get(device) {
            self.measures.plugged(*id, at_ns, there);
        }
    }

    /// Takes the event `publisher`, as JSON.
    pub(super) fn publisher(&mut self, json: &str) {
        self.publishers.event(json);
    }

    /// Takes the message of a sample.
    pub(super) fn sample(&mut self, id: ModalityId, sequence: u32, captured: u64, received: u64, message: &[u8]) {
        if let Some((next, missing)) = self.numbers.get_mut(id.index()) {
            // Numbers wrap after 32 bits; a step of more than half of that goes backwards.
            let step = next.map_or(0, |next| sequence.wrapping_sub(next));
            *missing += u64::from(if step <= u32::MAX / 2 { step } else { 0 });
            *next = Some(sequence.wrapping_add(1));
        }
        // The bytes are field 2, of a RawImage field 6; a CompressedImage has its format in field 3.
        let (mut payload, mut jpeg): (&[u8], bool) = (&[], false);
        for (field, value) in protobuf(message) {
            match (field, value) {
                (2 | 6, Proto::Bytes(bytes)) => payload = bytes,
                (3, Proto::Bytes(format)) => jpeg = format == b"jpeg",
                _ => {}
            }
        }
        let seen = Seen {
            seq: sequence.into(),
            capture_ns: captured,
            recv_ns: received,
            flagged: false,
            jpeg,
            payload,
            repeated: None,
        };
        self.measures.sample(id, &seen);
    }

    /// Takes a mask.
    pub(super) fn mask(&mut self, at_ns: u64, mask: PhysicalMask) {
        self.measures.mask(at_ns, mask);
    }

    /// Takes the message of a frame.
    pub(super) fn frame(&mut self, message: &[u8]) {
        // As in the recorder: masks of the time of a frame lie before it.
        self.measures.settle();
        let slots = protobuf(message).filter(|(field, _)| *field == 4).filter_map(|(_, slot)| {
            let (mut bit, mut valid, mut present, mut age) = (0, false, false, 0);
            for (field, value) in protobuf(slot.bytes()) {
                match field {
                    1 => bit = value.number(),
                    2 => valid = value.number() != 0,
                    4 => age = value.zigzag(),
                    6 => present = value.number() != 0,
                    _ => {}
                }
            }
            Some((ModalityId::new(u8::try_from(bit).ok()?)?, present, valid.then_some(age)))
        });
        self.measures.frame(slots);
    }

    /// Between the earliest and the latest sample of a frame, ms.
    pub(super) fn skew(&self) -> Option<Spread> {
        self.measures.skew()
    }

    /// The verdict; what it is made of is added to the reports of the modalities.
    pub(super) fn judge(&self, modalities: &mut [ModalityReport], ending: &Ending<'_>) -> Verdict {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let end_ns = self.begin_ns.saturating_add((ending.seconds * 1e9).round() as u64);
        let counted: Option<Value> =
            ending.summary.get("modalities").and_then(|counted| serde_json::from_str(counted).ok());
        for report in modalities.iter_mut() {
            let Some(id) = ModalityId::new(report.bit) else { continue };
            let Some(mut quality) = self.measures.quality(id, end_ns) else { continue };
            let missing = self.numbers.get(id.index()).map_or(0, |(_, missing)| *missing);
            let said = |key: &str| counted.as_ref()?.get(&report.name)?.get(key)?.as_u64();
            quality.lost = said("lost").unwrap_or(0);
            quality.dropped = said("dropped").unwrap_or(missing);
            quality.damaged = quality.truncated.max(said("damaged").unwrap_or(0));
            report.topic.hz = quality.hz.unwrap_or(0.0);
            report.topic.longest_gap = quality.longest_gap;
            report.topic.missing = missing;
            report.quality = Some(quality);
        }
        // A modality with two schemas has two channels and is still one.
        let mut bits = std::collections::BTreeSet::new();
        let judged: Vec<Judged<'_>> = modalities
            .iter()
            .filter(|report| bits.insert(report.bit))
            .filter_map(|report| {
                let limits = self.limits.get(usize::from(report.bit)).copied().flatten()?;
                Some(Judged { name: &report.name, quality: report.quality.as_ref()?, limits })
            })
            .collect();
        let said = |key: &str| ending.summary.get(key).and_then(|count| count.parse().ok()).unwrap_or(0);
        let publishers = self.publishers.clone().or_summed_up(ending.summary);
        let facts = Facts {
            publishers: publishers.list(),
            modalities: &judged,
            masks_dropped: said("masks_dropped"),
            events_missed: said("events_missed"),
            seconds: ending.seconds,
            // A repaired file's summary counts what is there.
            losses: if counted.is_some() && ending.summary.contains_key("lost") {
                Losses::Apart
            } else {
                Losses::Together
            },
            file: file_state(ending),
        };
        judge(&facts)
    }
}

const DAMAGED: &str = "parts of it are damaged";

fn file_state<'a>(ending: &Ending<'a>) -> FileState<'a> {
    let Ending { file: walked, summary, repaired, .. } = ending;
    let cut_short = summary.get(CUT_SHORT);
    match walked.end {
        FileEnd::Finished if *repaired => FileState::NotWhole("it was repaired, and what came last may be missing"),
        // A check value that is not right counts as much as a chunk that cannot be read.
        FileEnd::Finished if walked.damaged_chunks == 0 && walked.sound => match cut_short {
            Some(why) => FileState::NotWhole(why),
            // Whoever wrote the footer: what the recorder ends, it sums up.
            None if summary.is_empty() => FileState::NotWhole("the recorder has not finished it"),
            None => FileState::Whole,
        },
        FileEnd::Finished => FileState::NotWhole(DAMAGED),
        FileEnd::Unfinished => FileState::NotWhole("the recorder has not finished it"),
        FileEnd::Torn => FileState::NotWhole("its last record is cut"),
        FileEnd::Damaged => FileState::NotWhole("from some place on it cannot be read"),
    }
}

/// The entries of an object that `about` holds as JSON; none if it is none.
fn objects(about: &BTreeMap<String, String>, key: &str) -> impl Iterator<Item = (String, Value)> + use<> {
    let object = about.get(key).and_then(|text| serde_json::from_str::<Map<String, Value>>(text).ok());
    object.unwrap_or_default().into_iter()
}

/// What the recorder's summary says; `None` in a file that has no verdict.
pub(super) fn recorded_verdict(summary: &BTreeMap<String, String>) -> Option<Verdict> {
    let word = summary.get("verdict")?;
    let grade = [Grade::Good, Grade::Suspect, Grade::Bad].into_iter().find(|grade| grade.word() == word)?;
    let reasons = summary.get("reasons").and_then(|reasons| serde_json::from_str(reasons).ok()).unwrap_or_default();
    Some(Verdict { grade, reasons })
}

/// The modalities by the registry in the file.
fn registered(about: &BTreeMap<String, String>) -> Option<Vec<Measured>> {
    let text = about.get("registry").filter(|text| text.len() <= LONGEST_REGISTRY)?;
    let registry = Registry::parse(text, None).ok()?.registry;
    // Nothing is reserved: how large payloads are, a file is not believed.
    let measured = registry.devices.iter().map(|device| Measured {
        id: device.id,
        limits: device.verdict,
        latency_ns: nanoseconds(device.latency),
    });
    Some(measured.collect())
}

/// The modalities by their list, where this version does not understand the registry.
fn listed(about: &BTreeMap<String, String>) -> Option<Vec<Measured>> {
    let list: Vec<Value> = serde_json::from_str(about.get("modalities")?).ok()?;
    let measured = |entry: &Value| {
        let id = ModalityId::new(u8::try_from(entry.get("bit")?.as_u64()?).ok()?)?;
        let kind: ModalityKind = serde_json::from_value(entry.get("kind")?.clone()).ok()?;
        // Files of earlier versions have no latencies.
        let latency_ns = entry.get("latency_ns").and_then(Value::as_u64).unwrap_or(0);
        Some(Measured { id, limits: VerdictSpec::of(kind, STALL_AFTER, None), latency_ns })
    };
    Some(list.iter().filter_map(measured).collect())
}
