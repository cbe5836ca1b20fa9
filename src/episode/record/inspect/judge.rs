//! The verdict on a file, by its content.
//!
//! Facts that the file does not hold come from the recorder's summary, if there is one: which of the missing samples
//! the device lost, which samples the driver called damaged, and the recorder's findings.
//!
//! GOOD is earned. The file is finished, every byte of it is under a check value that is there and right, its
//! metadata `rapid` and `rapid/summary` were read, the registry in it was understood, what the recorder counted is in
//! it, and no check of `record::verdict` objects to it. Anything missing is a reason.

use std::collections::BTreeMap;
use std::time::Duration;

use rapid_core::clip::ClipState;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::{MAX_MODALITIES, ModalityId, ModalityKind};
use rapid_core::sample::damage;
use rapid_pictures::judge::{Judgement, PictureJudge};
use rapid_registry::{Registry, VerdictSpec};
use rapid_status::{Grade, Verdict};
use serde_json::{Map, Value};

use super::super::open_episode::SETTLE;
use super::super::publishers::Publishers;
use super::super::quality::{Frames, Measured, Measures, Quality, SampleFacts, Spread};
use super::super::verdict::{Facts, FileState, Judged, Losses, Missing, judge};
use super::ModalityReport;
use super::state::{self, Ending, file_state};
use crate::decode::{FrameSlot, Sample};
use crate::reader::Message;
use crate::{ABOUT, SUMMARY};

/// No registry is longer; the text of a hostile file may be.
const LONGEST_REGISTRY: usize = 1 << 20;
/// Patience with a modality without one in the registry.
const STALL_AFTER: Duration = Duration::from_millis(500);

/// Numbers of samples as they come, of which a message holds the lower 32 bits, and how many are missing.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Numbers {
    next: Option<u32>,
    pub(crate) missing: u64,
}

impl Numbers {
    pub(crate) fn add(&mut self, number: u32) {
        // Numbers wrap after 32 bits; a step of more than half of that goes backwards.
        let step = self.next.map_or(0, |next| number.wrapping_sub(next));
        self.missing += u64::from(if step <= u32::MAX / 2 { step } else { 0 });
        self.next = Some(number.wrapping_add(1));
    }
}

/// Measures an episode while its file is read.
#[derive(Debug)]
pub(super) struct Judge {
    measures: Measures,
    pictures: PictureJudge,
    begin_ns: u64,
    /// The registered modalities, ascending by bit.
    modalities: Vec<Measured>,
    /// The registry in the file is not understood: the limits are not its own.
    usual_limits: bool,
    /// Names of the modalities that every episode must have.
    expect: Vec<String>,
    /// Next number of each modality, and how many are missing.
    numbers: Vec<Numbers>,
    /// By the events of the file.
    publishers: Publishers,
}

impl Judge {
    /// A judge of the episode with these metadata; `None` if rapid did not record it.
    pub(super) fn from_metadata(about: &BTreeMap<String, String>) -> Option<Self> {
        let number = |key: &str| about.get(key)?.parse::<u64>().ok();
        let begin_ns = number("begin_wall_ns")?;
        let hz = about.get("observation_hz")?.parse().ok()?;
        let (modalities, expect, usual_limits) = match registered(about) {
            Some((modalities, expect)) => (modalities, expect, false),
            None => (listed(about)?, Vec::new(), true),
        };
        let latency = Duration::from_nanos(modalities.iter().map(|measured| measured.latency_ns).max().unwrap_or(0));
        let window = Duration::from_nanos(number("sync_window_ns")?);
        let wait = window.saturating_add(SETTLE).saturating_add(latency);
        let measures = Measures::new(&modalities, Frames { begin_ns, hz, window, wait });
        let numbers = vec![Numbers::default(); MAX_MODALITIES];
        let publishers = Publishers::default();
        let mut judge = Self {
            measures,
            pictures: PictureJudge::alone(),
            begin_ns,
            modalities,
            usual_limits,
            expect,
            numbers,
            publishers,
        };
        let serials = about.get("serials").and_then(|text| serde_json::from_str::<Map<String, Value>>(text).ok());
        for device in serials.unwrap_or_default().keys() {
            judge.plugged(device, begin_ns, true);
        }
        Some(judge)
    }

