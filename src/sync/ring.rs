//! The ring of recent samples of one modality.
//!
//! Invariant: never more than its capacity, never allocates after construction.

use super::observation::Handle;
use crate::sample::Epoch;
use crate::time::Stamp;

/// A sample as the synchroniser sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncSample<T> {
    /// When it was captured.
    pub capture: Stamp,
    /// When it was received.
    pub recv: Stamp,
    /// Its sequence number.
    pub seq: u64,
    /// Incarnation of the attachment it comes from.
    pub epoch: Epoch,
    /// What the user of the synchroniser keeps with it: the payload, a handle to it, or nothing.
    pub keep: T,
}

/// See the module's comment.
#[derive(Debug)]
pub struct Ring<T> {
    samples: Vec<SyncSample<T>>,
    capacity: usize,
    /// Where the next sample goes once the ring is full: the oldest one.
    next: usize,
}

impl<T> Ring<T> {
    /// An empty ring of room for `capacity` samples, at least 1.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        let capacity = capacity.max(1);
        Self { samples: Vec::with_capacity(capacity), capacity, next: 0 }
    }

    /// Keeps a sample in place of the oldest one pushed, if there is no room.
    pub fn push(&mut self, sample: SyncSample<T>) {
        if self.samples.len() < self.capacity {
            self.samples.push(sample);
            return;
        }
        if let Some(oldest) = self.samples.get_mut(self.next) {
            *oldest = sample;
        }
        self.next = (self.next + 1) % self.capacity;
    }

    /// All samples kept, in no particular order.
    pub fn iter(&self) -> impl Iterator<Item = (Handle, &SyncSample<T>)> {
        self.samples.iter().enumerate().map(|(at, sample)| (Handle(at), sample))
    }

    /// The sample of a handle.
    #[must_use]
    pub fn get(&self, handle: Handle) -> Option<&SyncSample<T>> {
        self.samples.get(handle.0)
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
        self.next = 0;
    }
}
