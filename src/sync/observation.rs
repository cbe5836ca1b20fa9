//! What one tick of the observation grid saw, in dimensions that do not depend on what is plugged.
//!
//! Invariant: one slot a registered modality, in the order of registration, whatever the mask.

use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::time::Stamp;

/// Where a chosen sample lies in its modality's ring; good until the next push.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Handle(pub(super) usize);

/// One modality at one tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slot {
    /// The modality.
    pub id: ModalityId,
    /// Its bit in the mask at the tick.
    pub present: bool,
    /// A sample lies in the window of the tick.
    pub valid: bool,
    /// Present, and no sample lies in the window.
    pub stale: bool,
    /// The tick minus the moment that the sample chosen stands for (its capture time less the
    /// latency of the modality), ns; negative for one after the tick; 0 without a sample.
    pub age_ns: i64,
    /// Sequence number of the sample chosen. Without one the modality is to be filled with zeros.
    pub seq: Option<u64>,
    /// The sample chosen.
    pub handle: Option<Handle>,
}

impl Slot {
    pub(super) fn clear(&mut self, present: bool) {
        *self = Self { present, ..Self::empty(self.id) };
    }

    /// Names the sample `seq`, which stands for the moment `shown`.
    pub(super) fn hold(&mut self, handle: Handle, seq: u64, tick: Stamp, shown: Stamp) {
        let age = i128::from(tick.0) - i128::from(shown.0);
        self.age_ns = i64::try_from(age).unwrap_or(if age < 0 { i64::MIN } else { i64::MAX });
        self.seq = Some(seq);
        self.handle = Some(handle);
    }

    fn empty(id: ModalityId) -> Self {
        Self { id, present: false, valid: false, stale: false, age_ns: 0, seq: None, handle: None }
    }
}

/// One tick.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Observation {
    /// The tick.
    pub tick: Stamp,
    /// The mask in force at the tick.
    pub mask: PhysicalMask,
    /// One a registered modality, in the order of registration.
    pub slots: Vec<Slot>,
}

impl Observation {
    pub(super) fn new(ids: &[ModalityId]) -> Self {
        Self {
            tick: Stamp::default(),
            mask: PhysicalMask::EMPTY,
            slots: ids.iter().map(|id| Slot::empty(*id)).collect(),
        }
    }

    /// The slot of a modality.
    #[must_use]
    pub fn slot(&self, id: ModalityId) -> Option<&Slot> {
        self.slots.iter().find(|slot| slot.id == id)
    }
}
