//! Collects an [`Inspection`] from the records of a file, in file order.
//!
//! Invariant: memory is bounded, whatever the file holds; facts that are dropped and would be judged are counted, and
//! are a reason.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use rapid_core::action::ACTION_TOPIC;
use rapid_core::mask::{MASK_TOPIC, PhysicalMask};
use rapid_core::modality::ModalityId;
use rapid_core::sample::are_usable_numbers;
use rapid_core::topic::{EVENT_TOPIC, FRAME_TOPIC, LOG_TOPIC};

use super::super::metadata::{CONFIGURATION, POLICY};
use super::super::quality::DurationHistogram;
use super::super::verdict::Missing;
use super::judge::{Judge, Numbers, without_metadata};
use super::policy::Gathered;
use super::state::Ending;
use super::state::{self, Counted};
use super::units;
use super::{EventReport, Inspection, Judgement, Lateness, MaskEdge, ModalityReport, TopicReport};
use crate::decode::{Content, FrameSlot, Kind, Scratch};
use crate::encode::EventText;
use crate::reader::{Attachment, Channel, Entry, Item, Message};
use crate::record_iter::Integrity;
use crate::{ABOUT, FAILED, Failed, RECOVERED, SUMMARY, Writer};

/// Events and changes of the mask kept: a rig that flaps all day must not fill the memory.
const MAX_EVENTS: usize = 10_000;
/// Bytes of all of them.
const MAX_EVENT_BYTES: usize = 16 << 20;
/// Bytes that each counts beside its text.
const EVENT: usize = 128;
/// Bytes of an event that is read; those of ours have up to a few kB.
const MAX_EVENT: usize = 64 << 10;

#[derive(Debug, Default)]
pub(super) struct Collected {
    topics: BTreeMap<u16, TopicCounter>,
    scratch: Scratch,
    about: BTreeMap<String, String>,
    summary: BTreeMap<String, String>,
    recovered: BTreeMap<String, String>,
    counted: Counted,
    /// A topic or a record of metadata that only this program writes.
    is_ours: bool,
    first: Option<u64>,
    last: u64,
    /// Bytes of the events kept.
    event_bytes: usize,
    /// Events that a device was plugged in or out.
    plugs: usize,
    /// Time and value of the first mask and of every change.
    masks: Vec<(u64, PhysicalMask)>,
    /// Frames in which each bit is valid and stale.
    slots: BTreeMap<u8, (u64, u64)>,
    events: Vec<(u64, EventReport)>,
    /// `None` until metadata of an episode of rapid have been read.
    judge: Option<Judge>,
    /// Time and JSON of the events `opened`.
    opened: Vec<(u64, String)>,
    policy: Gathered,
}

impl Collected {
    /// Takes a record; one that cannot be understood is counted.
    pub(super) fn add(&mut self, item: Item<'_>) {
        match item {
            Item::Channel(channel) => {
                self.is_ours |= [MASK_TOPIC, FRAME_TOPIC, EVENT_TOPIC, LOG_TOPIC].contains(&channel.topic.as_str());
                // The summary repeats the channels.
                self.topics.entry(channel.id).or_insert_with(|| TopicCounter::new(channel));
            }
            Item::Message(message) => self.message(&message),
            Item::Other(Entry::Metadata { name, map }) => self.metadata(name, map),
            Item::Other(Entry::Attachment(attachment)) => self.attachment(&attachment),
            Item::Other(_) => {}
            Item::Unreadable => self.counted.unread += 1,
        }
    }

    fn metadata(&mut self, name: &str, map: Option<BTreeMap<String, String>>) {
        self.is_ours |= [ABOUT, SUMMARY, RECOVERED].contains(&name);
        let Some(map) = map else {
            self.counted.unread += 1;
            return;
        };
        match name {
            ABOUT => {
                self.counted.abouts += 1;
                // The first of two: it was written when the episode began.
                if self.counted.abouts == 1 {
                    self.judge = Judge::from_metadata(&map);
                    self.about = map;
                }
            }
            SUMMARY => {
                self.counted.summaries += 1;
                self.summary = map;
            }
            RECOVERED => self.recovered = map,
            _ => {}
        }
    }

    /// The registry, whose text the metadata before it repeat.
    fn attachment(&mut self, attachment: &Attachment<'_>) {
        if attachment.name == "devices.toml" && self.counted.attached.is_none() {
            let is_same = |text: &String| *text.as_bytes() == *attachment.data;
            self.counted.attached = Some(self.about.get("registry").is_some_and(is_same));
        }
    }

