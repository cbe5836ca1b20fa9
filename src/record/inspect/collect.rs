//! Gathering an [`Inspection`] from the records of a file, in the order they lie in it.
//!
//! Invariant: memory is bounded, whatever the file holds; what is not kept and would be judged is counted, and is a reason.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::super::configuration;
use super::super::metadata::POLICY;
use super::super::walk::{Walked, op};
use super::super::wire::{Fields, protobuf, whole_protobuf};
use super::channel::Channel;
use super::doubts::{Counted, Missing};
use super::judge::{Ending, Judge, without_metadata};
use super::policy::Gathered;
use super::{EventReport, Inspection, Judgement, MaskEdge, ModalityReport, TopicReport};
use super::{state, units};
use crate::action::ACTION_TOPIC;
use crate::episode_format::{ABOUT, EVENT_TOPIC, FAILED, FRAME_TOPIC, Failed, LOG_TOPIC, RECOVERED, SUMMARY, Writer};
use crate::mask::{MASK_TOPIC, PhysicalMask};
use crate::modality::ModalityId;

/// Events and changes of the mask kept: a rig that flaps all day must not fill the memory.
const MAX_EVENTS: usize = 10_000;
/// Bytes of all of them.
const MAX_EVENT_BYTES: usize = 16 << 20;
/// Bytes that each counts beside its text.
const EVENT: usize = 128;
/// Bytes of an event that is read; those of ours have up to a few kB.
const MAX_EVENT: usize = 64 << 10;

/// See the module's comment.
#[derive(Debug, Default)]
pub(super) struct Collected {
    channels: BTreeMap<u16, Channel>,
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
    masks: Vec<(u64, u64)>,
    /// Frames in which each bit is valid and stale.
    slots: BTreeMap<u8, (u64, u64)>,
    events: Vec<(u64, EventReport)>,
    /// Absent until the file has said that it is an episode of ours.
    judge: Option<Judge>,
    /// Of those, what `opened` says as JSON.
    opened: Vec<(u64, String)>,
    policy: Gathered,
}

impl Collected {
    /// Takes a record; one that cannot be understood is counted.
    pub(super) fn record(&mut self, opcode: u8, record: &[u8]) {
        let fields = Fields(record);
        // `None` is a record that is shorter than it says, or has no channel.
        let read = match opcode {
            op::CHANNEL => self.channel(fields),
            op::METADATA => self.metadata(fields),
            op::MESSAGE => self.message(fields),
            op::ATTACHMENT => self.attachment(fields),
            _ => Some(()),
        };
        self.counted.unread += u64::from(read.is_none());
    }

    fn channel(&mut self, mut fields: Fields<'_>) -> Option<()> {
        let (id, _schema) = (fields.u16()?, fields.u16()?);
        let (topic, _encoding) = (fields.string()?, fields.string()?);
        let mut metadata = fields.map()?;
        let of = metadata.get("bit").and_then(|bit| bit.parse().ok()).and_then(ModalityId::new);
        self.is_ours |= [MASK_TOPIC, FRAME_TOPIC, EVENT_TOPIC, LOG_TOPIC].contains(&topic);
        // The summary repeats the channels.
        let known = self.channels.entry(id);
        known.or_insert_with(|| Channel::new(topic.to_owned(), of, metadata.remove("modality")));
        Some(())
    }

