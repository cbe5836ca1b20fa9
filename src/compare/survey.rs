//! How a comparison reads an episode: once for what it must know before it reads the samples, and then those in order.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use rapid_core::action::ACTION_TOPIC;
use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::sample::{Encoding, Epoch, SampleHeader, damage};
use rapid_episode::ReadError;
use rapid_episode::decode::{Content, Sample, Scratch};
use rapid_episode::encode::EventText;
use rapid_episode::reader::{Entry, Item, Message, Reader};
use rapid_episode::reference;
use rapid_policy::bundle::ObservationSpec;
use rapid_registry::Registry;
use serde::Deserialize;

/// The bits of a sample's number that a recorded message holds.
pub(super) const SEQUENCE_BITS: u64 = 0xffff_ffff;
/// How far messages of the file may be out of order: far more than the recorder needs between topics.
const SPAN_NS: u64 = 1_000_000_000;

/// A first look through an episode.
#[derive(Debug, Default)]
pub(super) struct Survey {
    /// Text of the registry it was recorded with.
    pub(super) registry: Option<String>,
    /// When it began, wall time.
    pub(super) begin_ns: u64,
    /// The same on the monotonic clock of the events.
    pub(super) begin_monotonic_ns: Option<u64>,
    /// Name and hash of the policy that recorded it.
    pub(super) policy: Option<(String, String)>,
    /// Its chunks, in the order of the file.
    pub(super) chunks: Vec<RecordedChunk>,
    /// Chunks that cannot be read.
    pub(super) unreadable: u64,
    /// The actions, in the order of the file.
    pub(super) actions: Vec<RecordedAction>,
    /// Per topic, the numbers of its samples, ascending.
    pub(super) samples: BTreeMap<String, Vec<u32>>,
    /// By the key of an observation, the attached sample that later ones are compared with.
    pub(super) references: BTreeMap<String, (SampleHeader, Vec<u8>)>,
    /// Which part of the file could not be read.
    pub(super) damage: Option<String>,
    /// Something before the first chunk could not be read: it may not be the first of the run.
    pub(super) is_begun_in_damage: bool,
}

/// A chunk as its event states it.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct RecordedChunk {
    /// Tick of its observation on the control grid.
    pub(super) tick: u64,
    /// Time of that tick.
    pub(super) observed_ns: u64,
    mask: String,
    /// Seed of the noise.
    pub(super) seed: u64,
    /// The samples of each observation.
    pub(super) samples: Vec<RecordedSamples>,
    /// Whether any of its actions was to be executed.
    pub(super) used: Option<bool>,
    /// How many of its actions were late.
    #[serde(default)]
    pub(super) skipped: u64,
    /// Values that are not numbers are null.
    pub(super) actions: Vec<Option<f32>>,
}

impl RecordedChunk {
    pub(super) fn mask(&self) -> Option<PhysicalMask> {
        u64::from_str_radix(self.mask.strip_prefix("0x")?, 16).ok().map(PhysicalMask)
    }
}

/// The samples that an observation was computed from.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct RecordedSamples {
    pub(super) modality: String,
    /// `None` for a step of a history without a sample.
    pub(super) seqs: Vec<Option<u64>>,
}

/// An action as it was published.
#[derive(Debug, Clone)]
pub(super) struct RecordedAction {
    /// Its sequence number; for a policy's action, that of the tick.
    pub(super) sequence: u32,
    /// The tick it is the action for, wall time.
    pub(super) at_ns: u64,
    pub(super) values: Vec<f64>,
}

#[derive(Deserialize)]
struct PolicyEvent {
    policy: String,
    hash: String,
}

impl Survey {
    /// Reads the whole file, for a policy with these observations.
    pub(super) fn read(file: &Path, observations: &[ObservationSpec]) -> Result<Self, ReadError> {
        let (mut reader, mut scratch) = (Reader::open(file)?, Scratch::default());
        let mut survey = Self::default();
        let mut first = None;
        while reader.advance()? {
            let message = match reader.item() {
                Item::Message(message) => message,
                Item::Other(Entry::Attachment(attachment)) => {
                    if let Some(key) = reference::observation(&attachment)
                        && observations.iter().any(|observation| observation.key == key)
                        && !survey.references.contains_key(key)
                        && let Some(sample) = reference::sample(&attachment)
                    {
                        survey.references.insert(key.to_owned(), sample);
                    }
                    continue;
                }
                Item::Channel(_) | Item::Other(_) | Item::Unreadable => continue,
            };
            let Some(content) = message.content(&mut scratch) else { continue };
            let topic = &message.channel.topic;
            match content {
                Content::Sample(Sample { encoding: Encoding::F64, payload, .. }) if topic == ACTION_TOPIC => {
                    let values = payload.as_chunks().0.iter().map(|number| f64::from_le_bytes(*number)).collect();
                    let (sequence, at_ns) = (message.sequence, message.log_time);
                    survey.actions.push(RecordedAction { sequence, at_ns, values });
                }
                Content::Sample(_) => {
                    first = first.or(Some(message.log_time));
                    match survey.samples.get_mut(topic) {
                        Some(numbers) => numbers.push(message.sequence),
                        None => drop(survey.samples.insert(topic.clone(), vec![message.sequence])),
                    }
                }
                Content::Event(EventText { kind: "chunk", json, .. }) => match serde_json::from_str(json) {
                    Ok(chunk) => {
                        survey.is_begun_in_damage |= survey.chunks.is_empty() && reader.integrity().damage().is_some();
                        survey.chunks.push(chunk);
                    }
                    Err(_) => survey.unreadable += 1,
                },
                Content::Event(EventText { kind: "policy", json, .. }) => {
                    if let Ok(PolicyEvent { policy, hash }) = serde_json::from_str(json) {
                        survey.policy.get_or_insert((policy, hash));
                    }
                }
                Content::Event(_) | Content::Mask(_) | Content::Frame(_) | Content::Other => {}
            }
        }
        for numbers in survey.samples.values_mut() {
            numbers.sort_unstable();
        }
        let number = |key| reader.about(key).and_then(|text| text.parse().ok());
        survey.registry = reader.about("registry").map(str::to_owned);
        survey.begin_ns = number("begin_wall_ns").or(first).unwrap_or_default();
        survey.begin_monotonic_ns = number("begin_monotonic_ns");
        survey.damage = reader.integrity().damage();
        Ok(survey)
    }