    fn message(&mut self, message: &Message<'_>) {
        let (channel, at) = (message.channel, message.log_time);
        if let Some(topic) = self.topics.get_mut(&channel.id) {
            topic.count(message.sequence, at, message.publish_time);
        }
        self.counted.messages += 1;
        self.first = Some(self.first.map_or(at, |first| first.min(at)));
        self.last = self.last.max(at);
        let mut scratch = std::mem::take(&mut self.scratch);
        let content = message.content(&mut scratch).filter(|_| !message.data.is_empty());
        if self.judge.is_some() && content.is_none() {
            self.counted.unread += 1;
        }
        if let (Some(id), Some(judge)) = (channel.bit, &mut self.judge) {
            let sample = if let Some(Content::Sample(sample)) = content { Some(sample) } else { None };
            judge.sample(id, message, sample);
            self.counted.empty += u64::from(sample.is_none_or(|sample| sample.payload.is_empty()));
        }
        if let Some(Content::Sample(sample)) = content
            && channel.topic == ACTION_TOPIC
        {
            self.counted.missing.unusable_actions += u64::from(!are_usable_numbers(sample.payload));
        }
        self.counted.frames += u64::from(channel.kind == Kind::Frame);
        match content {
            Some(Content::Mask(mask)) => self.mask(at, mask),
            Some(Content::Frame(slots)) => self.frame(at, slots),
            Some(Content::Event(event)) => self.event(at, &event, message.data.len()),
            Some(Content::Sample(_) | Content::Other) | None => {}
        }
        self.scratch = scratch;
    }

    fn mask(&mut self, at: u64, mask: PhysicalMask) {
        if self.masks.last().is_some_and(|(_, last)| *last == mask) {
            return;
        }
        if self.masks.len() == MAX_EVENTS {
            self.counted.unjudged += 1;
            return;
        }
        self.masks.push((at, mask));
        if let Some(judge) = &mut self.judge {
            judge.mask(at, mask);
        }
    }

    fn frame(&mut self, at: u64, slots: &[FrameSlot]) {
        self.counted.last_frame = self.counted.last_frame.max(at);
        if let Some(judge) = &mut self.judge {
            judge.frame(slots);
        }
        for slot in slots {
            let count = self.slots.entry(slot.id.bit()).or_default();
            *count = (count.0 + u64::from(slot.valid), count.1 + u64::from(slot.stale));
        }
    }

    fn event(&mut self, at: u64, event: &EventText<'_>, bytes: usize) {
        if bytes > MAX_EVENT {
            self.counted.unread += 1;
            return;
        }
        let EventText { kind, device, text, json } = *event;
        match kind {
            "opened" if self.event_bytes < MAX_EVENT_BYTES => {
                self.event_bytes += EVENT + json.len();
                self.opened.push((at, json.to_owned()));
            }
            _ if Gathered::takes(kind) => self.policy.event(at, kind, json),
            _ => {}
        }
        match (&mut self.judge, kind) {
            (Some(judge), "publisher") => judge.publisher(json),
            (Some(judge), "clock") => judge.clock(device, json),
            (Some(judge), "clip") => judge.clip(device, at, json),
            (Some(judge), "attach" | "detach") => {
                self.plugs += 1;
                if self.plugs <= MAX_EVENTS {
                    judge.plugged(device, at, kind == "attach");
                } else {
                    self.counted.unjudged += 1;
                }
            }
            _ => {}
        }
        // Two a second are measurements and no events of a report.
        if kind == "clock" {
            return;
        }
        if self.events.len() < MAX_EVENTS && self.event_bytes < MAX_EVENT_BYTES {
            self.event_bytes += EVENT + bytes;
            let (kind, device, text) = (kind.to_owned(), device.to_owned(), text.to_owned());
            self.events.push((at, EventReport { at: 0.0, kind, device, text }));
        }
    }

