//! The record that begins every chunk of our episodes: it names the episode and defines the channels.
//!
//! A chunk need not repeat the definitions of an earlier one, which may be damaged. Nor does MCAP record which file a
//! chunk belongs to, and a chunk found after damage may be the payload of a message. The check value of the chunk
//! covers this record, so both are known wherever the chunk is valid.
//!
//! Layout: private opcode [`op::OWN`], which other readers skip; its content is [`MARK`], 16 bytes of the episode,
//! then schema and channel records with their heads, each schema before the channels that need it.
//!
//! The episode of a file follows from its metadata `rapid`, or from its first chunk if everything before that is valid.
//! Otherwise it follows from all valid chunks, see [`Owners`].

use std::collections::BTreeSet;
use std::io;

use super::chunk::first_record;
use super::episode_id::{EpisodeId, about};
use super::framing::{HEAD, MAGIC};
use super::integrity::{LARGEST_HEADER, Writer, writer};
use super::op;
use super::source::{ReadAt, WindowedFile};
use super::wire::Fields;

/// Distinguishes the record from another program's of the same opcode.
const MARK: [u8; 8] = *b"rapid/1\n";
/// Maximum bytes of definitions repeated in every chunk: otherwise the repair of a hostile file could grow without
/// bound. An episode of 64 devices has about 30 KiB.
const LARGEST: usize = 256 << 10;

/// Which episode the chunks of a file belong to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Owner {
    #[default]
    Unknown,
    /// The owner of the file is being determined: every chunk counts.
    Any,
    /// No valid chunk names one: the file is another program's, or older than this record.
    Unnamed,
    Episode(EpisodeId),
}

