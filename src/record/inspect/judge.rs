//! The verdict on a file, by what it holds.
//!
//! What the file does not hold is taken from the recorder's summary where there is one: which of the
//! missing samples the device lost, which samples the driver called damaged, and what the recorder found.
//!
//! GOOD is earned. The file is finished, every byte of it is under a check value that is there and right, its
//! metadata `rapid` and `rapid/summary` were read, the registry in it was understood, what the recorder counted is in
//! it, and no check of `record::verdict` speaks against it. Whatever of this is missing is a reason.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::{Map, Value};

use super::super::publishers::Publishers;
use super::super::quality::{Frames, Measured, Measures, Quality, Seen, Spread};
use super::super::session::SETTLE;
use super::super::verdict::{Facts, FileState, Finding, Judged, Losses, judge};
use super::super::walk::Walked;
use super::super::wire::{Proto, protobuf};
use super::ModalityReport;
use super::doubts::{self, Counted};
use super::registered::{Registered, listed, registered};
use super::state::{self, file_state};
use crate::episode_format::{ABOUT, SUMMARY};
use crate::mask::PhysicalMask;
use crate::modality::{MAX_MODALITIES, ModalityId};
use crate::status::{Grade, Verdict};

/// How a file came to its end.
#[derive(Debug)]
pub(super) struct Ending<'a> {
    /// What was found in it.
    pub(super) file: Walked,
    /// Length of the episode, seconds.
    pub(super) seconds: f64,
    /// What it states about itself at its beginning.
    pub(super) about: &'a BTreeMap<String, String>,
    /// The recorder's summary; empty without one.
    pub(super) summary: &'a BTreeMap<String, String>,
    /// It was made of one that was not whole: the reason.
    pub(super) repaired: Option<&'a str>,
    /// Why its recorder called it BAD after it had written its summary, or without one.
    pub(super) failed: Option<&'a str>,
    /// What is left out if parts of it are damaged.
    pub(super) damage: &'a str,
    /// What was counted in it.
    pub(super) counted: Counted,
}

