//! The record that begins every chunk of an episode of ours: which episode the chunk belongs to, and what its channels
//! are.
//!
//! A chunk need not repeat what an earlier one defines, and that one may be damaged; nor does MCAP say which file a chunk
//! belongs to, and one that is found behind damage may be the payload of a message. The chunk's check value covers this
//! record, so both are known wherever the chunk is right.
//!
//! Layout: private opcode [`op::OWN`], which other readers pass over; its content is [`MARK`], 16 bytes of the episode,
//! then schema and channel records with their heads, each schema before the channels that need it.
//!
//! Which episode a file is follows from its first chunk if everything before that is right. Otherwise it follows from its
//! last right chunk: what lies in a message of an episode is followed by the rest of that episode.

use std::collections::BTreeSet;
use std::io;

use super::chunk::{Records, take};
use super::op;
use super::source::ReadAt;
use super::walk::Walk;
use super::wire::Fields;

/// Tells the record from another program's of the same opcode.
const MARK: [u8; 8] = *b"rapid/1\n";
/// Bytes of definitions that are repeated in every chunk; no more, or a hostile file would grow without bound when it is
/// repaired. An episode of 64 devices has about 30 KiB.
const LARGEST: usize = 256 << 10;

/// Identifies an episode among all that may lie in one file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct EpisodeId([u8; 16]);

impl EpisodeId {
    /// Of the episode that begins now: ns since 1970, and ns of the monotonic clock, which no two have alike.
    pub(crate) fn new(wall_ns: u64, monotonic_ns: u64) -> Self {
        Self((u128::from(wall_ns) << 64 | u128::from(monotonic_ns)).to_le_bytes())
    }
}

/// Which episode the chunks of a file belong to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Owner {
    #[default]
    Unknown,
    /// Whose file it is is being looked for: every chunk counts.
    Any,
    /// No right chunk says: the file is another program's, or is older than this record.
    Unnamed,
    Episode(EpisodeId),
}

impl Owner {
    fn of(episode: Option<EpisodeId>) -> Self {
        episode.map_or(Self::Unnamed, Self::Episode)
    }
}

/// The record of an episode that is being written.
#[derive(Debug)]
pub(crate) struct Own {
    content: Vec<u8>,
    known: BTreeSet<(u8, u16)>,
}

impl Own {
    /// Of an episode without channels.
    pub(crate) fn new(episode: EpisodeId) -> Self {
        Self { content: [&MARK[..], &episode.0].concat(), known: BTreeSet::new() }
    }

    /// The record's content.
    pub(crate) fn content(&self) -> &[u8] {
        &self.content
    }

    /// Adds the definition whose record has this content, unless its number is known. Those beyond [`LARGEST`] bytes are
    /// left out.
    pub(crate) fn define(&mut self, opcode: u8, record: &[u8]) {
        let Some(id) = Fields(record).u16() else { return };
        if self.content.len() + record.len() <= LARGEST && self.known.insert((opcode, id)) {
            self.content.push(opcode);
            self.content.extend((record.len() as u64).to_le_bytes());
            self.content.extend(record);
        }
    }
}

/// Is this private record's content ours?
pub(crate) fn is(content: &[u8]) -> bool {
    content.starts_with(&MARK)
}

/// The record's episode and its definitions, if the first of these records is one.
fn first(records: &[u8]) -> Option<(EpisodeId, Fields<'_>)> {
    let (opcode, content) = take(&mut Fields(records))?;
    let rest = content.strip_prefix(&MARK).filter(|_| opcode == op::OWN)?;
    let (episode, definitions) = rest.split_first_chunk()?;
    Some((EpisodeId(*episode), Fields(definitions)))
}

impl<R: ReadAt> Walk<R> {
    /// The episode that the chunks shown so far belong to; `None` also if they do not say.
    pub(crate) fn episode(&self) -> Option<EpisodeId> {
        match self.names.owner {
            Owner::Episode(episode) => Some(episode),
            Owner::Unknown | Owner::Any | Owner::Unnamed => None,
        }
    }

    /// Is the file an episode of ours, as far as anything of it says?
    pub(super) fn is_episode(&mut self) -> io::Result<bool> {
        self.look_for_owner()?;
        Ok(matches!(self.names.owner, Owner::Episode(_) | Owner::Any))
    }

    /// Do these records say that they are an episode's of ours?
    pub(super) fn is_owned(&self, records: &Records) -> bool {
        first(self.bytes(records)).is_some()
    }

    pub(super) fn bytes(&self, records: &Records) -> &[u8] {
        let bytes = if records.unpacked { &self.unpacked } else { &self.buffer };
        bytes.get(records.range.clone()).unwrap_or_default()
    }

    /// Learns from a right chunk, where the records of this file lie; `false`: it is not this file's.
    pub(super) fn learn(&mut self, records: &Records) -> io::Result<bool> {
        if !self.checked {
            self.look_for_owner()?;
        }
        let bytes = if records.unpacked { &self.unpacked } else { &self.buffer };
        let own = first(bytes.get(records.range.clone()).unwrap_or_default());
        let owner = Owner::of(own.map(|(episode, _)| episode));
        self.names.last = owner;
        if self.names.owner == Owner::Unknown && self.checked {
            self.names.owner = owner;
        }
        if matches!(self.names.owner, Owner::Episode(_)) && self.names.owner != owner {
            return Ok(self.checked);
        }
        let mut definitions = own.map_or(Fields(&[]), |(_, definitions)| definitions);
        while let Some((opcode, data)) = take(&mut definitions) {
            self.names.wait(opcode, data);
        }
        Ok(true)
    }

    /// Are these records, found behind damage, this file's? Where no chunk says, it is those that contradict nothing.
    pub(super) fn is_own(&mut self, records: &Records) -> io::Result<bool> {
        let owner = Owner::of(first(self.bytes(records)).map(|(episode, _)| episode));
        self.look_for_owner()?;
        Ok(match self.names.owner {
            Owner::Any => true,
            known @ Owner::Episode(_) => known == owner,
            Owner::Unnamed if owner != Owner::Unnamed => false,
            Owner::Unnamed | Owner::Unknown => self.is_consistent(self.bytes(records)),
        })
    }

    /// Reads the file once more, for its last right chunk, unless it is known or was looked for.
    fn look_for_owner(&mut self) -> io::Result<()> {
        if self.names.owner != Owner::Unknown {
            return Ok(());
        }
        let file: &dyn ReadAt = &self.source.file;
        let walk = Walk::begin(file, self.source.size, Some(Owner::Any))?;
        self.names.owner = Owner::Unnamed;
        let Some(mut walk) = walk else { return Ok(()) };
        while walk.advance()? {}
        self.names.owner = if walk.names.last == Owner::Unknown { Owner::Unnamed } else { walk.names.last };
        Ok(())
    }
}
