//! A lease: for how long a device on the network counts as there after it was last heard of.
//!
//! Nothing on a network says that a cable was pulled somewhere. What was heard of within the lease is
//! there; what was not is gone, unless something better said so before: a goodbye, or the link.
//!
//! Invariant: pure; each change is told once, arrivals and departures in turn.

use std::time::Duration;

use crate::time::Stamp;

/// A change that was noticed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Change {
    /// It is there.
    Came,
    /// It is not there any more.
    Went,
}

/// See the module's comment.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lease {
    length: Duration,
    /// When it was last heard of, while it is there.
    heard: Option<Stamp>,
    /// What is older than this says nothing: it was told gone after that.
    gone: Stamp,
}

impl Lease {
    pub(super) fn new(length: Duration) -> Self {
        Self { length, heard: None, gone: Stamp::default() }
    }

    pub(super) const fn is_there(&self) -> bool {
        self.heard.is_some()
    }

    /// Something of it was heard at `when`.
    pub(super) fn heard(&mut self, when: Stamp) -> Option<Change> {
        let came = self.heard.is_none();
        if came && when < self.gone {
            return None;
        }
        self.heard = self.heard.max(Some(when));
        came.then_some(Change::Came)
    }

    /// When the lease ends if nothing more is heard; never while it is not there.
    pub(super) fn ends(&self) -> Option<Stamp> {
        Some(self.heard?.after(self.length))
    }

    /// Is the lease over?
    pub(super) fn look(&mut self, now: Stamp) -> Option<Change> {
        if self.ends()? > now { None } else { self.end(now) }
    }

    /// It is known to be gone.
    pub(super) fn end(&mut self, now: Stamp) -> Option<Change> {
        self.heard.take()?;
        self.gone = now;
        Some(Change::Went)
    }
}

#[cfg(test)]
mod tests;
