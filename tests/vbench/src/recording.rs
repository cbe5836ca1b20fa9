//! A recorded episode, read back: messages by topic, and the data of the bench's devices in them.
//!
//! Invariant: reads the file only with the public `mcap` crate and the documented schemas, not with `rapid`'s code.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeBounds;
use std::path::{Path, PathBuf};

use serde_json::Value;
use thiserror::Error;

use crate::emu::frame::{self, FrameId};
use crate::proto;

/// Topic of the mask.
const MASKS: &str = "/rapid/mask";
/// Name of the metadata record with the counts.
const SUMMARY: &str = "rapid/summary";
/// Name of the metadata record of a repair.
const RECOVERED: &str = "rapid/recovered";

/// Why a recording could not be read.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// The file is missing or not readable.
    #[error("reading {0}: {1}")]
    Io(PathBuf, #[source] std::io::Error),
    /// It is not a whole MCAP file.
    #[error("{0} is not a whole mcap file: {1}")]
    Mcap(PathBuf, #[source] mcap::McapError),
}

/// All messages of one file, in file order.
#[derive(Debug)]
pub struct Recording {
    /// The file it was read from.
    pub path: PathBuf,
    /// Its messages.
    pub messages: Vec<Message>,
    /// Its metadata: a record's name, key and value.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
}

/// One message.
#[derive(Clone, Debug)]
pub struct Message {
    /// Topic of its channel.
    pub topic: String,
    /// Number of its channel.
    pub channel: u16,
    /// Name of its schema; empty without one.
    pub schema: String,
    /// Number of the sample, its lower 32 bits.
    pub sequence: u32,
    /// Capture time on the wall clock, ns.
    pub log_time: u64,
    /// Receive time on the wall clock, ns.
    pub publish_time: u64,
    /// Encoded message.
    pub data: Vec<u8>,
}

/// A change of one mask bit, at the message that first shows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// Which bit.
    pub bit: u32,
    /// Whether the bit became 1.
    pub rises: bool,
    /// Wall clock, ns.
    pub log_time: u64,
}

/// A camera frame in a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The identity written by the emulator; `None` if it cannot be read.
    pub id: Option<FrameId>,
    /// Wall clock, ns.
    pub log_time: u64,
    /// Starts and ends as a JPEG does.
    pub whole: bool,
}

/// A picture in a recording that is not compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Picture<'a> {
    /// The identity written by the emulator; `None` if it cannot be read.
    pub id: Option<FrameId>,
    /// Wall clock, ns.
    pub log_time: u64,
    /// The name of its pixel format.
    pub encoding: &'a [u8],
    /// Its pixels.
    pub data: &'a [u8],
}

