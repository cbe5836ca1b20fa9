//! What the channels and schemas of a file are, wherever in it that stands.
//!
//! A chunk need not repeat what an earlier one defined, and that one may be damaged: what is defined at another place,
//! the summary or the record at the head of a chunk of ours, is shown in its stead, before the first message that needs
//! it.
//!
//! Invariant: of definitions and metadata at most [`LARGEST`] bytes and [`MOST`] definitions are shown:
//! their number is bounded. The rest is counted.

use std::collections::{BTreeMap, VecDeque};

use super::op;
use super::own::{EpisodeId, Owner, Owners};
use super::wire::Fields;

/// Bytes of definitions and metadata: many times what an episode of 64 devices has, which is replugged all day.
const LARGEST: usize = 8 << 20;
/// Schemas and channels.
const MOST: usize = 4096;

/// See the module's comment.
#[derive(Debug, Default)]
pub(super) struct Names {
    /// Check value of each definition shown or waiting, by opcode and number.
    known: BTreeMap<(u8, u16), u32>,
    waiting: VecDeque<(u8, Vec<u8>)>,
    /// Of definitions and metadata shown or waiting.
    bytes: usize,
    /// Definitions and metadata that are not shown: too many, or not where such a record belongs.
    pub(super) excess: u64,
    /// The episode that the file is, by its chunks, and by the metadata at its beginning.
    pub(super) owner: Owner,
    pub(super) named: Option<EpisodeId>,
    /// Where the owner is looked for: the episodes of its chunks.
    pub(super) owners: Owners,
    /// Messages not shown because their channel is not known, by its number.
    pub(super) unknown: BTreeMap<u16, u64>,
}

impl Names {
    pub(super) fn of(owner: Owner) -> Self {
        Self { owner, ..Self::default() }
    }

    /// Is this record to be shown? Definitions are remembered; a message of an unknown channel is counted.
    pub(super) fn admit(&mut self, opcode: u8, data: &[u8]) -> bool {
        if opcode == op::METADATA {
            return self.has_room(data);
        }
        let Some(id) = Fields(data).u16() else { return opcode != op::MESSAGE };
        match opcode {
            op::SCHEMA | op::CHANNEL => {
                let (crc, known) = (crc32fast::hash(data), self.known.get(&(opcode, id)));
                // What was shown is not shown again; what contradicts it is.
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

    /// Takes note of a definition or of metadata that are kept; `false`: no more may be.
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

    /// Is the channel of this message known?
    pub(super) fn knows(&self, message: &[u8]) -> bool {
        Fields(message).u16().is_some_and(|id| self.known.contains_key(&(op::CHANNEL, id)))
    }

    /// Is this definition another one than that of the same number which is known?
    pub(super) fn contradicts(&self, opcode: u8, data: &[u8]) -> bool {
        let id = Fields(data).u16();
        let known = id.and_then(|id| self.known.get(&(opcode, id)));
        known.is_some_and(|crc| *crc != crc32fast::hash(data))
    }

    /// Has a definition wait to be shown, if its number is new.
    pub(super) fn wait(&mut self, opcode: u8, data: &[u8]) {
        let Some(id) = Fields(data).u16().filter(|_| matches!(opcode, op::SCHEMA | op::CHANNEL)) else { return };
        let bytes = self.bytes.saturating_add(data.len());
        if bytes <= LARGEST && self.known.len() < MOST && !self.known.contains_key(&(opcode, id)) {
            self.bytes = bytes;
            self.known.insert((opcode, id), crc32fast::hash(data));
            self.waiting.push_back((opcode, data.to_owned()));
        }
    }

    /// The next definition that waits.
    pub(super) fn next(&mut self) -> Option<(u8, Vec<u8>)> {
        self.waiting.pop_front()
    }
}
