//! The channels and schemas of a file, wherever in it they are defined.
//!
//! A chunk need not repeat the definitions of an earlier one, which may be damaged: then the definition in the summary,
//! or in the record at the head of one of our chunks, is shown instead, before the first message that needs it.
//!
//! Invariant: at most [`LARGEST`] bytes of definitions and metadata and at most [`MOST`] definitions are shown. The
//! rest is counted.

use std::collections::{BTreeMap, VecDeque};

use super::episode_id::EpisodeId;
use super::op;
use super::own::{Owner, Owners};
use super::wire::Fields;

/// Maximum bytes of definitions and metadata: many times those of an episode of 64 devices that are replugged all day.
const LARGEST: usize = 8 << 20;
/// Schemas and channels.
const MOST: usize = 4096;

#[derive(Debug, Default)]
pub(super) struct Names {
    /// Check value of each definition shown or waiting, by opcode and number.
    known: BTreeMap<(u8, u16), u32>,
    waiting: VecDeque<(u8, Vec<u8>)>,
    /// Bytes of definitions and metadata shown or waiting.
    bytes: usize,
    /// Definitions and metadata that are not shown: too many, or not where such a record belongs.
    pub(super) excess: u64,
    /// The episode of the file, according to its chunks and to the metadata at its beginning.
    pub(super) owner: Owner,
    pub(super) named: Option<EpisodeId>,
    /// The episodes of its chunks, from which the owner is determined.
    pub(super) owners: Owners,
    /// Messages not shown because their channel is unknown, by channel number.
    pub(super) unknown: BTreeMap<u16, u64>,
}

impl Names {
    pub(super) fn new(owner: Owner) -> Self {
        Self { owner, ..Self::default() }
    }

    /// Whether this record is shown. Definitions are remembered; a message of an unknown channel is counted.
    pub(super) fn admit(&mut self, opcode: u8, data: &[u8]) -> bool {
        if opcode == op::METADATA {
            return self.has_room(data);
        }
        let Some(id) = Fields(data).u16() else { return opcode != op::MESSAGE };
        match opcode {
            op::SCHEMA | op::CHANNEL => {
                let (crc, known) = (crc32fast::hash(data), self.known.get(&(opcode, id)));
                // A definition is not shown twice, but one that contradicts it is.
                if known == Some(&crc) || known.is_none() && self.is_full() || !self.has_room(data) {
                    return false;
                }
                self.known.entry((opcode, id)).or_insert(crc);
                true
            }
            op::MESSAGE if !self.known.contains_key(&(op::CHANNEL, id)) => {
                *self.unknown.entry(id).or_default() += 1;
                false
            }
            _ => true,
        }
    }

    /// Counts a definition or metadata record to be kept; `false` if the limit is reached.
    pub(super) fn has_room(&mut self, data: &[u8]) -> bool {
        let bytes = self.bytes.saturating_add(data.len());
        let has_room = bytes <= LARGEST;
        self.bytes = if has_room { bytes } else { self.bytes };
        self.excess += u64::from(!has_room);
        has_room
    }

    fn is_full(&mut self) -> bool {
        let is_full = self.known.len() >= MOST;
        self.excess += u64::from(is_full);
        is_full
    }

    /// Whether the channel of this message is known.
    pub(super) fn knows(&self, message: &[u8]) -> bool {
        Fields(message).u16().is_some_and(|id| self.known.contains_key(&(op::CHANNEL, id)))
    }

    /// Whether this definition differs from the known one of the same number.
    pub(super) fn contradicts(&self, opcode: u8, data: &[u8]) -> bool {
        let id = Fields(data).u16();
        let known = id.and_then(|id| self.known.get(&(opcode, id)));
        known.is_some_and(|crc| *crc != crc32fast::hash(data))
    }

    /// Queues a definition to be shown, if its number is new.
    pub(super) fn wait(&mut self, opcode: u8, data: &[u8]) {
        let Some(id) = Fields(data).u16().filter(|_| matches!(opcode, op::SCHEMA | op::CHANNEL)) else { return };
        let bytes = self.bytes.saturating_add(data.len());
        if bytes <= LARGEST && self.known.len() < MOST && !self.known.contains_key(&(opcode, id)) {
            self.bytes = bytes;
            self.known.insert((opcode, id), crc32fast::hash(data));
            self.waiting.push_back((opcode, data.to_owned()));
        }
    }

    /// The next queued definition.
    pub(super) fn next(&mut self) -> Option<(u8, Vec<u8>)> {
        self.waiting.pop_front()
    }
}