    fn metadata(&mut self, mut fields: Fields<'_>) -> Option<()> {
        let name = fields.string()?;
        self.is_ours |= [ABOUT, SUMMARY, RECOVERED].contains(&name);
        let map = fields.map()?;
        match name {
            ABOUT => {
                self.counted.abouts += 1;
                // Of two the first: it was there when the episode began.
                if self.counted.abouts == 1 {
                    self.judge = Judge::of(&map);
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
        Some(())
    }

    /// The registry, whose text the metadata before it repeat.
    fn attachment(&mut self, mut fields: Fields<'_>) -> Option<()> {
        let _times = (fields.u64()?, fields.u64()?);
        let (name, _media_type) = (fields.string()?, fields.string()?);
        let count = fields.u64()?;
        let data = fields.bytes(count)?;
        if name == "devices.toml" && self.counted.attached.is_none() {
            self.counted.attached = Some(self.about.get("registry").is_some_and(|text| text.as_bytes() == data));
        }
        Some(())
    }

    fn message(&mut self, mut fields: Fields<'_>) -> Option<()> {
        let (id, sequence) = (fields.u16()?, fields.u32()?);
        let (captured, received) = (fields.u64()?, fields.u64()?);
        let channel = self.channels.get_mut(&id)?;
        channel.count(sequence, captured, received);
        self.counted.messages += 1;
        self.first = Some(self.first.map_or(captured, |first| first.min(captured)));
        self.last = self.last.max(captured);
        let is_whole = !fields.0.is_empty() && whole_protobuf(fields.0).all(|field| field.is_some());
        if self.judge.is_some() && !is_whole {
            self.counted.unread += 1;
        }
        if let (Some(id), Some(judge)) = (channel.id, &mut self.judge) {
            let bytes = judge.sample(id, sequence, captured, received, fields.0);
            self.counted.empty += u64::from(bytes == 0);
        }
        match channel.topic.as_str() {
            MASK_TOPIC => self.mask(captured, fields.0),
            FRAME_TOPIC => self.frame(captured, fields.0),
            EVENT_TOPIC => self.event(captured, fields.0),
            _ => {}
        }
        Some(())
    }

    fn mask(&mut self, at: u64, message: &[u8]) {
        let mask = protobuf(message).filter(|(field, _)| *field == 2).last().map_or(0, |(_, value)| value.number());
        if self.masks.last().is_some_and(|(_, last)| *last == mask) {
            return;
        }
        if self.masks.len() == MAX_EVENTS {
            self.counted.unjudged += 1;
            return;
        }
        self.masks.push((at, mask));
        if let Some(judge) = &mut self.judge {
            judge.mask(at, PhysicalMask(mask));
        }
    }

    fn frame(&mut self, at: u64, message: &[u8]) {
        self.counted.last_frame = self.counted.last_frame.max(at);
        self.counted.frames += 1;
        if let Some(judge) = &mut self.judge {
            judge.frame(message);
        }
        for (_, slot) in protobuf(message).filter(|(field, _)| *field == 4) {
            let (mut bit, mut valid, mut stale) = (0, 0, 0);
            for (field, value) in protobuf(slot.bytes()) {
                match field {
                    1 => bit = value.number(),
                    2 => valid = u64::from(value.number() != 0),
                    3 => stale = u64::from(value.number() != 0),
                    _ => {}
                }
            }
            if let Some(id) = u8::try_from(bit).ok().and_then(ModalityId::new) {
                let slot = self.slots.entry(id.bit()).or_default();
                *slot = (slot.0 + valid, slot.1 + stale);
            }
        }
    }

    fn event(&mut self, at: u64, message: &[u8]) {
        if message.len() > MAX_EVENT {
            self.counted.unread += 1;
            return;
        }
        let mut event = EventReport { at: 0.0, kind: String::new(), device: String::new(), text: String::new() };
        for (field, value) in protobuf(message) {
            match field {
                2 => event.kind = value.text(),
                3 => event.device = value.text(),
                4 => event.text = value.text(),
                5 if event.kind == "opened" && self.event_bytes < MAX_EVENT_BYTES => {
                    self.event_bytes += EVENT + value.bytes().len();
                    self.opened.push((at, value.text()));
                }
                5 if event.kind == "publisher" => {
                    if let Some(judge) = &mut self.judge {
                        judge.publisher(&value.text());
                    }
                }
                5 if Gathered::takes(&event.kind) => self.policy.event(at, &event.kind, &value.text()),
                _ => {}
            }
        }
        if let (Some(judge), "attach" | "detach") = (&mut self.judge, event.kind.as_str()) {
            self.plugs += 1;
            if self.plugs <= MAX_EVENTS {
                judge.plugged(&event.device, at, event.kind == "attach");
            } else {
                self.counted.unjudged += 1;
            }
        }
        if self.events.len() < MAX_EVENTS && self.event_bytes < MAX_EVENT_BYTES {
            self.event_bytes += EVENT + message.len();
            self.events.push((at, event));
        }
    }

    /// What was gathered, as a report on the file at `path`.
    pub(super) fn report(mut self, path: &Path, size: u64, walked: Walked, failed: Option<Failed>) -> Inspection {
        let recorded = failed.as_ref().map_or(size, |failed| failed.at);
        let failed = failed.map(|failed| failed.why).or_else(|| self.recovered.get(FAILED).cloned());
        let said = |map: &BTreeMap<String, String>, key: &str| map.get(key).cloned().unwrap_or_default();
        let begin_ns = said(&self.about, "begin_wall_ns").parse().ok().or(self.first).unwrap_or(0);
        let is_ours = walked.writer == Writer::Rapid || self.is_ours || failed.is_some();
        let told = said(&self.summary, "duration_s").parse().ok().filter(|seconds: &f64| seconds.is_finite());
        let seconds = told.unwrap_or_else(|| from(begin_ns, self.last)).max(0.0);
        let mut events = std::mem::take(&mut self.events);
        for (at, event) in &mut events {
            event.at = from(begin_ns, *at);
        }
        let judge = self.judge.take();
        let opened =
            std::mem::take(&mut self.opened).into_iter().map(|(at, json)| (from(begin_ns, at), json)).collect();
        let units = units::told(&said(&self.summary, "provenance"), &said(&self.about, "provenance"), opened);
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
            frames: missing(FRAME_TOPIC),
        };
        let repaired = state::repaired(&self.recovered);
        let (repaired, failed) = (repaired.as_deref(), failed.as_deref());
        let (about, summary, counted) = (&self.about, &self.summary, self.counted);
        let damage = &state::damage(&walked);
        let ending = Ending { file: walked, seconds, about, summary, repaired, failed, damage, counted };
        let verdict = match &judge {
            Some(judge) => Judgement::Episode(judge.judge(&mut modalities, &ending)),
            // What is damaged and has no name of its writer may be an episode.
            None if !is_ours && (walked.sound || walked.writer == Writer::Another) => Judgement::NotOurs,
            None => Judgement::Episode(without_metadata(&ending)),
        };
        let (modules, present_at_begin) = configured(&self.about);
        let count = modalities.len();
        let mask = self
            .masks
            .iter()
            .map(|(at, mask)| MaskEdge { at: from(begin_ns, *at), mask: PhysicalMask(*mask).hex(count) });
        Inspection {
            file: path.to_owned(),
            bytes: size,
            end: walked.end,
            verdict,
            // A verdict from before it failed is void.
            recorded_verdict: state::recorded_verdict(&self.summary).filter(|_| failed.is_none()),
            unread_bytes: walked.unread(recorded),
            damaged_chunks: walked.damaged_chunks,
            left_out: walked.left_out,
            ordered_messages: walked.ordered_messages,
            recovered: self.recovered,
            software: said(&self.about, "software"),
            commit: said(&self.about, "commit"),
            host: said(&self.about, "host"),
            kernel: said(&self.about, "kernel"),
            rig: said(&self.about, "rig"),
            task: said(&self.about, "task"),
            tags: serde_json::from_str(&said(&self.about, "tags")).unwrap_or_default(),
            modules,
            present_at_begin,
            begin_ns,
            seconds,
            messages: counted.messages,
            dropped: state::sum(&self.summary, "dropped", &modalities, |quality| quality.dropped),
            lost: state::sum(&self.summary, "lost", &modalities, |quality| quality.lost),
            damaged: said(&self.summary, "damaged").parse().ok(),
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
        for channel in std::mem::take(&mut self.channels).into_values() {
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
            match (PhysicalMask(*mask).contains(id), since) {
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
        spans
    }
}

/// Seconds from one wall time to another, negative if it lies before.
pub(super) fn from(begin_ns: u64, at_ns: u64) -> f64 {
    let distance = begin_ns.abs_diff(at_ns) as f64 / 1e9;
    if at_ns < begin_ns { -distance } else { distance }
}

/// The modules and the modalities that were there when the episode began.
fn configured(about: &BTreeMap<String, String>) -> (Vec<String>, Option<BTreeSet<String>>) {
    #[derive(serde::Deserialize)]
    struct Configuration {
        modules: Vec<String>,
        present: BTreeSet<String>,
    }
    let json = |key: &str| about.get(key).map(String::as_str).unwrap_or_default();
    if let Ok(known) = serde_json::from_str::<Configuration>(json(configuration::KEY)) {
        return (known.modules, Some(known.present));
    }
    // Written before there were configurations: what was attached.
    let serials = serde_json::from_str::<BTreeMap<String, Option<String>>>(json("serials")).ok();
    (Vec::new(), serials.map(|serials| serials.into_keys().collect()))
}
