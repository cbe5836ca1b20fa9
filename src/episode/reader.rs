//! The one reader of episodes: the records of a file in their order, typed.
//!
//! Recorder tests, inspect, replay, compare and the fuzz targets use it; repair, which copies records unchanged, uses
//! the `RecordIter` below it.
//!
//! Invariant: memory holds one record of the file at a time, and the definitions of its channels, which are bounded.
//! Invariant: content is read on request, and only once.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

pub(crate) use mcap::Attachment;
use mcap::records::MessageHeader;
use rapid_core::mask::MASK_TOPIC;
use rapid_core::modality::ModalityId;
use rapid_core::topic::{EVENT_TOPIC, FRAME_TOPIC};

use super::chunk::is_sound;
use super::decode::{self, Content, Kind, Scratch};
use super::integrity::{Integrity, Record};
use super::record_iter::RecordIter;
use super::schema::{PROTOBUF, SampleSchema};
use super::source::ReadAt;
use super::wire::Fields;
use super::{ABOUT, ReadError, op};
use super::{boot_id, open};

/// See the module's comment.
pub struct Reader<R> {
    path: PathBuf,
    records: RecordIter<R>,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Channel>,
    about: Option<BTreeMap<String, String>>,
}

/// A channel, as it was first defined.
#[derive(Debug)]
pub struct Channel {
    /// Its number in the file.
    pub id: u16,
    /// Its topic.
    pub topic: String,
    /// Name of the schema; empty if the file does not define it.
    pub schema: String,
    /// The modality it belongs to: its bit and its name.
    pub bit: Option<ModalityId>,
    /// The modality that sends on it, if one does.
    pub modality: Option<String>,
    /// Of the topic of actions: the names of the axes, a list in JSON.
    pub names: Option<String>,
    /// What its messages hold.
    pub kind: Kind,
}

/// A record of the file.
#[derive(Debug)]
pub enum Item<'a> {
    /// A channel begins.
    Channel(&'a Channel),
    /// A message.
    Message(Message<'a>),
    /// Any record except a channel and a message.
    Other(Entry<'a>),
    /// Shorter than its fields, or a message without a channel.
    Unreadable,
}

/// A message, its content not yet read.
#[derive(Debug, Clone, Copy)]
pub struct Message<'a> {
    /// Its channel.
    pub channel: &'a Channel,
    /// The lower 32 bits of the number of a sample, a mask or an action.
    pub sequence: u32,
    /// Capture, wall time in ns since 1970.
    pub log_time: u64,
    /// Receipt, wall time in ns since 1970.
    pub publish_time: u64,
    /// The whole message, encoded.
    pub data: &'a [u8],
}

impl<'a> Message<'a> {
    /// Reads the content; `None` if it is incomplete or does not match the channel's schema.
    pub fn content<'s>(&self, scratch: &'s mut Scratch) -> Option<Content<'s>>
    where
        'a: 's,
    {
        decode::content(self.channel.kind, self.data, scratch)
    }
}

impl<R> std::fmt::Debug for Reader<R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Reader").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Reader<File> {
    /// Opens an episode, finished or not.
    ///
    /// # Errors
    /// The file cannot be read, or is no MCAP file.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let (file, size) = open(path)?;
        Self::new(file, size, path, boot_id())
    }
}

impl<R: ReadAt> Reader<R> {
    /// Starts reading `size` bytes, called `path` in errors. `boot`: see `RecordIter::of_boot`.
    ///
    /// # Errors
    /// The file cannot be read, or is no MCAP file.
    pub fn new(file: R, size: u64, path: &Path, boot: Option<String>) -> Result<Self, ReadError> {
        let records = RecordIter::new(file, size)
            .map_err(|source| ReadError::Io { path: path.to_owned(), source })?
            .ok_or_else(|| ReadError::NotMcap(path.to_owned()))?;
        let records = records.of_boot(boot);
        let (schemas, channels) = (BTreeMap::new(), BTreeMap::new());
        Ok(Self { path: path.to_owned(), records, schemas, channels, about: None })
    }

    /// Moves to the next record; `false` at the end.
    ///
    /// # Errors
    /// The file cannot be read. Bytes that are damaged are not an error: they are left out.
    pub fn advance(&mut self) -> Result<bool, ReadError> {
        let advanced = self.records.advance().map_err(|source| ReadError::Io { path: self.path.clone(), source })?;
        let record = self.records.record();
        if record.opcode == op::MESSAGE {
            return Ok(advanced);
        }
        match Entry::read(record) {
            Some(Entry::Schema { id, name, .. }) => {
                self.schemas.entry(id).or_insert_with(|| name.to_owned());
            }
            Some(Entry::Channel { id, schema, topic, encoding, metadata }) => {
                let schema = self.schemas.get(&schema).cloned().unwrap_or_default();
                let defined = || Channel::new(id, topic, encoding, schema, metadata);
                self.channels.entry(id).or_insert_with(defined);
            }
            // The first of two: it was written when the episode began.
            Some(Entry::Metadata { name: ABOUT, map: Some(map) }) if self.about.is_none() => self.about = Some(map),
            _ => {}
        }
        Ok(advanced)
    }