/// Measures an episode while its file is read.
#[derive(Debug)]
pub(super) struct Judge {
    measures: Measures,
    begin_ns: u64,
    /// The registered modalities, ascending by bit.
    modalities: Vec<Registered>,
    /// The limits are not those of the registry in the file, which is not understood.
    usual_limits: bool,
    /// Names of the modalities that every episode has to have.
    expect: Vec<String>,
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
        let (modalities, expect, usual_limits) = match registered(about) {
            Some((modalities, expect)) => (modalities, expect, false),
            None => (listed(about)?, Vec::new(), true),
        };
        let all: Vec<Measured> = modalities.iter().map(|modality| modality.measured.clone()).collect();
        let latency = Duration::from_nanos(all.iter().map(|measured| measured.latency_ns).max().unwrap_or(0));
        let window = Duration::from_nanos(number("sync_window_ns")?);
        let wait = window.saturating_add(SETTLE).saturating_add(latency);
        let measures = Measures::new(&all, Frames { begin_ns, hz, window, wait });
        let numbers = vec![(None, 0); MAX_MODALITIES];
        let publishers = Publishers::default();
        let mut judge = Self { measures, begin_ns, modalities, usual_limits, expect, numbers, publishers };
        for (device, _) in objects(about, "serials") {
            judge.plugged(&device, begin_ns, true);
        }
        Some(judge)
    }

    /// Takes that a device was plugged in, or out.
    pub(super) fn plugged(&mut self, device: &str, at_ns: u64, there: bool) {
        if let Some(known) = self.modalities.iter().find(|known| known.name == device) {
            self.measures.plugged(known.measured.id, at_ns, there);
        }
    }

    /// Takes the event `publisher`, as JSON.
    pub(super) fn publisher(&mut self, json: &str) {
        self.publishers.event(json);
    }

    /// Takes the message of a sample; how many bytes it has.
    pub(super) fn sample(
        &mut self,
        id: ModalityId,
        sequence: u32,
        captured: u64,
        received: u64,
        message: &[u8],
    ) -> usize {
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
        payload.len()
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
        let counted = Recorded::of(ending.summary);
        let qualities: Vec<(&Registered, Quality)> =
            self.modalities.iter().filter_map(|known| Some((known, self.quality(known, &counted, end_ns)?))).collect();
        for report in modalities.iter_mut() {
            let of_it = |known: &Registered| known.measured.id.bit() == report.bit;
            let Some((_, quality)) = qualities.iter().find(|(known, _)| of_it(known)) else { continue };
            report.topic.hz = quality.hz.unwrap_or(0.0);
            report.topic.longest_gap = quality.longest_gap;
            report.topic.missing = self.numbers.get(usize::from(report.bit)).map_or(0, |(_, missing)| *missing);
            report.quality = Some(*quality);
        }
        let judged: Vec<Judged<'_>> = qualities
            .iter()
            .map(|(known, quality)| Judged { name: &known.name, quality, limits: known.measured.limits })
            .collect();
        // Of a file that lacks something the recorder did not count all that is missing.
        let is_complete = counted.count("messages") == Some(ending.counted.messages) && ending.repaired.is_none();
        let count = |key: &str, numbers: u64| {
            let recorded = counted.count(key);
            if is_complete { recorded.unwrap_or(numbers) } else { recorded.unwrap_or(0).max(numbers) }
        };
        let publishers = self.publishers.clone().or_summed_up(ending.summary);
        let mut findings = self.not_judged(modalities, ending);
        findings.extend(counted.differences(&qualities, ending));
        let facts = Facts {
            publishers: publishers.list(),
            modalities: &judged,
            masks_dropped: count("masks_dropped", ending.counted.missing.masks),
            actions_dropped: count("actions_dropped", ending.counted.missing.actions),
            expect: &self.expect,
            events_missed: count("events_missed", ending.counted.missing.events),
            seconds: ending.seconds,
            // A repaired file's summary counts what is there.
            losses: if counted.count("lost").is_some() && is_complete { Losses::Apart } else { Losses::Together },
            file: file_state(ending),
            findings: &findings,
        };
        judge(&facts)
    }

    /// What a modality was like: what the file holds, and what the recorder alone could count.
    fn quality(&self, known: &Registered, counted: &Recorded<'_>, end_ns: u64) -> Option<Quality> {
        let id = known.measured.id;
        let mut quality = self.measures.quality(id, end_ns)?;
        let missing = self.numbers.get(id.index()).map_or(0, |(_, missing)| *missing);
        let recorded = |key: &str| counted.of_modality(&known.name, key);
        quality.lost = recorded("lost").unwrap_or(0);
        quality.dropped = recorded("dropped").unwrap_or(missing);
        let gone = recorded("samples").map_or(0, |samples| samples.saturating_sub(quality.samples));
        if gone > 0 {
            // Which of the numbers that are missing the device lost is no longer known.
            let all = gone.saturating_add(quality.lost).saturating_add(quality.dropped);
            (quality.lost, quality.dropped) = (0, all.max(missing));
        }
        quality.damaged = quality.truncated.max(counted.of_modality(&known.name, "damaged").unwrap_or(0));
        Some(quality)
    }

    /// What of the file could not be judged.
    fn not_judged(&self, channels: &[ModalityReport], ending: &Ending<'_>) -> Vec<Finding> {
        let mut findings = Vec::new();
        if self.usual_limits {
            findings.push(Finding::suspect(
                "this version does not understand the registry in the file: judged by the usual limits",
            ));
        }
        findings.extend(doubts::of(ending));
        findings.extend(state::findings(ending));
        let has_channel = |known: &&Registered| !channels.iter().any(|of| of.bit == known.measured.id.bit());
        for known in self.modalities.iter().filter(has_channel) {
            findings.push(Finding::suspect(format!("{}: the file has no channel for it", known.name)));
        }
        let is_known = |of: &&ModalityReport| !self.modalities.iter().any(|known| known.measured.id.bit() == of.bit);
        for channel in channels.iter().filter(is_known) {
            findings.push(Finding::suspect(format!("{}: not in the registry of the file", channel.name)));
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
    Verdict { grade: Grade::Bad, reasons, sensors: None }
}

/// What the recorder counted.
struct Recorded<'a> {
    summary: &'a BTreeMap<String, String>,
    modalities: Option<Value>,
}

impl<'a> Recorded<'a> {
    fn of(summary: &'a BTreeMap<String, String>) -> Self {
        let modalities = summary.get("modalities").and_then(|counted| serde_json::from_str(counted).ok());
        Self { summary, modalities }
    }

    fn count(&self, key: &str) -> Option<u64> {
        self.summary.get(key)?.parse().ok()
    }

    fn of_modality(&self, modality: &str, key: &str) -> Option<u64> {
        self.modalities.as_ref()?.get(modality)?.get(key)?.as_u64()
    }

    /// In what a finished file is not what its recorder counted.
    fn differences(&self, qualities: &[(&Registered, Quality)], ending: &Ending<'_>) -> Vec<Finding> {
        // Without a summary the file is not whole, and that which a repair wrote counts what is there: it has no verdict.
        if self.summary.is_empty() || ending.repaired.is_some() && !self.summary.contains_key("verdict") {
            return Vec::new();
        }
        let mut missing: Vec<String> = Vec::new();
        let mut findings = Vec::new();
        let mut same = |recorded: Option<u64>, counted: u64, key: &str, what: &str| match recorded {
            None => missing.push(key.to_owned()),
            Some(recorded) if recorded != counted => {
                let reason = format!("the recorder wrote {recorded} {what}, the file has {counted}");
                findings.push(Finding::suspect(reason));
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
            findings.push(Finding::suspect(format!("its record {SUMMARY:?} does not have {missing}")));
        }
        findings
    }
}

/// The entries of an object that `about` holds as JSON; none if it is none.
fn objects(about: &BTreeMap<String, String>, key: &str) -> impl Iterator<Item = (String, Value)> + use<> {
    let object = about.get(key).and_then(|text| serde_json::from_str::<Map<String, Value>>(text).ok());
    object.unwrap_or_default().into_iter()
}
