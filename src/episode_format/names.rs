//! What the channels and schemas of a file are, wherever in it that stands.
//!
//! A chunk need not repeat what an earlier one defined, and that one may be damaged: what is defined at another place,
//! the summary or the record at the head of a chunk of ours, is shown in its stead, before the first message that needs it.
//!
//! Invariant: memory holds at most [`LARGEST`] bytes of definitions.

use std::collections::{BTreeMap, VecDeque};

use super::op;
use super::own::Owner;
use super::wire::Fields;

/// Bytes of definitions that wait to be shown: a hundred times what an episode of 64 devices has.
const LARGEST: usize = 16 << 20;

/// See the module's comment.
#[derive(Debug, Default)]
pub(super) struct Names {
    /// Check value of each definition shown or waiting, by opcode and number.
    known: BTreeMap<(u8, u16), u32>,
    waiting: VecDeque<(u8, Vec<u8>)>,
    waiting_bytes: usize,
    /// The episode that the file is, and the one that the chunk shown last says it belongs to.
    pub(super) owner: Owner,
    pub(super) last: Owner,
    /// Messages not shown because their channel is not known, by its number.
    pub(super) unknown: BTreeMap<u16, u64>,
}

impl Names {
    pub(super) fn of(owner: Owner) -> Self {
        Self { owner, ..Self::default() }
    }

    /// Is this record to be shown? Definitions are remembered; a message of an unknown channel is counted.
    pub(super) fn admit(&mut self, opcode: u8, data: &[u8]) -> bool {
        let Some(id) = Fields(data).u16() else { return opcode != op::MESSAGE };
        match opcode {
            op::SCHEMA | op::CHANNEL => {
                self.known.entry((opcode, id)).or_insert_with(|| crc32fast::hash(data));
                true
            }
            op::MESSAGE if !self.known.contains_key(&(op::CHANNEL, id)) => {
                *self.unknown.entry(id).or_default() += 1;
                false
            }
            _ => true,
        }
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
        let bytes = self.waiting_bytes + data.len();
        if bytes <= LARGEST && !self.known.contains_key(&(opcode, id)) {
            self.waiting_bytes = bytes;
            self.known.insert((opcode, id), crc32fast::hash(data));
            self.waiting.push_back((opcode, data.to_owned()));
        }
    }

    /// The next definition that waits.
    pub(super) fn next(&mut self) -> Option<(u8, Vec<u8>)> {
        let (opcode, data) = self.waiting.pop_front()?;
        self.waiting_bytes = self.waiting_bytes.saturating_sub(data.len());
        Some((opcode, data))
    }
}