    /// The current record.
    pub fn item(&self) -> Item<'_> {
        let read = match Entry::read(self.records.record()) {
            Some(Entry::Message { header, data }) => self.channels.get(&header.channel_id).map(|channel| {
                let (sequence, log_time, publish_time) = (header.sequence, header.log_time, header.publish_time);
                Item::Message(Message { channel, sequence, log_time, publish_time, data })
            }),
            Some(Entry::Channel { id, .. }) => self.channels.get(&id).map(Item::Channel),
            Some(entry) => Some(Item::Other(entry)),
            None => None,
        };
        read.unwrap_or(Item::Unreadable)
    }

    /// The channels defined so far.
    pub fn channels(&self) -> impl Iterator<Item = &Channel> {
        self.channels.values()
    }

    /// The metadata at the beginning of the episode, once they have been read.
    pub fn about(&self, key: &str) -> Option<&str> {
        self.about.as_ref()?.get(key).map(String::as_str)
    }

    /// The integrity of the file so far; complete once the last record was read.
    pub fn integrity(&self) -> Integrity {
        self.records.integrity()
    }
}

impl Channel {
    fn new(id: u16, topic: &str, encoding: &str, schema: String, mut metadata: BTreeMap<String, String>) -> Self {
        let kind = match topic {
            MASK_TOPIC => Kind::Mask,
            FRAME_TOPIC => Kind::Frame,
            EVENT_TOPIC => Kind::Event,
            _ if encoding == PROTOBUF => SampleSchema::named(&schema).map_or(Kind::Other, Kind::Sample),
            _ => Kind::Other,
        };
        let bit = metadata.get("bit").and_then(|bit| bit.parse().ok()).and_then(ModalityId::new);
        let (modality, names) = (metadata.remove("modality"), metadata.remove("names"));
        Self { id, topic: topic.to_owned(), schema, bit, modality, names, kind }
    }
}

/// A record of the container with its fields read. Format: <https://mcap.dev/spec#records>.
///
/// A record may contain any bytes; one that is shorter than its fields is `None`, never a panic.
#[derive(Debug)]
#[expect(missing_docs, reason = "records and fields have the names of the specification")]
pub enum Entry<'a> {
    Schema {
        id: u16,
        name: &'a str,
        encoding: &'a str,
        data: &'a [u8],
    },
    Channel {
        id: u16,
        schema: u16,
        topic: &'a str,
        encoding: &'a str,
        metadata: BTreeMap<String, String>,
    },
    Message {
        header: MessageHeader,
        data: &'a [u8],
    },
    Attachment(Attachment<'a>),
    Metadata {
        name: &'a str,
        /// `None`: the name can be read, the map cannot.
        map: Option<BTreeMap<String, String>>,
    },
    /// Of no meaning outside of the container, or another program's.
    Other,
}

impl<'a> Entry<'a> {
    /// Reads `record`; `None` if it is shorter than its fields, or its own check value is wrong.
    pub(crate) fn read(record: Record<'a>) -> Option<Self> {
        let mut fields = Fields(record.data);
        Some(match record.opcode {
            op::SCHEMA => {
                let (id, name, encoding) = (fields.u16()?, fields.string()?, fields.string()?);
                let count = fields.u32()?;
                Self::Schema { id, name, encoding, data: fields.bytes(count.into())? }
            }
            op::CHANNEL => {
                let (id, schema) = (fields.u16()?, fields.u16()?);
                let (topic, encoding) = (fields.string()?, fields.string()?);
                Self::Channel { id, schema, topic, encoding, metadata: fields.map()? }
            }
            op::MESSAGE => {
                let (channel_id, sequence) = (fields.u16()?, fields.u32()?);
                let (log_time, publish_time) = (fields.u64()?, fields.u64()?);
                let header = MessageHeader { channel_id, sequence, log_time, publish_time };
                Self::Message { header, data: fields.0 }
            }
            op::ATTACHMENT => Self::Attachment(attachment(record.data)?),
            op::METADATA => Self::Metadata { name: fields.string()?, map: fields.map() },
            _ => Self::Other,
        })
    }
}

/// An attachment whose check value, its last four bytes, is right or absent.
fn attachment(data: &[u8]) -> Option<Attachment<'_>> {
    let (content, crc) = data.split_last_chunk()?;
    if !is_sound(content, u32::from_le_bytes(*crc)) {
        return None;
    }
    let mut fields = Fields(content);
    let (log_time, create_time) = (fields.u64()?, fields.u64()?);
    let (name, media_type) = (fields.string()?.to_owned(), fields.string()?.to_owned());
    let count = fields.u64()?;
    Some(Attachment { log_time, create_time, name, media_type, data: fields.bytes(count)?.into() })
}
