//! What of an episode is drawn over time, in bins: samples, losses, frames, marks, and some pictures.
//!
//! Invariant: memory depends on the number of modalities alone, of which there are at most 64, and so do the pictures
//! that are decoded.

use std::collections::BTreeMap;

use rapid_core::action::ACTION_TOPIC;
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_pictures::pixels::Picture;

use super::thumbnail::{Thumbnail, Thumbnails};
use crate::decode::{Content, FrameSlot, Kind, Scratch};
use crate::reader::{Channel, Item, Message};
use crate::record::inspect::{Inspection, Numbers};
use crate::schema::SampleSchema;

/// Bins of the time of an episode.
pub(super) const BINS: usize = 480;
/// Bins in which anything is looked for, so that a second is found missing in an episode of an hour.
const FINE: usize = 16_384;
/// Without any publication of the mask for so long, seconds, nothing of that time is in the file: it is published 500
/// times a second.
const SILENCE: f64 = 0.2;
/// Pictures of a camera.
pub(super) const PICTURES: usize = 8;
/// Damaged pictures in the time of one before it stays empty.
const TRIES: u8 = 3;
/// Marks kept.
const MARKS: usize = 200;

/// The time that is drawn.
#[derive(Debug, Clone, Copy)]
pub(super) struct Span {
    begin_ns: u64,
    /// Its length, positive.
    pub(super) seconds: f64,
}

impl Span {
    pub(super) fn from_report(report: &Inspection) -> Self {
        // A file without messages has no length.
        Self { begin_ns: report.begin_ns, seconds: report.seconds.max(1e-3) }
    }

    /// Where in it a time lies, 0 to 1; `None` outside.
    fn share(self, at_ns: u64) -> Option<f64> {
        let share = at_ns.checked_sub(self.begin_ns)? as f64 / 1e9 / self.seconds;
        (share <= 1.0).then_some(share)
    }
}

