//! When a modality's device was plugged in, whether its node ran or not.
//!
//! The mask does not tell a device that is not there from one that never starts; events do.
//!
//! Invariant: memory grows with how often it is plugged in and out, with nothing else.

use super::presence::Presence;
use crate::modality::ModalityId;

/// See the module's comment.
#[derive(Debug, Default)]
pub(super) struct Plugged {
    /// Moment and new state, ascending, never twice the same state.
    edges: Vec<(u64, bool)>,
}

/// Over an episode, ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Time {
    /// Plugged in.
    pub(super) plugged_ns: u64,
    /// Longest plugged in with the bit of the mask not set.
    pub(super) idle_ns: u64,
}

impl Plugged {
    /// Takes that it was plugged in or out.
    pub(super) fn push(&mut self, at_ns: u64, there: bool) {
        let (last, state) = self.edges.last().copied().unwrap_or((0, false));
        if state != there {
            self.edges.push((at_ns.max(last), there));
        }
    }

    /// What it comes to from `begin_ns` to `end_ns`.
    pub(super) fn time(&self, presence: &Presence, id: ModalityId, begin_ns: u64, end_ns: u64) -> Time {
        let mut time = Time::default();
        for (index, (at, there)) in self.edges.iter().enumerate() {
            let from = (*at).max(begin_ns);
            let to = self.edges.get(index + 1).map_or(end_ns, |(next, _)| *next).min(end_ns);
            if !there || from >= to {
                continue;
            }
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
