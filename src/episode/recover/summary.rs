//! Counts of a file, taken while it is read.

use std::collections::BTreeMap;

use mcap::records::MessageHeader;
use rapid_core::topic::{EVENT_TOPIC, FRAME_TOPIC, LOG_TOPIC};

use super::super::reader::Entry;
use super::super::record_iter::Integrity;
use crate::{ABOUT, FAILED, RECOVERED, SUMMARY};

/// Key of `rapid/recovered`: "true" if only a torn end of the original is left out.
pub(super) const LOSSLESS: &str = "lossless";
/// Key of `rapid/recovered`: SHA-256 of the original.
pub(super) const SHA256: &str = "source_sha256";

#[derive(Debug, Default)]
pub(super) struct Summary {
    /// Messages on channels that are known.
    pub(super) messages: u64,
    /// Time of the first message, ns since 1970.
    pub(super) first_ns: Option<u64>,
    /// Time of the last one.
    pub(super) last_ns: u64,
    /// Ticks of the frame index.
    pub(super) frames: u64,
    /// The recorder wrote its own summary.
    pub(super) has_end: bool,
    /// The file is provably whole, as a container.
    is_sound: bool,
    is_proven: bool,
    /// Why the original's recorder called it BAD.
    pub(super) failed: Option<String>,
    /// Channels, by number.
    pub(super) channels: BTreeMap<u16, Channel>,
    /// When the episode began, by the recorder.
    begin_ns: Option<u64>,
    /// Messages that belong to the episode itself: not events, lines of the log, or earlier state.
    captured: u64,
    /// The original of this file.
    origin: Option<Origin>,
}

/// The original of a repaired file.
#[derive(Debug)]
struct Origin {
    sha256: String,
    bytes: u64,
    lossless: bool,
}

/// A channel and its counts.
#[derive(Debug, Default)]
pub(super) struct Channel {
    pub(super) topic: String,
    /// The modality it belongs to.
    pub(super) modality: Option<String>,
    pub(super) messages: u64,
}

impl Summary {
    pub(super) fn add(&mut self, entry: &Entry<'_>) {
        match entry {
            Entry::Channel { id, topic, metadata, .. } => {
                let channel =
                    || Channel { topic: (*topic).to_owned(), modality: metadata.get("modality").cloned(), messages: 0 };
                self.channels.entry(*id).or_insert_with(channel);
            }
            Entry::Message { header, .. } => self.message(header),
            Entry::Metadata { name, map: Some(map) } => self.metadata(name, map),
            _ => {}
        }
    }

    /// Length: from the recorder's beginning, else from the first message, to the last.
    pub(super) fn seconds(&self) -> f64 {
        let begin = self.begin_ns.or(self.first_ns).unwrap_or(0);
        self.last_ns.saturating_sub(begin) as f64 / 1e9
    }

    /// Was nothing recorded?
    pub(super) fn is_empty(&self) -> bool {
        self.captured == 0
    }

    /// If it is the complete repair of a file of this many bytes: the SHA-256 of that file, and whether this one holds
    /// all of it except a torn end.
    pub(super) fn made_of(&self, bytes: u64) -> Option<(&str, bool)> {
        let origin = self.origin.as_ref().filter(|origin| self.is_whole() && origin.bytes == bytes)?;
        Some((&origin.sha256, origin.lossless))
    }

    /// Returns whether every byte of the file was understood and is right.
    pub(super) fn integrity(&mut self, integrity: &Integrity) {
        (self.is_sound, self.is_proven) = (integrity.sound, integrity.proven);
    }

    /// Is the file whole, and an episode of ours to its end, with every check value? A recorder that gave up has written
    /// no summary, even if the file has an end.
    pub(super) fn is_whole(&self) -> bool {
        self.is_sound && (self.has_end && self.is_proven || self.begin_ns.is_none())
    }

    fn message(&mut self, header: &MessageHeader) {
        let at = header.log_time;
        let Some(channel) = self.channels.get_mut(&header.channel_id) else { return };
        channel.messages += 1;
        self.messages += 1;
        self.frames += u64::from(channel.topic == FRAME_TOPIC);
        let remark = [EVENT_TOPIC, LOG_TOPIC].contains(&channel.topic.as_str());
        self.captured += u64::from(!remark && at >= self.begin_ns.unwrap_or(0));
        self.first_ns = Some(self.first_ns.map_or(at, |first| first.min(at)));
        self.last_ns = self.last_ns.max(at);
    }

    fn metadata(&mut self, name: &str, map: &BTreeMap<String, String>) {
        match name {
            ABOUT => self.begin_ns = map.get("begin_wall_ns").and_then(|ns| ns.parse().ok()),
            SUMMARY => self.has_end = true,
            RECOVERED => {
                let lossless = map.get(LOSSLESS).is_some_and(|value| value == "true");
                let bytes = map.get("source_bytes").and_then(|bytes| bytes.parse().ok());
                self.failed = map.get(FAILED).cloned().or(self.failed.take());
                let origin = |(sha256, bytes)| Origin { sha256, bytes, lossless };
                self.origin = map.get(SHA256).cloned().zip(bytes).map(origin);
            }
            _ => {}
        }
    }
}