/// The part of `count` equal ones in which `share` lies.
fn part(share: f64, count: usize) -> usize {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share, times a small number")]
    let at = (share * count as f64) as usize;
    at.min(count - 1)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Subject {
    /// A modality, whichever of its channels a sample is on.
    Modality(ModalityId),
    /// A topic, by the number of its channel.
    Topic(u16),
}

/// One modality or topic over time.
#[derive(Debug)]
pub(super) struct Row {
    pub(super) topic: String,
    /// By bin: samples, and numbers missing before one of them.
    pub(super) samples: Vec<u32>,
    pub(super) missing: Vec<u32>,
    /// By bin: frames in which it is present, and those of them without a sample in the window.
    pub(super) present: Vec<u32>,
    pub(super) stale: Vec<u32>,
    /// Pictures, each from its part of the time.
    pub(super) pictures: [Option<Thumbnail>; PICTURES],
    tries: [u8; PICTURES],
    numbers: Numbers,
}

impl Row {
    pub(super) fn new(topic: String) -> Self {
        let bins = || vec![0; BINS];
        Self {
            topic,
            samples: bins(),
            missing: bins(),
            present: bins(),
            stale: bins(),
            pictures: [const { None }; PICTURES],
            tries: [0; PICTURES],
            numbers: Numbers::default(),
        }
    }
}

#[derive(Debug)]
pub(super) struct Mark {
    /// Where it lies, 0 to 1.
    pub(super) share: f64,
    pub(super) text: String,
}

#[derive(Debug)]
pub(super) struct Timeline {
    pub(super) span: Span,
    every_topic: bool,
    pub(super) rows: BTreeMap<Subject, Row>,
    pub(super) marks: Vec<Mark>,
    /// Frames by bin.
    pub(super) frames: Vec<u32>,
    /// Where the mask was published, by fine bin; empty without any.
    published: Vec<bool>,
    scratch: Scratch,
    thumbnails: Thumbnails,
}

impl Timeline {
    /// Of a file whose topics are drawn if `every_topic`, otherwise its modalities and actions.
    pub(super) fn new(span: Span, every_topic: bool) -> Self {
        Self {
            span,
            every_topic,
            rows: BTreeMap::new(),
            marks: Vec::new(),
            frames: vec![0; BINS],
            published: Vec::new(),
            scratch: Scratch::default(),
            thumbnails: Thumbnails::default(),
        }
    }

    pub(super) fn add(&mut self, item: &Item<'_>) {
        let Item::Message(message) = item else { return };
        let Some(share) = self.span.share(message.log_time) else { return };
        let bin = part(share, BINS);
        if let Some(subject) = self.subject(message.channel) {
            return self.sample(subject, message, share, bin);
        }
        let mut scratch = std::mem::take(&mut self.scratch);
        match message.channel.kind {
            Kind::Mask => self.publication(share),
            Kind::Frame => {
                if let Some(Content::Frame(slots)) = message.content(&mut scratch) {
                    self.frame(slots, bin);
                }
            }
            Kind::Event => {
                if let Some(Content::Event(event)) = message.content(&mut scratch)
                    && event.kind == "mark"
                {
                    self.mark(share, event.json);
                }
            }
            Kind::Sample(_) | Kind::Other => {}
        }
        self.scratch = scratch;
    }

    /// The row of a channel, if it has one.
    fn subject(&self, channel: &Channel) -> Option<Subject> {
        let topic = Subject::Topic(channel.id);
        match channel.bit {
            Some(id) => Some(Subject::Modality(id)),
            None if channel.topic == ACTION_TOPIC => Some(topic),
            None if self.every_topic && (self.rows.len() < MAX_MODALITIES || self.rows.contains_key(&topic)) => {
                Some(topic)
            }
            None => None,
        }
    }

    fn sample(&mut self, subject: Subject, message: &Message<'_>, share: f64, bin: usize) {
        let row = self.rows.entry(subject).or_insert_with(|| Row::new(message.channel.topic.clone()));
        let before = row.numbers.missing;
        row.numbers.add(message.sequence);
        add(&mut row.samples, bin, 1);
        add(&mut row.missing, bin, u32::try_from(row.numbers.missing - before).unwrap_or(u32::MAX));
        let is_picture =
            matches!(message.channel.kind, Kind::Sample(SampleSchema::CompressedImage | SampleSchema::RawImage));
        let place = part(share, PICTURES);
        let (Some(picture), Some(tries)) = (row.pictures.get_mut(place), row.tries.get_mut(place)) else { return };
        if !is_picture || picture.is_some() || *tries >= TRIES {
            return;
        }
        *tries += 1;
        if let Some(Content::Sample(sample)) = message.content(&mut self.scratch) {
            let (width, height) = (sample.width, sample.height);
            let taken = Picture { encoding: sample.encoding, width, height, bytes: sample.payload };
            if taken.encoding.is_picture() {
                *picture = self.thumbnails.make(&taken, share);
            }
        }
    }

    fn publication(&mut self, share: f64) {
        if self.published.is_empty() {
            self.published = vec![false; FINE];
        }
        if let Some(place) = self.published.get_mut(part(share, FINE)) {
            *place = true;
        }
    }

    fn frame(&mut self, slots: &[FrameSlot], bin: usize) {
        add(&mut self.frames, bin, 1);
        for slot in slots {
            let topic = || Row::new(String::new());
            let row = self.rows.entry(Subject::Modality(slot.id)).or_insert_with(topic);
            add(&mut row.present, bin, u32::from(slot.present));
            add(&mut row.stale, bin, u32::from(slot.stale));
        }
    }

    fn mark(&mut self, share: f64, json: &str) {
        #[derive(serde::Deserialize)]
        struct Marked {
            text: String,
        }
        if self.marks.len() < MARKS {
            let text = serde_json::from_str(json).map_or(String::new(), |Marked { text }| text);
            self.marks.push(Mark { share, text });
        }
    }

    /// The times, as shares, of which the file has nothing: none in a file without the mask.
    pub(super) fn silences(&self) -> Vec<(f64, f64)> {
        let wide = self.span.seconds / FINE as f64;
        let mut silences = Vec::new();
        let mut since = 0;
        let ends = self.published.iter().copied().chain((!self.published.is_empty()).then_some(true));
        for (at, published) in ends.enumerate() {
            if published {
                // One bin alone may fall between two publications.
                if at > since + 1 && (at - since) as f64 * wide > SILENCE {
                    silences.push((since as f64 / FINE as f64, at as f64 / FINE as f64));
                }
                since = at + 1;
            }
        }
        silences
    }

    /// Whether the file is one whose mask or frames show who is present.
    pub(super) fn has_frames(&self) -> bool {
        self.frames.iter().any(|count| *count > 0)
    }
}

fn add(bins: &mut [u32], bin: usize, count: u32) {
    if let Some(place) = bins.get_mut(bin) {
        *place = place.saturating_add(count);
    }
}