    /// Records that a device was plugged in or out.
    pub(super) fn plugged(&mut self, device: &str, at_ns: u64, there: bool) {
        if let Some(known) = self.modalities.iter().find(|known| known.name == device) {
            self.measures.plugged(known.id, at_ns, there);
        }
    }

    /// Takes the event `clock` of a device, as JSON.
    pub(super) fn clock(&mut self, device: &str, json: &str) {
        #[derive(serde::Deserialize)]
        struct Clock {
            uncertainty_ns: u64,
        }
        let known = self.modalities.iter().find(|known| known.name == device);
        // One that cannot be read is as bad as a clock that is not known.
        let ns = serde_json::from_str::<Clock>(json).map_or(u64::MAX, |clock| clock.uncertainty_ns);
        if let Some(known) = known {
            self.measures.uncertainty(known.id, ns);
        }
    }

    /// Takes the event `clip` of a device, as JSON.
    pub(super) fn clip(&mut self, device: &str, at_ns: u64, json: &str) {
        #[derive(serde::Deserialize)]
        struct Clip {
            state: ClipState,
        }
        // One that cannot be read says nothing of a recording.
        let state = serde_json::from_str::<Clip>(json).map_or(ClipState::Refused, |clip| clip.state);
        if let Some(known) = self.modalities.iter().find(|known| known.name == device) {
            self.measures.clip(known.id, at_ns, state);
        }
    }

    /// Takes the event `publisher`, as JSON.
    pub(super) fn publisher(&mut self, json: &str) {
        self.publishers.event(json);
    }

    /// Takes the message of a sample; `None`: its content cannot be read.
    pub(super) fn sample(&mut self, id: ModalityId, message: &Message<'_>, sample: Option<Sample<'_>>) {
        if let Some(numbers) = self.numbers.get_mut(id.index()) {
            numbers.add(message.sequence);
        }
        let picture = sample.map_or(Judgement::Usable, |sample| {
            self.pictures.recorded(id, sample.encoding, [sample.width, sample.height], sample.payload)
        });
        let seen = SampleFacts {
            seq: message.sequence.into(),
            capture_ns: message.log_time,
            recv_ns: message.publish_time,
            // The flags are not in the file: what its content shows, in files of earlier versions too.
            flagged: sample.is_some_and(|sample| damage(sample.encoding, sample.payload) != 0),
            picture,
            again: false,
            payload: sample.map_or(&[], |sample| sample.payload),
            repeated: None,
        };
        self.measures.sample(id, &seen);
    }

    pub(super) fn mask(&mut self, at_ns: u64, mask: PhysicalMask) {
        self.measures.mask(at_ns, mask);
    }

    /// Takes a tick of the frame index.
    pub(super) fn frame(&mut self, slots: &[FrameSlot]) {
        // As in the recorder: masks of the time of a frame lie before it.
        self.measures.settle();
        let of = |slot: &FrameSlot| (slot.id, slot.present, slot.valid.then_some(slot.age_ns));
        self.measures.frame(slots.iter().map(of));
    }

    /// Between the earliest and the latest sample of a frame, ms.
    pub(super) fn skew(&self) -> Option<Spread> {
        self.measures.skew()
    }