impl From<Option<EpisodeId>> for Owner {
    fn from(episode: Option<EpisodeId>) -> Self {
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

/// Whether this private record's content is ours.
pub(crate) fn is(content: &[u8]) -> bool {
    content.starts_with(&MARK)
}

/// The record's episode and its definitions, if the first of these records is one.
pub(super) fn first(records: &[u8]) -> Option<(EpisodeId, Fields<'_>)> {
    let (opcode, content) = first_record(&mut Fields(records))?;
    let rest = content.strip_prefix(&MARK).filter(|_| opcode == op::OWN)?;
    let (episode, definitions) = rest.split_first_chunk()?;
    Some((EpisodeId(*episode), Fields(definitions)))
}

/// The episode named by each [`MARK`] in `bytes` after the first.
fn marks(bytes: &[u8]) -> impl Iterator<Item = EpisodeId> {
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

/// Maximum number of episodes that are distinguished in a file, and of beginnings that are examined.
const MOST: usize = 64;
/// Metadata at a beginning are smaller.
const LARGEST_ABOUT: u64 = 4 << 20;

/// The episodes of the valid chunks of a file, to determine its owner if there are several. One may be the payload of a
/// message of another, or all of them may lie in an archive.
///
/// 1. The metadata at its undamaged beginning name it.
/// 2. An episode is not the owner if it lies within a valid chunk of another.
/// 3. An episode with its own beginning in the file is embedded; one whose beginning is lost is the owner. Of several,
///    the last one: an episode embedded in a message is followed by the rest of the outer one.
/// 4. If each has its own beginning, the file is an archive, and the first is taken.
///
/// Undecidable case, in which 3. and 4. may name the inner one: the outer beginning is lost, no valid chunk of the
/// outer episode holds the inner one, and none follows it.
#[derive(Debug, Default)]
pub(super) struct Owners {
    /// By their first chunk.
    seen: Vec<Mention>,
    chunks: u64,
    /// Those that lie within a chunk of another.
    nested: Vec<EpisodeId>,
    is_unnamed: bool,
}

#[derive(Debug)]
struct Mention {
    episode: EpisodeId,
    /// Number of its last chunk.
    last: u64,
}

impl Owners {
    /// Takes a valid chunk of an episode.
    pub(super) fn add_chunk(&mut self, owner: Owner, records: &[u8]) {
        self.chunks += 1;
        let itself = if let Owner::Episode(episode) = owner { Some(episode) } else { None };
        for inner in marks(records).filter(|inner| Some(*inner) != itself) {
            if self.nested.len() < MOST && !self.nested.contains(&inner) {
                self.nested.push(inner);
            }
        }
        let Some(episode) = itself else {
            self.is_unnamed = true;
            return;
        };
        let last = self.chunks;
        if let Some(seen) = self.seen.iter_mut().find(|seen| seen.episode == episode) {
            seen.last = last;
        } else if self.seen.len() < MOST {
            self.seen.push(Mention { episode, last });
        }
    }

    /// The owner of the file. `named`: by the metadata at its beginning; `checked`: everything read so far is valid;
    /// `is_foreign`: its header names another program.
    pub(super) fn owner<R: ReadAt>(
        self,
        named: Option<EpisodeId>,
        checked: bool,
        is_foreign: bool,
        source: &mut WindowedFile<R>,
    ) -> io::Result<Owner> {
        // After damage a chunk of another episode belongs to a message; before any damage the file contradicts itself.
        let is_there = |named: &EpisodeId| self.seen.iter().any(|seen| seen.episode == *named);
        if let Some(named) = named.filter(|named| is_there(named) || !checked && !self.is_unnamed) {
            return Ok(Owner::Episode(named));
        }
        let outer: Vec<&Mention> = self.seen.iter().filter(|seen| !self.nested.contains(&seen.episode)).collect();
        if self.is_unnamed && (is_foreign || outer.is_empty()) {
            return Ok(Owner::Unnamed);
        }
        let begun = if outer.len() > 1 { beginnings(source, u64::MAX)? } else { Vec::new() };
        let is_begun = |seen: &Mention| begun.iter().any(|(_, episode)| *episode == seen.episode);
        let lost = outer.iter().filter(|seen| !is_begun(seen)).max_by_key(|seen| seen.last);
        let owner = lost.or(outer.first()).copied().or(self.seen.first());
        Ok(Owner::from(owner.map(|seen| seen.episode)))
    }
}

/// Where episodes begin that have a name of their own: magic number, header and metadata, before `end`.
pub(super) fn beginnings<R: ReadAt>(source: &mut WindowedFile<R>, end: u64) -> io::Result<Vec<(u64, EpisodeId)>> {
    let (mut at, mut begun) = (0, Vec::new());
    while at < end && begun.len() < MOST {
        let window = source.peek(at, MAGIC.len())?;
        if window.len() < MAGIC.len() {
            break;
        }
        let places = window.len() - MAGIC.len() + 1;
        let is_magic = |place: &usize| window.get(*place..).is_some_and(|bytes| bytes.starts_with(&MAGIC));
        let Some(place) = (0..places).find(is_magic) else {
            at += places as u64;
            continue;
        };
        at += place as u64;
        begun.extend(beginning(source, at)?.map(|episode| (at, episode)));
        at += MAGIC.len() as u64;
    }
    Ok(begun)
}

/// The episode that begins at `at`.
fn beginning<R: ReadAt>(source: &mut WindowedFile<R>, at: u64) -> io::Result<Option<EpisodeId>> {
    let mut content = Vec::new();
    let mut at = at + MAGIC.len() as u64;
    for wanted in [op::HEADER, op::METADATA] {
        let mut head = Fields(source.peek(at, 9)?);
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { return Ok(None) };
        let largest = if wanted == op::HEADER { LARGEST_HEADER } else { LARGEST_ABOUT };
        if opcode != wanted || length > largest || !source.read(at + HEAD, length, &mut content)? {
            return Ok(None);
        }
        if wanted == op::HEADER && writer(&content) != Writer::Rapid {
            return Ok(None);
        }
        at += HEAD + length;
    }
    Ok(about(&content).and_then(|about| EpisodeId::from_metadata(&about)))
}
