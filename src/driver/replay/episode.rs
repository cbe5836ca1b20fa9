//! A recorded episode as a file: what is in it, and its messages one by one.
//!
//! Invariant: the file is read from its beginning to its end, one chunk at a time.
//! Invariant: what lies in a damaged chunk is not played.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::wire::{self, Schema};
use super::{DriverError, fatal};
use crate::episode_format::walk::{FileEnd, MAGIC, Walk, op};
use crate::episode_format::wire::Fields;
use crate::episode_format::{self, ABOUT, ReadAt};
use crate::mask::{MASK_TOPIC, PhysicalMask};
use crate::modality::ModalityId;

/// Changes of the mask that are played: a device that flaps at 500 Hz, the rate of the mask, reaches
/// them after half an hour.
const MAX_CHANGES: usize = 1_000_000;
/// Longest text of a record that is remembered, such as the registry.
pub(super) const MAX_TEXT: usize = 16 << 20;
/// Channel, sequence number and two times stand before a message's data.
pub(super) const MESSAGE_HEAD: usize = 2 + 4 + 8 + 8;

/// What an episode holds.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeDescription {
    /// Wall time of the first message, ns since 1970.
    pub begin_ns: u64,
    /// Wall time of the last message, ns since 1970.
    pub end_ns: u64,
    /// Topics, by name.
    pub topics: Vec<TopicDescription>,
    /// Names and bits of the modalities, by bit.
    pub layout: Vec<(String, ModalityId)>,
    /// Text of the `devices.toml` it was recorded with.
    pub registry: String,
    /// The mask at its first record and after each change, with wall time in ns, ascending.
    pub mask: Vec<(u64, PhysicalMask)>,
}

/// A topic of an episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicDescription {
    /// Name.
    pub topic: String,
    /// Name of the schema, for example `foxglove.CompressedImage`.
    pub schema: String,
    /// Encoding of the messages, for example `protobuf`.
    pub message_encoding: String,
    /// Messages.
    pub messages: u64,
}

/// What is in `file`. Reads the whole of it, a chunk at a time; blocks.
///
/// # Errors
/// When the file cannot be read, or is damaged or was never closed.
pub fn describe(file: &Path) -> Result<EpisodeDescription, DriverError> {
    Episode::open(file)?.describe()
}

/// An open file that ends as a finished one does.
pub(super) struct Episode {
    path: PathBuf,
    file: File,
    size: u64,
}

impl Episode {
    pub(super) fn open(path: &Path) -> Result<Self, DriverError> {
        let (mut file, size) = episode_format::open(path).map_err(|error| DriverError::Fatal(error.to_string()))?;
        if size < MAGIC.len() as u64 {
            return Err(fatal(path, NO_MCAP));
        }
        let from_end = i64::try_from(MAGIC.len()).unwrap_or(0);
        let mut magic_at = |place| {
            let mut read = [0; MAGIC.len()];
            file.seek(place).and_then(|_| file.read_exact(&mut read)).map_err(|error| fatal(path, error))?;
            Ok(read == MAGIC)
        };
        let is_closed = magic_at(SeekFrom::End(-from_end))?;
        if !magic_at(SeekFrom::Start(0))? {
            return Err(fatal(path, NO_MCAP));
        }
        file.rewind().map_err(|error| fatal(path, error))?;
        if !is_closed {
            return Err(fatal(path, format!("was not closed, and cannot be played; {}", fix(path))));
        }
        Ok(Self { path: path.to_owned(), file, size })
    }

    /// The messages of `topic` from `from_ns` on.
    pub(super) fn play(self, topic: &str, from_ns: u64) -> Result<Messages<File>, DriverError> {
        let Self { path, file, size } = self;
        let walk = begin(&path, file, size)?;
        let mut messages = Messages::new(walk, topic, from_ns);
        if messages.seek().map_err(|error| fatal(&path, error))? {
            return Ok(messages);
        }
        Err(fatal(&path, messages.channels.refusal(topic)))
    }

    fn describe(self) -> Result<EpisodeDescription, DriverError> {
        let walk = begin(&self.path, self.file, self.size)?;
        let collected = Collected::read(walk).map_err(|error| fatal(&self.path, error))?;
        match collected.end {
            FileEnd::Finished => {}
            _ => return Err(fatal(&self.path, format!("is damaged; {}", fix(&self.path)))),
        }
        collected.description().map_err(|why| fatal(&self.path, why))
    }
}

pub(super) const NO_MCAP: &str = "not an MCAP file";

