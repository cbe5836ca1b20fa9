//! Whose file it is in which chunks of several episodes lie: one may be the payload of a message of another, or all of
//! them lie in an archive.
//!
//! 1. The metadata at its undamaged beginning name it.
//! 2. An episode is not the file if it lies within a right chunk of another.
//! 3. An episode that has its own beginning in the file lies in it; one whose beginning is lost is the file. Of several
//!    it is the last: what lies in a message of an episode is followed by the rest of that episode.
//! 4. If each has its own, the file is an archive, and the first is taken.
//!
//! Not decidable, and then 3. and 4. may name the inner one: the outer beginning is lost, no right chunk of the outer
//! episode holds the inner one, and none follows it.

use std::io;

use super::header::{self, Writer};
use super::op;
use super::own::{self, EpisodeId, Owner};
use super::source::{ReadAt, Source};
use super::walk::{HEAD, MAGIC};
use super::wire::Fields;

/// Episodes that are distinguished in a file, and beginnings that are looked at.
const MOST: usize = 64;
/// Metadata at a beginning have less.
const LARGEST: u64 = 4 << 20;

/// The episodes of the right chunks of a file.
#[derive(Debug, Default)]
pub(super) struct Owners {
    /// By their first chunk.
    seen: Vec<Seen>,
    /// Chunks so far.
    chunks: u64,
    /// Those that lie within a chunk of another.
    nested: Vec<EpisodeId>,
    is_unnamed: bool,
}

#[derive(Debug)]
struct Seen {
    episode: EpisodeId,
    /// Number of its last chunk.
    last: u64,
}

impl Owners {
    /// Takes a right chunk of an episode.
    pub(super) fn take(&mut self, owner: Owner, records: &[u8]) {
        self.chunks += 1;
        let itself = if let Owner::Episode(episode) = owner { Some(episode) } else { None };
        for inner in own::marks(records).filter(|inner| Some(*inner) != itself) {
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
            self.seen.push(Seen { episode, last });
        }
    }

    /// Whose file it is. `named`: what the metadata at its beginning name; `checked`: what was read so far is right;
    /// `is_foreign`: its header names another program.
    pub(super) fn owner<R: ReadAt>(
        self,
        named: Option<EpisodeId>,
        checked: bool,
        is_foreign: bool,
        source: &mut Source<R>,
    ) -> io::Result<Owner> {
        // Behind damage a chunk of another episode is a message's; before any it is the file's, which contradicts itself.
        let is_there = |named: &EpisodeId| self.seen.iter().any(|seen| seen.episode == *named);
        if let Some(named) = named.filter(|named| is_there(named) || !checked && !self.is_unnamed) {
            return Ok(Owner::Episode(named));
        }
        let outer: Vec<&Seen> = self.seen.iter().filter(|seen| !self.nested.contains(&seen.episode)).collect();
        if self.is_unnamed && (is_foreign || outer.is_empty()) {
            return Ok(Owner::Unnamed);
        }
        let begun = if outer.len() > 1 { beginnings(source, u64::MAX)? } else { Vec::new() };
        let is_begun = |seen: &Seen| begun.iter().any(|(_, episode)| *episode == seen.episode);
        let lost = outer.iter().filter(|seen| !is_begun(seen)).max_by_key(|seen| seen.last);
        let owner = lost.or(outer.first()).copied().or(self.seen.first());
        Ok(Owner::of(owner.map(|seen| seen.episode)))
    }
}

/// Where episodes begin that have a name of their own: magic number, header and metadata, before `end`.
pub(super) fn beginnings<R: ReadAt>(source: &mut Source<R>, end: u64) -> io::Result<Vec<(u64, EpisodeId)>> {
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
fn beginning<R: ReadAt>(source: &mut Source<R>, at: u64) -> io::Result<Option<EpisodeId>> {
    let mut content = Vec::new();
    let mut at = at + MAGIC.len() as u64;
    for wanted in [op::HEADER, op::METADATA] {
        let mut head = Fields(source.peek(at, 9)?);
        let (Some(opcode), Some(length)) = (head.u8(), head.u64()) else { return Ok(None) };
        let largest = if wanted == op::HEADER { header::LARGEST } else { LARGEST };
        if opcode != wanted || length > largest || !source.read(at + HEAD, length, &mut content)? {
            return Ok(None);
        }
        if wanted == op::HEADER && header::writer(&content) != Writer::Rapid {
            return Ok(None);
        }
        at += HEAD + length;
    }
    Ok(own::about(&content).and_then(|about| EpisodeId::of(&about)))
}