    /// The report on the file at `path`.
    pub(super) fn report(mut self, path: &Path, size: u64, integrity: Integrity, failed: Option<Failed>) -> Inspection {
        let recorded = failed.as_ref().map_or(size, |failed| failed.at);
        let failed = failed.map(|failed| failed.why).or_else(|| self.recovered.get(FAILED).cloned());
        let answer = |map: &BTreeMap<String, String>, key: &str| map.get(key).cloned().unwrap_or_default();
        let begin_ns = answer(&self.about, "begin_wall_ns").parse().ok().or(self.first).unwrap_or(0);
        let is_ours = integrity.writer == Writer::Rapid || self.is_ours || failed.is_some();
        let reported = answer(&self.summary, "duration_s").parse().ok().filter(|seconds: &f64| seconds.is_finite());
        let seconds = reported.unwrap_or_else(|| from(begin_ns, self.last)).max(0.0);
        let mut events = std::mem::take(&mut self.events);
        for (at, event) in &mut events {
            event.at = from(begin_ns, *at);
        }
        let judge = self.judge.take();
        let opened =
            std::mem::take(&mut self.opened).into_iter().map(|(at, json)| (from(begin_ns, at), json)).collect();
        let units = units::reported(&answer(&self.summary, "provenance"), &answer(&self.about, "provenance"), opened);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
        let end_ns = begin_ns.saturating_add((seconds * 1e9).round() as u64);
        let policy =
            std::mem::take(&mut self.policy).report(end_ns, [self.summary.get(POLICY), self.about.get(POLICY)]);
        let (mut modalities, topics) = self.topics(begin_ns, seconds);
        let missing = |name| topics.iter().filter(|topic| topic.topic == name).map(|topic| topic.missing).sum();
        self.counted.missing = Missing {
            actions: missing(ACTION_TOPIC),
            masks: missing(MASK_TOPIC),
            events: missing(EVENT_TOPIC),
            ..self.counted.missing
        };
        self.counted.missing_frames = missing(FRAME_TOPIC);
        let repaired = state::repaired(&self.recovered);
        let (repaired, failed) = (repaired.as_deref(), failed.as_deref());
        let (about, summary, counted) = (&self.about, &self.summary, self.counted);
        let damage = &state::damage(&integrity);
        let ending =
            Ending { file: integrity, seconds, about, summary, repaired, failed, damage, units: &units, counted };
        let verdict = match &judge {
            Some(judge) => Judgement::Episode(judge.judge(&mut modalities, &ending)),
            // A damaged file without the name of its writer may be an episode.
            None if !is_ours && (integrity.sound || integrity.writer == Writer::Another) => Judgement::NotOurs,
            None => Judgement::Episode(without_metadata(&ending)),
        };
        let (modules, present_at_begin) = configured(&self.about);
        let count = modalities.len();
        let mask = self.masks.iter().map(|(at, mask)| MaskEdge { at: from(begin_ns, *at), mask: mask.hex(count) });
        Inspection {
            file: path.to_owned(),
            bytes: size,
            end: integrity.end,
            verdict,
            // A verdict from before it failed is void.
            recorded_verdict: state::recorded_verdict(&self.summary).filter(|_| failed.is_none()),
            unread_bytes: integrity.unread(recorded),
            damaged_chunks: integrity.damaged_chunks,
            left_out: integrity.left_out,
            ordered_messages: integrity.ordered_messages,
            recovered: self.recovered,
            software: answer(&self.about, "software"),
            commit: answer(&self.about, "commit"),
            host: answer(&self.about, "host"),
            kernel: answer(&self.about, "kernel"),
            rig: answer(&self.about, "rig"),
            task: answer(&self.about, "task"),
            tags: serde_json::from_str(&answer(&self.about, "tags")).unwrap_or_default(),
            modules,
            present_at_begin,
            begin_ns,
            seconds,
            messages: counted.messages,
            dropped: state::sum(&self.summary, "dropped", &modalities, |quality| quality.dropped),
            lost: state::sum(&self.summary, "lost", &modalities, |quality| quality.lost),
            damaged: state::sum(&self.summary, "damaged", &modalities, |quality| quality.damaged),
            frames: counted.frames,
            skew: judge.and_then(|judge| judge.skew()),
            modalities,
            units,
            policy,
            topics,
            mask: mask.collect(),
            events: events.into_iter().map(|(_, event)| event).collect(),
        }
    }

    fn topics(&mut self, begin_ns: u64, seconds: f64) -> (Vec<ModalityReport>, Vec<TopicReport>) {
        let (mut modalities, mut topics) = (Vec::new(), Vec::new());
        for channel in std::mem::take(&mut self.topics).into_values() {
            let topic = channel.report();
            let Some(id) = channel.id else {
                topics.push(topic);
                continue;
            };
            let present = self.present(id, begin_ns, seconds);
            let together: f64 = present.iter().map(|(begin, end)| end - begin).sum();
            let (frames_valid, frames_stale) = self.slots.get(&id.bit()).copied().unwrap_or_default();
            modalities.push(ModalityReport {
                name: channel.modality.unwrap_or(channel.topic),
                bit: id.bit(),
                topic,
                presence: (!self.masks.is_empty() && seconds > 0.0).then(|| (together / seconds).clamp(0.0, 1.0)),
                present,
                frames_valid,
                frames_stale,
                quality: None,
            });
        }
        modalities.sort_by_key(|modality| modality.bit);
        (modalities, topics)
    }

