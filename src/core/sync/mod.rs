//! Synchronisation: which sample of each modality belongs to a tick of the observation grid.
//!
//! Owns the rings of recent samples and the rules by which one is chosen; samples go in by
//! [`Synchronizer::push`] in any order, an [`Observation`] comes out per tick. The recorder's frame
//! index, a policy and the observations on the bus use the same code, each on a [`Grid`] of its own.
//!
//! Invariant: pure: no clock, no input or output; the caller passes the time.
//! Invariant: the result depends on which samples are in the rings, never on the order or the
//! moments in which they were pushed.
//! Invariant: nothing here allocates after construction, except for a modality that is added.

mod grid;
#[cfg(test)]
mod tests;

use std::time::Duration;

use crate::mask::Bits;
use crate::modality::{MAX_MODALITIES, ModalityId};
use crate::observation::{Observation, ObservationSlot};
use crate::sample::Epoch;
use crate::time::{Stamp, nanoseconds};

pub use grid::Grid;

/// What an observation holds for an attached modality without a sample in the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum WhenStale {
    /// The newest sample with its age.
    #[default]
    Hold,
    /// Nothing.
    Zero,
}

crate::words! {
    /// Every policy and its name.
    WhenStale, 2: "hold" = Hold, "zero" = Zero;
}

/// A modality as the synchroniser needs to know it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncModality {
    /// Its number.
    pub id: ModalityId,
    /// What an observation holds when it is attached but no sample lies in the window.
    pub when_stale: WhenStale,
    /// From an event to the capture time of the sample that shows it.
    pub latency: Duration,
    /// Samples kept, at least 1: those of the longest time between a sample's capture and the
    /// evaluation of the last tick that may want it.
    pub capacity: usize,
}

/// See the module's comment.
///
/// A sample stands for a moment: its capture time less the latency of its modality. All that
/// follows is about that moment, so that sensors of different latency show the same instant.
///
/// The rules, for a tick and a moment `now` at which it is evaluated:
///
/// 1. A sample counts only if it was received by `now` and stands for no later moment.
/// 2. A sample of an older epoch than the newest one of which a sample that counts by rule 1 lies
///    before the end of the window does not count: what was seen before the device was last
///    attached is not evidence of what is attached. A replug later than that is another tick's:
///    who looks back at a tick sees what was to be seen at it.
/// 3. Bit clear in the mask: absent. Not valid, not stale, nothing kept, whatever the ring holds.
/// 4. Bit set: of the samples that count, the one nearest to the tick is chosen if it lies
///    within the window (both ends included); of two equally near the earlier, then the one of the
///    lower sequence number. Valid.
/// 5. Bit set, nothing in the window: stale, not valid. `Hold` gives the newest sample at or
///    before the tick, if there is one; `Zero` gives none.
#[derive(Debug)]
pub struct Synchronizer<T> {
    window_ns: u64,
    lanes: Vec<Lane<T>>,
    /// Position in `lanes` of each modality.
    lane_of: [Option<usize>; MAX_MODALITIES],
    observation: Observation,
}

#[derive(Debug)]
struct Lane<T> {
    when_stale: WhenStale,
    latency_ns: u64,
    ring: Ring<T>,
}

impl<T> Synchronizer<T> {
    /// A synchroniser with empty rings. `window` is the half width: 25 ms means within +-25 ms. Of
    /// a modality given twice only the first counts.
    pub fn new(modalities: &[SyncModality], window: Duration) -> Self {
        let mut lane_of = [None; MAX_MODALITIES];
        let mut lanes = Vec::with_capacity(modalities.len());
        let mut ids = Vec::with_capacity(modalities.len());
        for modality in modalities {
            let lane = &mut lane_of[modality.id.index()];
            if lane.is_none() {
                *lane = Some(lanes.len());
                lanes.push(Lane::new(modality));
                ids.push(modality.id);
            }
        }
        Self { window_ns: nanoseconds(window), lanes, lane_of, observation: Observation::new(&ids) }
    }