fn fix(path: &Path) -> String {
    format!("`rapid recover {}` makes it whole, `rapid inspect` reads what is there", path.display())
}

fn begin(path: &Path, file: File, size: u64) -> Result<Walk<File>, DriverError> {
    let walk = Walk::new(file, size).map_err(|error| fatal(path, error))?;
    walk.ok_or_else(|| fatal(path, NO_MCAP))
}

/// Reads `bytes`, which may be any, as replay reads a file: what they hold and every message that a
/// device could play.
pub fn read_bytes(bytes: &[u8]) {
    let size = bytes.len() as u64;
    let Ok(Some(walk)) = Walk::new(bytes, size) else { return };
    let Ok(Ok(described)) = Collected::read(walk).map(Collected::description) else { return };
    for topic in described.topics {
        let Ok(Some(walk)) = Walk::new(bytes, size) else { return };
        let mut messages = Messages::new(walk, &topic.topic, described.begin_ns);
        let mut payload = Vec::new();
        while let Ok(Some(message)) = messages.next() {
            let _ = wire::payload(message.schema, message.data, &mut payload);
        }
    }
}

/// Channels and schemas, as they come.
#[derive(Debug, Default)]
pub(super) struct Channels {
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Channel>,
}

#[derive(Debug)]
struct Channel {
    topic: String,
    encoding: String,
    schema: String,
    messages: u64,
}

impl Channels {
    /// Takes a record; one that cannot be read is passed over.
    pub(super) fn take(&mut self, opcode: u8, data: &[u8]) -> Option<()> {
        let mut fields = Fields(data);
        let id = fields.u16()?;
        match opcode {
            op::SCHEMA => {
                let name = short(fields.string()?)?;
                self.schemas.entry(id).or_insert(name);
            }
            op::CHANNEL => {
                let schema = fields.u16()?;
                let (topic, encoding) = (short(fields.string()?)?, short(fields.string()?)?);
                let schema = self.schemas.get(&schema).cloned().unwrap_or_default();
                self.channels.entry(id).or_insert(Channel { topic, encoding, schema, messages: 0 });
            }
            _ => {}
        }
        Some(())
    }

    /// The topic of the channel `id`.
    pub(super) fn topic(&self, id: u16) -> Option<&str> {
        self.channels.get(&id).map(|channel| channel.topic.as_str())
    }

    /// What a device could play of the channel `id` of `topic`.
    pub(super) fn schema(&self, id: u16, topic: &str) -> Option<Schema> {
        let channel = self.channels.get(&id).filter(|channel| channel.topic == topic)?;
        Schema::named(&channel.schema).filter(|_| channel.encoding == "protobuf")
    }

    /// Why `topic` cannot be played.
    fn refusal(&self, topic: &str) -> String {
        if let Some(channel) = self.channels.values().find(|channel| channel.topic == topic) {
            return format!("{topic} holds {:?} messages, which no device sends", channel.schema);
        }
        let mut topics: Vec<&str> = self.channels.values().map(|channel| channel.topic.as_str()).collect();
        topics.sort_unstable();
        topics.dedup();
        format!("has no topic {topic}; it has {}", topics.join(", "))
    }
}

/// A name that can be meant: there may be 65536 of them.
fn short(text: &str) -> Option<String> {
    (text.len() <= 1024).then(|| text.to_owned())
}

/// What a walk through the whole file gathers.
#[derive(Debug)]
struct Collected {
    channels: Channels,
    about: BTreeMap<String, String>,
    times: Option<(u64, u64)>,
    mask: Vec<(u64, PhysicalMask)>,
    end: FileEnd,
}

impl Collected {
    fn read(mut walk: Walk<impl ReadAt>) -> io::Result<Self> {
        let mut collected = Self {
            channels: Channels::default(),
            about: BTreeMap::new(),
            times: None,
            mask: Vec::new(),
            end: FileEnd::Unfinished,
        };
        while let Some(record) = walk.next()? {
            // `None` is a record that is shorter than it says.
            let _ = match record.opcode {
                op::MESSAGE => collected.message(record.data),
                op::METADATA => collected.metadata(record.data),
                opcode => collected.channels.take(opcode, record.data),
            };
            if collected.mask.len() > MAX_CHANGES {
                return Err(io::Error::other("the mask changes more than a million times"));
            }
        }
        collected.end = walk.walked().end;
        Ok(collected)
    }