    /// When the bit of `id` was set, within the episode.
    fn present(&self, id: ModalityId, begin_ns: u64, seconds: f64) -> Vec<(f64, f64)> {
        let mut spans = Vec::new();
        let mut since = None;
        for (at, mask) in &self.masks {
            let at = from(begin_ns, *at).clamp(0.0, seconds);
            match (mask.contains(id), since) {
                (true, None) => since = Some(at),
                (false, Some(begin)) => {
                    spans.push((begin, at));
                    since = None;
                }
                _ => {}
            }
        }
        spans.extend(since.map(|begin| (begin, seconds)));
        spans.retain(|(begin, end)| begin < end);
        // The times of a damaged file go anywhere.
        spans.sort_by(|one, other| one.0.total_cmp(&other.0));
        spans
    }
}

/// Seconds from one wall time to another, negative if it lies before.
fn from(begin_ns: u64, at_ns: u64) -> f64 {
    let distance = begin_ns.abs_diff(at_ns) as f64 / 1e9;
    if at_ns < begin_ns { -distance } else { distance }
}

/// The modules and the modalities that were present when the episode began.
fn configured(about: &BTreeMap<String, String>) -> (Vec<String>, Option<BTreeSet<String>>) {
    #[derive(serde::Deserialize)]
    struct Configuration {
        modules: Vec<String>,
        present: BTreeSet<String>,
    }
    let json = |key: &str| about.get(key).map(String::as_str).unwrap_or_default();
    if let Ok(known) = serde_json::from_str::<Configuration>(json(CONFIGURATION)) {
        return (known.modules, Some(known.present));
    }
    // Written before there were configurations: what was attached.
    let serials = serde_json::from_str::<BTreeMap<String, Option<String>>>(json("serials")).ok();
    (Vec::new(), serials.map(|serials| serials.into_keys().collect()))
}

/// A channel and its statistics; memory is fixed, however many messages there are.
#[derive(Debug, Default)]
struct TopicCounter {
    topic: String,
    /// The modality, if it is one's, and its name.
    id: Option<ModalityId>,
    modality: Option<String>,
    messages: u64,
    first: u64,
    previous: u64,
    latest: u64,
    longest_gap: u64,
    numbers: Numbers,
    /// Receipt minus capture. Absent without messages: a file may define thousands of channels.
    lateness: Option<DurationHistogram>,
}

impl TopicCounter {
    fn new(channel: &Channel) -> Self {
        let (topic, modality) = (channel.topic.clone(), channel.modality.clone());
        Self { topic, id: channel.bit, modality, ..Self::default() }
    }

    fn count(&mut self, sequence: u32, captured: u64, received: u64) {
        if self.messages == 0 {
            (self.first, self.latest) = (captured, captured);
        } else {
            self.longest_gap = self.longest_gap.max(captured.saturating_sub(self.previous));
        }
        self.messages += 1;
        self.numbers.add(sequence);
        self.previous = captured;
        self.first = self.first.min(captured);
        self.latest = self.latest.max(captured);
        self.lateness.get_or_insert_with(DurationHistogram::default).push(received.saturating_sub(captured));
    }

    fn report(&self) -> TopicReport {
        let span = from(self.first, self.latest);
        let hz = if self.messages > 1 && span > 0.0 { (self.messages - 1) as f64 / span } else { 0.0 };
        // A frame waits for its deadline, always as long.
        let lateness = self.lateness.as_ref().filter(|_| self.topic != FRAME_TOPIC).and_then(Lateness::from_histogram);
        TopicReport {
            topic: self.topic.clone(),
            messages: self.messages,
            hz,
            missing: self.numbers.missing,
            longest_gap: self.longest_gap as f64 / 1e9,
            lateness,
        }
    }
}

impl Lateness {
    /// Of some durations; `None` without any.
    pub(super) fn from_histogram(times: &DurationHistogram) -> Option<Self> {
        times.spread().map(|spread| Self { p50: spread.p50, p99: spread.p99, max: spread.max })
    }
}