    /// Adds a modality, without samples, before the first with a higher bit; one that is there already stays as it is.
    pub fn add(&mut self, modality: &SyncModality) {
        if self.lane_of[modality.id.index()].is_some() {
            return;
        }
        let slots = &mut self.observation.slots;
        let at = slots.iter().position(|slot| slot.id > modality.id).unwrap_or(slots.len());
        slots.insert(at, ObservationSlot::empty(modality.id));
        self.lanes.insert(at, Lane::new(modality));
        for (lane, slot) in slots.iter().enumerate() {
            self.lane_of[slot.id.index()] = Some(lane);
        }
    }

    /// Keeps a sample of a modality; the oldest one pushed makes room. Samples of a modality that
    /// is not registered are not kept. A sample known to be damaged is not to be pushed.
    pub fn push(&mut self, id: ModalityId, sample: SyncSample<T>) {
        if let Some(lane) = self.lane_of[id.index()].and_then(|lane| self.lanes.get_mut(lane)) {
            lane.ring.push(sample);
        }
    }

    /// Chooses the samples of `tick` by what was known at `now`, under the mask in force at the
    /// tick.
    pub fn observe(&mut self, tick: Stamp, now: Stamp, bits: impl Into<Bits>) -> &Observation {
        let Bits { mask, plugged } = bits.into();
        self.observation.tick = tick;
        self.observation.mask = mask;
        for (lane, slot) in self.lanes.iter().zip(&mut self.observation.slots) {
            let present = mask.contains(slot.id);
            slot.clear(present, plugged.contains(slot.id));
            if present {
                lane.choose(tick, now, self.window_ns, slot);
            }
        }
        &self.observation
    }

    /// The last observation.
    pub fn observation(&self) -> &Observation {
        &self.observation
    }

    /// The sample a slot of the last observation names, until the next push.
    pub fn sample(&self, slot: &ObservationSlot) -> Option<&SyncSample<T>> {
        let lane = self.lanes.get(self.lane_of[slot.id.index()]?)?;
        lane.ring.get(slot.handle?)
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        for lane in &mut self.lanes {
            lane.ring.clear();
        }
    }
}

impl<T> Lane<T> {
    fn new(modality: &SyncModality) -> Self {
        Self {
            when_stale: modality.when_stale,
            latency_ns: nanoseconds(modality.latency),
            ring: Ring::new(modality.capacity),
        }
    }

    fn choose(&self, tick: Stamp, now: Stamp, window_ns: u64, slot: &mut ObservationSlot) {
        // The moment a sample stands for.
        let shown = |s: &SyncSample<T>| Stamp(s.capture.0.saturating_sub(self.latency_ns));
        let known = || self.ring.iter().filter(move |(_, s)| s.recv <= now && shown(s) <= now);
        let reach = Stamp(tick.0.saturating_add(window_ns));
        let epoch = known().filter(|(_, s)| shown(s) <= reach).map(|(_, s)| s.epoch).max().unwrap_or(Epoch(0));
        let current = || known().filter(move |(_, s)| s.epoch == epoch);

        let distance = |s: &SyncSample<T>| shown(s).0.abs_diff(tick.0);
        let nearest =
            current().filter(|(_, s)| distance(s) <= window_ns).min_by_key(|(_, s)| (distance(s), shown(s), s.seq));
        if let Some((handle, sample)) = nearest {
            slot.valid = true;
            slot.hold(handle, sample.seq, tick, shown(sample));
            return;
        }
        slot.stale = true;
        if self.when_stale == WhenStale::Zero {
            return;
        }
        let newest =
            current().filter(|(_, s)| shown(s) <= tick).max_by_key(|(_, s)| (shown(s), std::cmp::Reverse(s.seq)));
        if let Some((handle, sample)) = newest {
            slot.hold(handle, sample.seq, tick, shown(sample));
        }
    }
}

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

/// The ring of recent samples of one modality: never more than its capacity.
#[derive(Debug)]
pub struct Ring<T> {
    samples: Vec<SyncSample<T>>,
    capacity: usize,
    /// Where the next sample is stored once the ring is full: the oldest one's place.
    next: usize,
}

impl<T> Ring<T> {
    /// An empty ring of room for `capacity` samples, at least 1.
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
    pub fn iter(&self) -> impl Iterator<Item = (usize, &SyncSample<T>)> {
        self.samples.iter().enumerate()
    }

    /// The sample of a handle.
    pub fn get(&self, handle: usize) -> Option<&SyncSample<T>> {
        self.samples.get(handle)
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
        self.next = 0;
    }
}