    /// Whether a policy recorded it.
    pub(super) fn is_of_a_policy(&self) -> bool {
        !self.chunks.is_empty() || self.unreadable > 0
    }

    /// Whether sample `number` of `topic` is in the file.
    pub(super) fn holds(&self, topic: &str, number: u64) -> bool {
        let sequence = u32::try_from(number & SEQUENCE_BITS).unwrap_or_default();
        self.samples.get(topic).is_some_and(|numbers| numbers.binary_search(&sequence).is_ok())
    }
}

#[derive(Debug)]
pub(super) enum Received {
    Sample { id: ModalityId, header: SampleHeader, payload: Vec<u8> },
    Mask(PhysicalMask),
    Opened { id: ModalityId, epoch: Epoch },
}

/// The samples and masks of an episode in the order in which they were received. A file has them in the order in which
/// they were written: within a topic the same order, and between topics nearly so.
#[derive(Debug)]
pub(super) struct Ordered<'a> {
    reader: Reader<File>,
    scratch: Scratch,
    registry: &'a Registry,
    /// By the time of receipt, then by the order of the file.
    held: BTreeMap<(u64, u64), Received>,
    read: u64,
    newest: u64,
    ended: bool,
}

/// A device was opened: its samples are of this epoch from now on.
#[derive(Deserialize)]
struct Opened {
    device: String,
    epoch: Epoch,
}

impl<'a> Ordered<'a> {
    pub(super) fn open(file: &Path, registry: &'a Registry) -> Result<Self, ReadError> {
        let (reader, scratch) = (Reader::open(file)?, Scratch::default());
        Ok(Self { reader, scratch, registry, held: BTreeMap::new(), read: 0, newest: 0, ended: false })
    }

    /// The next received item with its time, wall time; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<(u64, Received)>, ReadError> {
        loop {
            let oldest = self.held.first_key_value().map(|((at, _), _)| *at);
            if self.ended || oldest.is_some_and(|oldest| self.newest.saturating_sub(oldest) > SPAN_NS) {
                return Ok(self.held.pop_first().map(|((at, _), received)| (at, received)));
            }
            self.ended = !self.reader.advance()?;
            let Item::Message(message) = self.reader.item() else { continue };
            let at = message.publish_time;
            if let Some(received) = received(&message, self.registry, &mut self.scratch) {
                self.newest = self.newest.max(at);
                self.held.insert((at, self.read), received);
                self.read += 1;
            }
        }
    }
}

fn received(message: &Message<'_>, registry: &Registry, scratch: &mut Scratch) -> Option<Received> {
    match message.content(scratch)? {
        Content::Mask(mask) => Some(Received::Mask(mask)),
        Content::Event(EventText { kind: "opened", json, .. }) => {
            let opened: Opened = serde_json::from_str(json).ok()?;
            Some(Received::Opened { id: registry.named(&opened.device)?.id, epoch: opened.epoch })
        }
        Content::Event(_) | Content::Frame(_) | Content::Other => None,
        Content::Sample(sample) => {
            let id = registry.devices.iter().find(|device| device.topic == message.channel.topic)?.id;
            let header = SampleHeader { id: id.bit().into(), ..header(message, &sample) };
            Some(Received::Sample { id, header, payload: sample.payload.to_vec() })
        }
    }
}

/// The header that a recorded sample had on the bus, as far as its message contains it.
pub(super) fn header(message: &Message<'_>, sample: &Sample<'_>) -> SampleHeader {
    SampleHeader {
        seq: message.sequence.into(),
        capture_ns: message.log_time,
        recv_ns: message.publish_time,
        encoding: sample.encoding as u32,
        width: sample.width,
        height: sample.height,
        flags: damage(sample.encoding, sample.payload),
        ..SampleHeader::default()
    }
}
