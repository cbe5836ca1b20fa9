//! Which chunks belong to the episode of a file, as its records are read: see [`own`](super::own).

use std::io;

use super::BOOT_ID;
use super::chunk::{Records, first_record};
use super::episode_id::{EpisodeId, about};
use super::integrity::Writer;
use super::op;
use super::own::{Owner, beginnings, first};
use super::record_iter::RecordIter;
use super::source::ReadAt;
use super::wire::Fields;

impl<R: ReadAt> RecordIter<R> {
    /// The episode that the chunks shown so far belong to; `None` also if they name none.
    pub(crate) fn episode(&self) -> Option<EpisodeId> {
        match self.names.owner {
            Owner::Episode(episode) => Some(episode),
            Owner::Unknown | Owner::Any | Owner::Unnamed => None,
        }
    }

    /// Whether the file is an episode of ours, as far as its contents show.
    pub(super) fn is_episode(&mut self) -> io::Result<bool> {
        self.look_for_owner()?;
        Ok(matches!(self.names.owner, Owner::Episode(_) | Owner::Any))
    }

    /// Whether these records name an episode of ours.
    pub(super) fn is_owned(&self, records: &Records) -> bool {
        first(self.bytes(records)).is_some()
    }

    pub(super) fn bytes(&self, records: &Records) -> &[u8] {
        let bytes = if records.unpacked { &self.unpacked } else { &self.buffer };
        bytes.get(records.range.clone()).unwrap_or_default()
    }

    /// Learns from a valid chunk; `false` if it does not belong to this file.
    pub(super) fn learn(&mut self, records: &Records) -> io::Result<bool> {
        let owner = Owner::from(first(self.bytes(records)).map(|(episode, _)| episode));
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
            self.integrity.left_out.other_chunks += 1;
            self.checked = false;
            return Ok(false);
        }
        let bytes = if records.unpacked { &self.unpacked } else { &self.buffer };
        let bytes = bytes.get(records.range.clone()).unwrap_or_default();
        if self.names.owner == Owner::Any {
            self.names.owners.add_chunk(owner, bytes);
        }
        let mut definitions = first(bytes).map_or(Fields(&[]), |(_, definitions)| definitions);
        while let Some((opcode, data)) = first_record(&mut definitions) {
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
        // Records after damage may belong to another file.
        self.names.named = if self.checked && !self.chunked { EpisodeId::from_metadata(&about) } else { None };
    }

    /// Whether these records, found after damage, belong to this file. If no chunk names an episode, they do unless
    /// they contradict it.
    pub(super) fn is_own(&mut self, records: &Records) -> io::Result<bool> {
        let owner = Owner::from(first(self.bytes(records)).map(|(episode, _)| episode));
        self.look_for_owner()?;
        Ok(match self.names.owner {
            Owner::Any => true,
            known @ Owner::Episode(_) => known == owner,
            Owner::Unnamed if owner != Owner::Unnamed => false,
            Owner::Unnamed | Owner::Unknown => self.is_consistent(self.bytes(records)),
        })
    }

    /// Reads the file once more to determine its owner, unless that is known or was tried before.
    fn look_for_owner(&mut self) -> io::Result<()> {
        if self.names.owner != Owner::Unknown {
            return Ok(());
        }
        self.names.owner = Owner::Unnamed;
        let Some(mut records) = RecordIter::begin(self.source.again(), Some(Owner::Any))? else { return Ok(()) };
        while records.advance()? {}
        let owners = records.names.owners;
        let is_foreign = self.integrity.writer == Writer::Another;
        self.names.owner = owners.owner(self.names.named, self.checked, is_foreign, &mut self.source)?;
        Ok(())
    }

    /// Where the episode of a found chunk begins, if its beginning lies before the chunk, after other bytes.
    pub(super) fn beginning(&mut self) -> io::Result<Option<u64>> {
        let Some(episode) = self.episode() else { return Ok(None) };
        let begun = beginnings(&mut self.source, self.at)?;
        Ok(begun.into_iter().find_map(|(at, begun)| (begun == episode).then_some(at)))
    }
}
