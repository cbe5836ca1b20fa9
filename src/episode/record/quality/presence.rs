//! When each modality was present by the mask, and when its device was plugged in.
//!
//! Invariant: pure; a span of presence counts from the publication of the mask that sets the bit to the one that clears
//! it.

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;

/// When each modality was present, by the mask from `begin_ns` on. Memory grows with the changes of the mask, not with
/// its publications.
#[derive(Debug)]
pub(super) struct PresenceHistory {
    begin_ns: u64,
    /// Moment and value of the first mask known and of every change, ascending.
    edges: Vec<(u64, PhysicalMask)>,
}

impl PresenceHistory {
    pub(super) fn new(begin_ns: u64) -> Self {
        Self { begin_ns, edges: Vec::with_capacity(64) }
    }

    /// Takes a publication; an earlier one counts from the beginning.
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

    /// The time between `from` and `to` in which the bit of `id` was set; all of it without a mask.
    pub(super) fn time(&self, id: ModalityId, from: u64, to: u64) -> u64 {
        if !self.is_known() {
            return to.saturating_sub(from);
        }
        self.spans(id, from, to).map(|(begin, end)| end - begin).sum()
    }

    /// The longest time between `from` and `to` in which the bit of `id` was set; all of it without a mask.
    pub(super) fn longest(&self, id: ModalityId, from: u64, to: u64) -> u64 {
        if !self.is_known() {
            return to.saturating_sub(from);
        }
        self.spans(id, from, to).map(|(begin, end)| end - begin).max().unwrap_or(0)
    }

    /// The spans between `from` and `to` in which the bit of `id` was set, ascending, none empty.
    /// Before the first mask nothing counts as present.
    fn spans(&self, id: ModalityId, from: u64, to: u64) -> impl Iterator<Item = (u64, u64)> {
        // The edge in force at `from` is the last one at or before it.
        let first = self.edges.partition_point(|(at, _)| *at <= from).saturating_sub(1);
        // Edges after `to` are skipped: the work for disjoint spans is bounded by the number of edges.
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

/// Since when something is there or not, as events say it: whether a device is plugged in, whether it records by itself.
///
/// When a modality's device was plugged in, whether its node ran or not. In the mask an absent device looks like one that
/// never starts; events distinguish them. Memory grows with how often it is plugged in and out.
#[derive(Debug, Default)]
pub(super) struct Plugged {
    /// Moment and new state, ascending, never twice the same state.
    edges: Vec<(u64, bool)>,
}

/// Over an episode, ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Time {
    pub(super) plugged_ns: u64,
    /// Longest plugged in with the bit of the mask not set.
    pub(super) idle_ns: u64,
}

impl Plugged {
    /// Records that it was plugged in or out.
    pub(super) fn push(&mut self, at_ns: u64, there: bool) {
        let (last, state) = self.edges.last().copied().unwrap_or((0, false));
        if state != there {
            self.edges.push((at_ns.max(last), there));
        }
    }

    /// When it was there between `begin_ns` and `end_ns`, ascending.
    fn spans(&self, begin_ns: u64, end_ns: u64) -> impl Iterator<Item = (u64, u64)> {
        let span = move |(index, (at, there)): (usize, &(u64, bool))| {
            let from = (*at).max(begin_ns);
            let to = self.edges.get(index + 1).map_or(end_ns, |(next, _)| *next).min(end_ns);
            (*there && from < to).then_some((from, to))
        };
        self.edges.iter().enumerate().filter_map(span)
    }

    /// How long it was there between `begin_ns` and `end_ns`, ns.
    pub(super) fn total(&self, begin_ns: u64, end_ns: u64) -> u64 {
        self.spans(begin_ns, end_ns).map(|(from, to)| to - from).sum()
    }

    /// The times from `begin_ns` to `end_ns`.
    pub(super) fn time(&self, presence: &PresenceHistory, id: ModalityId, begin_ns: u64, end_ns: u64) -> Time {
        let mut time = Time::default();
        for (from, to) in self.spans(begin_ns, end_ns) {
            time.plugged_ns += to - from;
            let mut ran_until = from;
            for (begin, end) in presence.spans(id, from, to) {
                time.idle_ns = time.idle_ns.max(begin - ran_until);
                ran_until = end;
            }
            time.idle_ns = time.idle_ns.max(to - ran_until);
        }
        time
    }
}