    fn message(&mut self, data: &[u8]) -> Option<()> {
        let mut fields = Fields(data);
        let (id, _sequence) = (fields.u16()?, fields.u32()?);
        let (at, _published) = (fields.u64()?, fields.u64()?);
        let channel = self.channels.channels.get_mut(&id)?;
        channel.messages += 1;
        let (first, last) = self.times.unwrap_or((at, at));
        self.times = Some((first.min(at), last.max(at)));
        if channel.topic == MASK_TOPIC {
            let mask = wire::mask(fields.0)?;
            if self.mask.last().is_none_or(|(_, last)| *last != mask) {
                self.mask.push((at, mask));
            }
        }
        Some(())
    }

    fn metadata(&mut self, data: &[u8]) -> Option<()> {
        let mut fields = Fields(data);
        if fields.string()? == ABOUT && fields.0.len() <= MAX_TEXT {
            self.about = fields.map()?;
        }
        Some(())
    }

    fn description(mut self) -> Result<EpisodeDescription, String> {
        let mut topics: BTreeMap<String, TopicDescription> = BTreeMap::new();
        for channel in self.channels.channels.into_values() {
            let Channel { topic, encoding, schema, messages } = channel;
            let described = TopicDescription { topic: topic.clone(), schema, message_encoding: encoding, messages: 0 };
            topics.entry(topic).or_insert(described).messages += messages;
        }
        let layout = self.about.remove("layout").unwrap_or_default();
        let layout: BTreeMap<String, u8> = if layout.is_empty() {
            BTreeMap::new()
        } else {
            serde_json::from_str(&layout).map_err(|error| format!("its metadata cannot be read: {error}"))?
        };
        let mut layout: Vec<_> =
            layout.into_iter().filter_map(|(name, bit)| Some((name, ModalityId::new(bit)?))).collect();
        layout.sort_by_key(|(_, id)| *id);
        // Within a topic of ours times ascend; of another writer's file nothing is known.
        self.mask.sort_by_key(|(at, _)| *at);
        let (begin_ns, end_ns) = self.times.unwrap_or_default();
        let registry = self.about.remove("registry").unwrap_or_default();
        Ok(EpisodeDescription {
            begin_ns,
            end_ns,
            topics: topics.into_values().collect(),
            layout,
            registry,
            mask: self.mask,
        })
    }
}

/// The messages of a topic that a device could play, in the order they were recorded.
pub(super) struct Messages<R> {
    walk: Walk<R>,
    channels: Channels,
    topic: String,
    from_ns: u64,
}

impl<R> std::fmt::Debug for Messages<R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Messages").field("topic", &self.topic).finish_non_exhaustive()
    }
}

/// One message of the topic.
#[derive(Debug, Clone, Copy)]
pub(super) struct Recorded<'a> {
    pub(super) log_time: u64,
    pub(super) schema: Schema,
    pub(super) data: &'a [u8],
}

impl<R: ReadAt> Messages<R> {
    fn new(walk: Walk<R>, topic: &str, from_ns: u64) -> Self {
        Self { walk, channels: Channels::default(), topic: topic.to_owned(), from_ns }
    }

    /// Reads on to a channel of the topic that can be played; is there one?
    fn seek(&mut self) -> io::Result<bool> {
        while let Some(record) = self.walk.next()? {
            if record.opcode == op::MESSAGE {
                continue;
            }
            let _ = self.channels.take(record.opcode, record.data);
            let id = Fields(record.data).u16().filter(|_| record.opcode == op::CHANNEL);
            if id.is_some_and(|id| self.channels.schema(id, &self.topic).is_some()) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// The next message; `None` at the end.
    pub(super) fn next(&mut self) -> io::Result<Option<Recorded<'_>>> {
        while self.walk.advance()? {
            if let Some((log_time, schema)) = self.wanted() {
                let data = self.walk.record().data.get(MESSAGE_HEAD..).unwrap_or_default();
                return Ok(Some(Recorded { log_time, schema, data }));
            }
        }
        Ok(None)
    }

    /// Is the record at hand a message to be played? Its time, and what it is.
    fn wanted(&mut self) -> Option<(u64, Schema)> {
        let record = self.walk.record();
        if record.opcode != op::MESSAGE {
            self.channels.take(record.opcode, record.data)?;
            return None;
        }
        let mut fields = Fields(record.data);
        let (id, _sequence) = (fields.u16()?, fields.u32()?);
        let (log_time, _published) = (fields.u64()?, fields.u64()?);
        let schema = self.channels.schema(id, &self.topic)?;
        (log_time >= self.from_ns).then_some((log_time, schema))
    }
}
