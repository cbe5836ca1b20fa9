//! Every message of an episode in the order of the file, as far as the file goes.
//!
//! Invariant: memory holds one record of the file at a time.
//! Invariant: what lies in a damaged chunk, and a message that cannot be read, is passed over.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

use super::episode::{Channels, MAX_TEXT, NO_MCAP};
use super::wire::{self, Shape};
use super::{DriverError, fatal};
use crate::episode_format::walk::{FileEnd, Walk, op};
use crate::episode_format::wire::{Fields, protobuf};
use crate::episode_format::{self, ABOUT, EVENT_TOPIC};
use crate::mask::{MASK_TOPIC, PhysicalMask};
use crate::sample::Encoding;

/// See the module's comment.
pub struct Tape {
    path: PathBuf,
    walk: Walk<File>,
    channels: Channels,
    about: BTreeMap<String, String>,
    payload: Vec<u8>,
}

impl std::fmt::Debug for Tape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tape").field("path", &self.path).finish_non_exhaustive()
    }
}

/// A recorded message.
#[derive(Debug, Clone, Copy)]
pub struct Taped<'a> {
    /// Its topic.
    pub topic: &'a str,
    /// The lower 32 bits of the number that a sample, a mask or an action had.
    pub sequence: u32,
    /// When it was captured, wall time in ns since 1970.
    pub log_time: u64,
    /// When it was received, wall time in ns since 1970.
    pub publish_time: u64,
    /// What it says.
    pub content: Content<'a>,
}

/// What a message says.
#[derive(Debug, Clone, Copy)]
pub enum Content<'a> {
    /// A sample, as its device gave it.
    Sample {
        /// How `bytes` are encoded.
        encoding: Encoding,
        /// Pixels of a picture, how many of numbers.
        width: u32,
        /// Pixels of a picture.
        height: u32,
        /// The payload.
        bytes: &'a [u8],
    },
    /// A publication of the mask.
    Mask(PhysicalMask),
    /// An event.
    Event {
        /// Its kind.
        kind: &'a str,
        /// All of it, as JSON.
        json: &'a str,
    },
}

/// What is known of the message at hand before its content is read.
struct Head {
    channel: u16,
    sequence: u32,
    log_time: u64,
    publish_time: u64,
}

impl Tape {
    /// Opens an episode, finished or not.
    ///
    /// # Errors
    /// When it cannot be read or is no MCAP file.
    pub fn open(path: &Path) -> Result<Self, DriverError> {
        let (file, size) = episode_format::open(path).map_err(|error| DriverError::Fatal(error.to_string()))?;
        let walk = Walk::new(file, size).map_err(|error| fatal(path, error))?.ok_or_else(|| fatal(path, NO_MCAP))?;
        let walk = walk.of_boot(episode_format::boot_id());
        let (channels, about, payload) = (Channels::default(), BTreeMap::new(), Vec::new());
        Ok(Self { path: path.to_owned(), walk, channels, about, payload })
    }

    /// The next message that can be read; `None` at the end.
    ///
    /// # Errors
    /// When the disk gives an error.
    pub fn next_message(&mut self) -> Result<Option<Taped<'_>>, DriverError> {
        while self.walk.advance().map_err(|error| fatal(&self.path, error))? {
            let record = self.walk.record();
            let read = match record.opcode {
                op::MESSAGE => read(&self.channels, record.data, &mut self.payload),
                op::METADATA => {
                    let about = about(record.data);
                    self.about = about.unwrap_or_else(|| std::mem::take(&mut self.about));
                    None
                }
                opcode => {
                    // `None` is a record that is shorter than it says.
                    let _ = self.channels.take(opcode, record.data);
                    None
                }
            };
            if let Some((head, kind)) = read {
                return Ok(self.taped(&head, kind));
            }
        }
        Ok(None)
    }

    /// What the file says of itself at its beginning, as far as it has been read.
    #[must_use]
    pub fn about(&self, key: &str) -> Option<&str> {
        self.about.get(key).map(String::as_str)
    }

    /// After the last message: what of the file could not be read, if anything.
    #[must_use]
    pub fn damage(&self) -> Option<String> {
        let walked = self.walk.walked();
        let end = match walked.end {
            FileEnd::Finished => None,
            FileEnd::Unfinished => Some("the file was not finished".to_owned()),
            FileEnd::Torn => Some("the file ends within a record".to_owned()),
            FileEnd::Damaged => Some(format!("the file is damaged after {} bytes", walked.bytes)),
        };
        let said: Vec<String> = end.into_iter().chain(walked.left_out.sentences(walked.damaged_chunks)).collect();
        (!said.is_empty()).then(|| format!("{}; what could be read is used", said.join(", ")))
    }

    fn taped(&self, head: &Head, kind: Kind) -> Option<Taped<'_>> {
        let topic = self.channels.topic(head.channel)?;
        let content = match kind {
            Kind::Sample(Shape { encoding, width, height }) => {
                Content::Sample { encoding, width, height, bytes: &self.payload }
            }
            Kind::Mask(mask) => Content::Mask(mask),
            Kind::Event => {
                let (mut kind, mut json) = ("", "");
                for (field, value) in protobuf(self.walk.record().data.get(super::episode::MESSAGE_HEAD..)?) {
                    match field {
                        2 => kind = std::str::from_utf8(value.bytes()).unwrap_or_default(),
                        5 => json = std::str::from_utf8(value.bytes()).unwrap_or_default(),
                        _ => {}
                    }
                }
                Content::Event { kind, json }
            }
        };
        let Head { sequence, log_time, publish_time, .. } = *head;
        Some(Taped { topic, sequence, log_time, publish_time, content })
    }
}

#[derive(Clone, Copy)]
enum Kind {
    Sample(Shape),
    Mask(PhysicalMask),
    Event,
}

/// What kind of message this is; the payload of a sample is written into `payload`.
fn read(channels: &Channels, data: &[u8], payload: &mut Vec<u8>) -> Option<(Head, Kind)> {
    let mut fields = Fields(data);
    let (channel, sequence) = (fields.u16()?, fields.u32()?);
    let (log_time, publish_time) = (fields.u64()?, fields.u64()?);
    let kind = match channels.topic(channel)? {
        MASK_TOPIC => Kind::Mask(wire::mask(fields.0)?),
        EVENT_TOPIC => Kind::Event,
        topic => Kind::Sample(wire::payload(channels.schema(channel, topic)?, fields.0, payload)?),
    };
    Some((Head { channel, sequence, log_time, publish_time }, kind))
}

/// The record that stands at an episode's beginning, if it is that.
fn about(data: &[u8]) -> Option<BTreeMap<String, String>> {
    let mut fields = Fields(data);
    if fields.string()? == ABOUT && fields.0.len() <= MAX_TEXT { fields.map() } else { None }
}
