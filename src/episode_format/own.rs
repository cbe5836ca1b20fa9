//! The record that begins every chunk of an episode of ours: which episode the chunk belongs to, and what its channels
//! are.
//!
//! A chunk need not repeat what an earlier one defines, and that one may be damaged; nor does MCAP record which file a
//! chunk belongs to, and one that is found behind damage may be the payload of a message. The chunk's check value covers
//! this record, so both are known wherever the chunk is right.
//!
//! Layout: private opcode [`op::OWN`], which other readers pass over; its content is [`MARK`], 16 bytes of the episode,
//! then schema and channel records with their heads, each schema before the channels that need it.
//!
//! Which episode a file is follows from its metadata `rapid`, or from its first chunk, if everything before that is right.
//! Otherwise from all of its right chunks, see `owners`.

use std::collections::{BTreeMap, BTreeSet};
use std::io;

use super::chunk::{Records, take};
use super::header::Writer;
use super::op;
use super::owners;
use super::source::ReadAt;
use super::walk::Walk;
use super::wire::Fields;
use super::{ABOUT, BOOT_ID};

/// Distinguishes the record from another program's of the same opcode.
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

    /// Of the episode whose metadata [`ABOUT`] are these.
    pub(crate) fn of(about: &BTreeMap<String, String>) -> Option<Self> {
        let number = |key: &str| about.get(key)?.parse().ok();
        Some(Self::new(number("begin_wall_ns")?, number("begin_monotonic_ns")?))
    }
}

/// Which episode the chunks of a file belong to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Owner {
    #[default]
    Unknown,
    /// Whose file it is is being looked for: every chunk counts.
    Any,
    /// No right chunk names one: the file is another program's, or is older than this record.
    Unnamed,
    Episode(EpisodeId),
}

impl Owner {
    pub(super) fn of(episode: Option<EpisodeId>) -> Self {
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

    /// The record's content without the definitions.
    pub(crate) fn episode(&self) -> &[u8] {
        self.content.get(..MARK.len() + 16).unwrap_or_default()
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
    /// The episode that the chunks shown so far belong to; `None` also if they name none.
    pub(crate) fn episode(&self) -> Option<EpisodeId> {
        match self.names.owner {
            Owner::Episode(episode) => Some(episode),
            Owner::Unknown | Owner::Any | Owner::Unnamed => None,
        }
    }

    /// Is the file an episode of ours, as far as anything in it shows?
    pub(super) fn is_episode(&mut self) -> io::Result<bool> {
        self.look_for_owner()?;
        Ok(matches!(self.names.owner, Owner::Episode(_) | Owner::Any))
    }

    /// Do these records name an episode of ours?
    pub(super) fn is_owned(&self, records: &Records) -> bool {
        first(self.bytes(records)).is_some()
    }

    pub(super) fn bytes(&self, records: &Records) -> &[u8] {
        let bytes = if records.unpacked { &self.unpacked } else { &self.buffer };
        bytes.get(records.range.clone()).unwrap_or_default()
    }

    /// Learns from a right chunk, where the records of this file lie; `false`: it is not this file's.
    pub(super) fn learn(&mut self, records: &Records) -> io::Result<bool> {
        let bytes = if records.unpacked { &self.unpacked } else { &self.buffer };
        let owner = Owner::of(first(bytes.get(records.range.clone()).unwrap_or_default()).map(|(episode, _)| episode));
        if self.names.owner == Owner::Unknown {
            // The metadata at the beginning name the episode; without them its first chunk does.
            let is_named = self.names.named.is_none_or(|named| owner == Owner::Episode(named));
            if self.checked && is_named {
                self.names.owner = owner;
            } else {
                self.look_for_owner()?;
            }
        }
        if matches!(self.names.owner, Owner::Episode(_)) && self.names.owner != owner {
            self.walked.left_out.other_chunks += 1;
            self.checked = false;
            return Ok(false);
        }
        let bytes = if records.unpacked { &self.unpacked } else { &self.buffer };
        let bytes = bytes.get(records.range.clone()).unwrap_or_default();
        if self.names.owner == Owner::Any {
            self.names.owners.take(owner, bytes);
        }
        let mut definitions = first(bytes).map_or(Fields(&[]), |(_, definitions)| definitions);
        while let Some((opcode, data)) = take(&mut definitions) {
            self.names.wait(opcode, data);
        }
        Ok(true)
    }

    /// What the file states about itself at its beginning.
    pub(super) fn remember(&mut self, opcode: u8) {
        if opcode != op::METADATA || self.begin_ns.is_some() {
            return;
        }
        let Some(about) = about(&self.buffer) else { return };
        self.begin_ns = about.get("begin_wall_ns").and_then(|ns| ns.parse().ok());
        self.same_boot = self.boot.is_some() && about.get(BOOT_ID) == self.boot.as_ref();
        // What stands behind damage may be another file's.
        self.names.named = if self.checked && !self.chunked { EpisodeId::of(&about) } else { None };
    }

    /// Are these records, found behind damage, this file's? Where no chunk names an episode, it is those that contradict
    /// nothing.
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

    /// Reads the file once more, for whose it is, unless that is known or was looked for.
    fn look_for_owner(&mut self) -> io::Result<()> {
        if self.names.owner != Owner::Unknown {
            return Ok(());
        }
        self.names.owner = Owner::Unnamed;
        let Some(mut walk) = Walk::begin(self.source.again(), Some(Owner::Any))? else { return Ok(()) };
        while walk.advance()? {}
        let owners = walk.names.owners;
        let is_foreign = self.walked.writer == Writer::Another;
        self.names.owner = owners.owner(self.names.named, self.checked, is_foreign, &mut self.source)?;
        Ok(())
    }

    /// Where the episode begins of which a chunk was found, if its beginning stands before that, behind something else.
    pub(super) fn beginning(&mut self) -> io::Result<Option<u64>> {
        let Some(episode) = self.episode() else { return Ok(None) };
        let begun = owners::beginnings(&mut self.source, self.at)?;
        Ok(begun.into_iter().find_map(|(at, begun)| (begun == episode).then_some(at)))
    }
}

/// The metadata [`ABOUT`], if the content of a metadata record is those.
pub(super) fn about(content: &[u8]) -> Option<BTreeMap<String, String>> {
    let mut fields = Fields(content);
    fields.string().filter(|name| *name == ABOUT)?;
    fields.map()
}

/// The episode that each [`MARK`] in `bytes` behind the first names.
pub(super) fn marks(bytes: &[u8]) -> impl Iterator<Item = EpisodeId> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        while let Some(at) = rest.iter().position(|byte| *byte == MARK[0]) {
            let here = rest.get(at..)?;
            rest = here.get(1..)?;
            if let Some((episode, _)) = here.strip_prefix(&MARK).and_then(<[u8]>::split_first_chunk) {
                return Some(EpisodeId(*episode));
            }
        }
        None
    })
}