    /// The verdict; what it is made of is added to the reports of the modalities.
    pub(super) fn judge(&self, modalities: &mut [ModalityReport], ending: &Ending<'_>) -> Verdict {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let end_ns = self.begin_ns.saturating_add((ending.seconds * 1e9).round() as u64);
        let counted = Recorded::from_summary(ending.summary);
        let qualities: Vec<(&Measured, Quality)> =
            self.modalities.iter().filter_map(|known| Some((known, self.quality(known, &counted, end_ns)?))).collect();
        for report in modalities.iter_mut() {
            let of_it = |known: &Measured| known.id.bit() == report.bit;
            let Some((_, quality)) = qualities.iter().find(|(known, _)| of_it(known)) else { continue };
            report.topic.hz = quality.hz.unwrap_or(0.0);
            report.topic.longest_gap = quality.longest_gap;
            report.topic.missing = self.numbers.get(usize::from(report.bit)).map_or(0, |numbers| numbers.missing);
            report.quality = Some(*quality);
        }
        let judged: Vec<Judged<'_>> = qualities
            .iter()
            .map(|(known, quality)| Judged { name: &known.name, quality, limits: known.limits })
            .collect();
        // The recorder's count does not include later losses of the file.
        let is_complete = counted.count("messages") == Some(ending.counted.messages) && ending.repaired.is_none();
        let count = |key: &str, numbers: u64| {
            let recorded = counted.count(key);
            if is_complete { recorded.unwrap_or(numbers) } else { recorded.unwrap_or(0).max(numbers) }
        };
        let missing = ending.counted.missing;
        let publishers = self.publishers.clone().or_summed_up(ending.summary);
        let mut findings = self.not_judged(modalities, ending);
        findings.extend(counted.differences(&qualities, ending));
        let facts = Facts {
            publishers: publishers.list(),
            modalities: &judged,
            missing: Missing {
                masks: count("masks_dropped", missing.masks),
                actions: count("actions_dropped", missing.actions),
                unusable_actions: missing.unusable_actions,
                events: count("events_missed", missing.events),
            },
            expect: &self.expect,
            seconds: ending.seconds,
            // A repaired file's summary counts what is there.
            losses: if counted.count("lost").is_some() && is_complete { Losses::Apart } else { Losses::Together },
            file: file_state(ending),
            findings: &findings,
            epochs: ending.units,
        };
        judge(&facts)
    }

    /// The quality of a modality: what the file holds, and what only the recorder could count.
    fn quality(&self, known: &Measured, counted: &Recorded<'_>, end_ns: u64) -> Option<Quality> {
        let id = known.id;
        let mut quality = self.measures.quality(id, end_ns)?;
        let missing = self.numbers.get(id.index()).map_or(0, |numbers| numbers.missing);
        let recorded = |key: &str| counted.of_modality(&known.name, key);
        quality.lost = recorded("lost").unwrap_or(0);
        quality.dropped = recorded("dropped").unwrap_or(missing);
        let gone = recorded("samples").map_or(0, |samples| samples.saturating_sub(quality.samples));
        if gone > 0 {
            // Which of the numbers that are missing the device lost is no longer known.
            let all = gone.saturating_add(quality.lost).saturating_add(quality.dropped);
            (quality.lost, quality.dropped) = (0, all.max(missing));
        }
        quality.damaged = quality.damaged.max(recorded("damaged").unwrap_or(0));
        quality.duplicates = quality.duplicates.max(recorded("duplicates").unwrap_or(0));
        Some(quality)
    }

    /// The parts of the file that could not be judged.
    fn not_judged(&self, channels: &[ModalityReport], ending: &Ending<'_>) -> Vec<String> {
        let mut findings = Vec::new();
        if self.usual_limits {
            let reason = "this version does not understand the registry in the file: judged by the usual limits";
            findings.push(reason.to_owned());
        }
        findings.extend(state::doubts(ending));
        let has_channel = |known: &&Measured| !channels.iter().any(|of| of.bit == known.id.bit());
        for known in self.modalities.iter().filter(has_channel) {
            findings.push(format!("{}: the file has no channel for it", known.name));
        }
        let is_known = |of: &&ModalityReport| !self.modalities.iter().any(|known| known.id.bit() == of.bit);
        for channel in channels.iter().filter(is_known) {
            findings.push(format!("{}: not in the registry of the file", channel.name));
        }
        findings
    }
}

/// The verdict on an episode whose metadata cannot be read.
pub(super) fn without_metadata(ending: &Ending<'_>) -> Verdict {
    let reason =
        format!("its metadata record {ABOUT:?} is missing or cannot be read, so that nothing in it can be judged");
    let reasons = match file_state(ending) {
        FileState::NotWhole(why) => vec![reason, format!("the file is not whole: {why}")],
        FileState::Failed(why) => vec![reason, format!("the file could not be written: {why}")],
        FileState::Whole => vec![reason],
    };
    Verdict { grade: Grade::Bad, reasons, sensors: None, replay_of: Vec::new() }
}

/// What the recorder counted.
struct Recorded<'a> {
    summary: &'a BTreeMap<String, String>,
    modalities: Option<Value>,
}