impl Recording {
    /// Reads a whole file.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let bytes = std::fs::read(path).map_err(|error| RecordingError::Io(path.into(), error))?;
        let bad = |error| RecordingError::Mcap(path.into(), error);
        let mut messages = Vec::new();
        for message in mcap::MessageStream::new(&bytes).map_err(bad)? {
            let message = message.map_err(bad)?;
            messages.push(Message {
                topic: message.channel.topic.clone(),
                channel: message.channel.id,
                schema: message.channel.schema.as_ref().map(|schema| schema.name.clone()).unwrap_or_default(),
                sequence: message.sequence,
                log_time: message.log_time,
                publish_time: message.publish_time,
                data: message.data.into_owned(),
            });
        }
        let mut metadata = BTreeMap::new();
        for index in mcap::Summary::read(&bytes).map_err(bad)?.into_iter().flat_map(|summary| summary.metadata_indexes)
        {
            let record = mcap::read::metadata(&bytes, &index).map_err(bad)?;
            metadata.insert(record.name, record.metadata);
        }
        Ok(Self { path: path.into(), messages, metadata })
    }

    /// Samples of a topic, also masks, that `rapid` itself reports as lost: by the driver, or between driver and file.
    pub fn reported_lost(&self, topic: &str) -> u64 {
        let value = |record: &str, key: &str| self.metadata.get(record).and_then(|record| record.get(key));
        let json = |record: &str, key: &str| -> Value {
            value(record, key).and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default()
        };
        if topic == MASKS {
            return json(SUMMARY, "masks_dropped").as_u64().unwrap_or_default();
        }
        let modalities = json("rapid", "modalities");
        let own = modalities.as_array().into_iter().flatten().find(|modality| modality["topic"] == topic);
        let name = own.and_then(|modality| modality["name"].as_str()).unwrap_or_default();
        if self.metadata.contains_key(RECOVERED) {
            // What a killed run had counted is gone with it: the numbers of the samples show it, as `rapid inspect` reports.
            let numbers: Vec<u32> = self.topic(topic).map(|message| message.sequence).collect();
            return numbers.windows(2).map(|pair| u64::from(pair[1].saturating_sub(pair[0]).saturating_sub(1))).sum();
        }
        let counted = &json(SUMMARY, "modalities")[name];
        ["lost", "dropped"].iter().filter_map(|fault| counted[*fault].as_u64()).sum()
    }

    /// The messages of a topic.
    pub fn topic<'a>(&'a self, topic: &'a str) -> impl Iterator<Item = &'a Message> {
        self.messages.iter().filter(move |message| message.topic == topic)
    }

    /// The numbers of the channels of a topic; one, unless a reconnection was wrong.
    pub fn channels(&self, topic: &str) -> BTreeSet<u16> {
        self.topic(topic).map(|message| message.channel).collect()
    }

    /// The frames of a camera topic (`foxglove.CompressedImage`: data is field 2).
    pub fn frames(&self, topic: &str) -> Vec<Frame> {
        let read = |message: &Message| {
            let data = proto::bytes(&message.data, 2);
            Frame { id: frame::identity(data), log_time: message.log_time, whole: frame::is_whole_jpeg(data) }
        };
        self.topic(topic).map(read).collect()
    }

    /// The pictures of a camera topic that are not compressed (`foxglove.RawImage`: encoding is field 4, data field 6).
    pub fn pictures<'a>(&'a self, topic: &'a str) -> impl Iterator<Item = Picture<'a>> {
        self.topic(topic).map(|message| {
            let [encoding, data] = [4, 6].map(|field| proto::bytes(&message.data, field));
            Picture { id: frame::identity(data), log_time: message.log_time, encoding, data }
        })
    }

    /// The rows of a serial topic (`rapid.Scalars`: values are field 2).
    pub fn rows(&self, topic: &str) -> Vec<Vec<f64>> {
        self.topic(topic).map(|message| proto::doubles(&message.data, 2)).collect()
    }

    /// The same, each with its log time.
    pub fn timed_rows(&self, topic: &str) -> Vec<(u64, Vec<f64>)> {
        self.topic(topic).map(|message| (message.log_time, proto::doubles(&message.data, 2))).collect()
    }

    /// The frame numbers of a camera topic whose frames were captured in this span of the wall clock.
    pub fn numbers(&self, topic: &str, span: impl RangeBounds<u64>) -> Vec<u64> {
        let within = self.frames(topic).into_iter().filter(|frame| span.contains(&frame.log_time));
        within.filter_map(|frame| frame.id).map(|id| id.number.into()).collect()
    }

    /// Every change of a bit in `/rapid/mask` (`rapid.Mask`: mask is field 2), by time.
    pub fn mask_edges(&self) -> Vec<Edge> {
        let mut published: Vec<(u64, u64)> =
            self.topic(MASKS).map(|message| (message.log_time, proto::number(&message.data, 2))).collect();
        published.sort_unstable();
        let mut edges = Vec::new();
        for pair in published.windows(2) {
            let (before, after) = (pair[0].1, pair[1].1);
            let changed = (0..u64::BITS).filter(|bit| (before ^ after) >> bit & 1 == 1);
            edges.extend(changed.map(|bit| Edge { bit, rises: after >> bit & 1 == 1, log_time: pair[1].0 }));
        }
        edges
    }
}

/// Times at which `bit` rose.
pub fn rises(edges: &[Edge], bit: u32) -> Vec<u64> {
    edges.iter().filter(|edge| edge.bit == bit && edge.rises).map(|edge| edge.log_time).collect()
}

/// Times at which `bit` fell.
pub fn falls(edges: &[Edge], bit: u32) -> Vec<u64> {
    edges.iter().filter(|edge| edge.bit == bit && !edge.rises).map(|edge| edge.log_time).collect()
}

/// Number of values missing between the first and the last, in any order; panics if a number occurs twice.
pub fn missing(numbers: impl IntoIterator<Item = u64>) -> u64 {
    let mut numbers: Vec<u64> = numbers.into_iter().collect();
    numbers.sort_unstable();
    let holes = holes(numbers);
    assert!(holes.iter().all(|(before, after)| before != after), "a number appears twice: {holes:?}");
    holes.iter().map(|(before, after)| after - before - 1).sum()
}

/// Places where a sequence does not increase by exactly one, as (before, after).
pub fn holes(numbers: impl IntoIterator<Item = u64>) -> Vec<(u64, u64)> {
    let mut last = None;
    let mut holes = Vec::new();
    for number in numbers {
        if let Some(last) = last.replace(number).filter(|last| last + 1 != number) {
            holes.push((last, number));
        }
    }
    holes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(log_time: u64, mask: u64) -> Message {
        let data = [&[0x11][..], &mask.to_le_bytes()].concat();
        Message {
            topic: "/rapid/mask".into(),
            channel: 1,
            schema: "rapid.Mask".into(),
            sequence: 0,
            log_time,
            publish_time: log_time,
            data,
        }
    }

    #[test]
    fn edges_are_found_bit_by_bit() {
        let messages = vec![mask(10, 0b01), mask(12, 0b01), mask(14, 0b10), mask(16, 0b10)];
        let recording = Recording { path: PathBuf::new(), messages, metadata: BTreeMap::new() };
        let expected = [Edge { bit: 0, rises: false, log_time: 14 }, Edge { bit: 1, rises: true, log_time: 14 }];
        assert_eq!(recording.mask_edges(), expected);
    }

    #[test]
    fn gaps_are_jumps_and_repeats() {
        assert_eq!(holes([3, 4, 5]), []);
        assert_eq!(holes([3, 5, 5, 6]), [(3, 5), (5, 5)]);
        assert_eq!(missing([5, 3, 4, 9]), 3);
    }
}
