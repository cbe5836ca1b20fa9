//! When each modality was there, by the mask.
//!
//! Invariant: memory grows with the changes of the mask, not with its publications.

use crate::mask::PhysicalMask;
use crate::modality::ModalityId;

/// The mask from `begin_ns` on.
#[derive(Debug)]
pub(super) struct Presence {
    begin_ns: u64,
    /// Moment and value of the first mask known and of every change, ascending.
    edges: Vec<(u64, PhysicalMask)>,
}

impl Presence {
    pub(super) fn new(begin_ns: u64) -> Self {
        Self { begin_ns, edges: Vec::with_capacity(64) }
    }

    /// Takes a publication; one of before the beginning counts from the beginning.
    pub(super) fn push(&mut self, at_ns: u64, mask: PhysicalMask) {
        let last = self.edges.last();
        if last.is_some_and(|(_, last)| *last == mask) {
            return;
        }
        let earliest = last.map_or(self.begin_ns, |(at, _)| *at);
        self.edges.push((at_ns.max(earliest), mask));
    }

    /// Is anything known of the mask?
    pub(super) fn is_known(&self) -> bool {
        !self.edges.is_empty()
    }

    /// The spans between `from` and `to` in which the bit of `id` was set, ascending, none empty.
    /// Before the first mask nothing is known to be there.
    pub(super) fn spans(&self, id: ModalityId, from: u64, to: u64) -> impl Iterator<Item = (u64, u64)> {
        // The edge in force at `from` is the last one at or before it.
        let first = self.edges.partition_point(|(at, _)| *at <= from).saturating_sub(1);
        // None behind `to` is looked at: the work for spans that do not overlap is bounded by the number of edges.
        let end = self.edges.partition_point(|(at, _)| *at < to).max(first);
        let edges = self.edges.get(first..end).unwrap_or_default();
        let mut index = 0;
        std::iter::from_fn(move || {
            while edges.get(index).is_some_and(|(_, mask)| !mask.contains(id)) {
                index += 1;
            }
            let (begin, _) = edges.get(index)?;
            while edges.get(index).is_some_and(|(_, mask)| mask.contains(id)) {
                index += 1;
            }
            let end = edges.get(index).map_or(to, |(at, _)| *at);
            Some(((*begin).max(from), end.min(to)))
        })
        .take_while(move |(begin, _)| *begin < to)
        .filter(|(begin, end)| begin < end)
    }
}