impl<'a> Recorded<'a> {
    fn from_summary(summary: &'a BTreeMap<String, String>) -> Self {
        let modalities = summary.get("modalities").and_then(|counted| serde_json::from_str(counted).ok());
        Self { summary, modalities }
    }

    fn count(&self, key: &str) -> Option<u64> {
        self.summary.get(key)?.parse().ok()
    }

    fn of_modality(&self, modality: &str, key: &str) -> Option<u64> {
        self.modalities.as_ref()?.get(modality)?.get(key)?.as_u64()
    }

    /// How a finished file differs from the recorder's counts.
    fn differences(&self, qualities: &[(&Measured, Quality)], ending: &Ending<'_>) -> Vec<String> {
        // Without a summary the file is not whole, and that which a repair wrote counts what is there: it has no verdict.
        if self.summary.is_empty() || ending.repaired.is_some() && !self.summary.contains_key("verdict") {
            return Vec::new();
        }
        let mut missing: Vec<String> = Vec::new();
        let mut findings = Vec::new();
        let mut same = |recorded: Option<u64>, counted: u64, key: &str, what: &str| match recorded {
            None => missing.push(key.to_owned()),
            Some(recorded) if recorded != counted => {
                findings.push(format!("the recorder wrote {recorded} {what}, the file has {counted}"));
            }
            Some(_) => {}
        };
        same(self.count("messages"), ending.counted.messages, "messages", "messages");
        same(self.count("frames"), ending.counted.frames, "frames", "frames");
        for (known, quality) in qualities {
            let key = format!("modalities.{}.samples", known.name);
            same(
                self.of_modality(&known.name, "samples"),
                quality.samples,
                &key,
                &format!("samples of {}", known.name),
            );
        }
        let length = self.summary.get("duration_s").and_then(|seconds| seconds.parse::<f64>().ok());
        if length.is_none_or(|seconds| !seconds.is_finite()) {
            missing.push("duration_s".to_owned());
        }
        let counts = ["masks_dropped", "events_missed"].into_iter().filter(|key| self.count(key).is_none());
        missing.extend(counts.map(str::to_owned));
        for (known, _) in qualities {
            let counts =
                ["lost", "dropped", "damaged"].into_iter().filter(|key| self.of_modality(&known.name, key).is_none());
            missing.extend(counts.map(|key| format!("modalities.{}.{key}", known.name)));
        }
        if !missing.is_empty() {
            let missing = missing.join(", ");
            findings.push(format!("its record {SUMMARY:?} does not have {missing}"));
        }
        findings
    }
}

/// The modalities by the registry in the file, and the names of those that it expects.
fn registered(about: &BTreeMap<String, String>) -> Option<(Vec<Measured>, Vec<String>)> {
    let text = about.get("registry").filter(|text| text.len() <= LONGEST_REGISTRY)?;
    let registry = Registry::parse(text, None).ok()?.registry;
    // Nothing is reserved: payload sizes stated in a file are not trusted.
    Some((Measured::all(&registry), registry.rig.expect))
}

/// The modalities by their list, where this version does not understand the registry.
fn listed(about: &BTreeMap<String, String>) -> Option<Vec<Measured>> {
    let list: Vec<Value> = serde_json::from_str(about.get("modalities")?).ok()?;
    let measured = |entry: &Value| {
        let name = entry.get("name")?.as_str()?.to_owned();
        let id = ModalityId::new(u8::try_from(entry.get("bit")?.as_u64()?).ok()?)?;
        let kind: ModalityKind = serde_json::from_value(entry.get("kind")?.clone()).ok()?;
        // Files of earlier versions have no latencies.
        let latency_ns = entry.get("latency_ns").and_then(Value::as_u64).unwrap_or(0);
        Some(Measured { name, id, limits: VerdictSpec::defaults(kind, STALL_AFTER, None), latency_ns })
    };
    let mut modalities: Vec<Measured> = list.iter().map(measured).collect::<Option<_>>()?;
    modalities.sort_by_key(|modality| modality.id);
    // A hostile list may name one twice.
    modalities.dedup_by_key(|modality| modality.id);
    Some(modalities)
}
