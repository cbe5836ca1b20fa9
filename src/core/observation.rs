//! Observations: which sample of each modality belongs to a tick of the observation grid.
//!
//! [`crate::sync`] chooses the samples. Owns the layout in which an observation is published on [`OBSERVATION_TOPIC`].
//!
//! Invariant: the size of an observation depends on what is registered, never on what is plugged in.

use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::time::Stamp;

/// Topic on which observations are published on the bus.
pub const OBSERVATION_TOPIC: &str = "/rapid/observation";
/// Bytes of a published observation before its slots: the mask.
pub const HEAD_BYTES: usize = 8;
/// Bytes of a published slot.
pub const SLOT_BYTES: usize = 24;

/// [`ObservationSlot::present`] in a published slot.
const PRESENT: u32 = 1;
/// [`ObservationSlot::valid`].
const VALID: u32 = 2;
/// [`ObservationSlot::stale`].
const STALE: u32 = 4;
/// [`ObservationSlot::seq`] is known.
const CHOSEN: u32 = 8;
/// [`ObservationSlot::plugged`].
const PLUGGED: u32 = 16;

/// One modality of an observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(clippy::struct_excessive_bools, reason = "each is a flag of the published slot")]
pub struct ObservationSlot {
    /// The modality.
    pub id: ModalityId,
    /// Its device is plugged in at the tick, whether it runs or not.
    pub plugged: bool,
    /// Its bit in the mask at the tick.
    pub present: bool,
    /// A sample lies in the window of the tick.
    pub valid: bool,
    /// Present, and no sample lies in the window.
    pub stale: bool,
    /// The tick minus the moment that the chosen sample stands for (its capture time less the
    /// latency of the modality), ns; negative for one after the tick; 0 without a sample.
    pub age_ns: i64,
    /// Sequence number of the chosen sample; `None`: the modality must be filled with zeros.
    pub seq: Option<u64>,
    /// Where the chosen sample lies in its modality's ring; good until the next push.
    pub handle: Option<usize>,
}

impl ObservationSlot {
    pub(crate) fn clear(&mut self, present: bool, plugged: bool) {
        *self = Self { plugged, present, ..Self::empty(self.id) };
    }

    /// Names the sample `seq`, which stands for the moment `shown`.
    pub(crate) fn hold(&mut self, handle: usize, seq: u64, tick: Stamp, shown: Stamp) {
        let age = i128::from(tick.0) - i128::from(shown.0);
        self.age_ns = i64::try_from(age).unwrap_or(if age < 0 { i64::MIN } else { i64::MAX });
        self.seq = Some(seq);
        self.handle = Some(handle);
    }

    fn decode(bytes: &[u8; SLOT_BYTES]) -> Option<Self> {
        let (words, numbers) = bytes.split_at_checked(8)?;
        let ([bit, flags], [seq, age]) = (words.as_chunks().0, numbers.as_chunks().0) else { return None };
        let (bit, flags) = (u32::from_le_bytes(*bit), u32::from_le_bytes(*flags));
        Some(Self {
            id: ModalityId::new(u8::try_from(bit).ok()?)?,
            plugged: flags & PLUGGED != 0,
            present: flags & PRESENT != 0,
            valid: flags & VALID != 0,
            stale: flags & STALE != 0,
            age_ns: i64::from_le_bytes(*age),
            seq: (flags & CHOSEN != 0).then_some(u64::from_le_bytes(*seq)),
            handle: None,
        })
    }

    /// Nothing of a modality.
    pub fn empty(id: ModalityId) -> Self {
        Self { id, plugged: false, present: false, valid: false, stale: false, age_ns: 0, seq: None, handle: None }
    }
}

/// What one tick of the observation grid saw, in dimensions that do not depend on what is plugged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Observation {
    /// The tick.
    pub tick: Stamp,
    /// The mask in force at the tick.
    pub mask: PhysicalMask,
    /// One a registered modality, in the order of registration.
    pub slots: Vec<ObservationSlot>,
}

impl Observation {
    /// Of these modalities, with nothing seen.
    pub fn new(ids: &[ModalityId]) -> Self {
        Self {
            tick: Stamp::default(),
            mask: PhysicalMask::EMPTY,
            slots: ids.iter().map(|id| ObservationSlot::empty(*id)).collect(),
        }
    }

    /// Its published form: the mask (u64), and of each slot bit (u32), flags (u32), sequence number (u64) and age in ns
    /// (i64), little endian. Flags: 1 present, 2 valid, 4 stale, 8 a sample is chosen, without which the last two
    /// numbers are 0, 16 plugged in. Replaces what `out` holds; does not allocate if it has the capacity.
    pub fn encode(&self, out: &mut Vec<u8>) {
        out.clear();
        out.extend_from_slice(&self.mask.0.to_le_bytes());
        for slot in &self.slots {
            let flag = |is_set: bool, flag: u32| if is_set { flag } else { 0 };
            let flags = flag(slot.present, PRESENT)
                | flag(slot.valid, VALID)
                | flag(slot.stale, STALE)
                | flag(slot.seq.is_some(), CHOSEN)
                | flag(slot.plugged, PLUGGED);
            out.extend_from_slice(&u32::from(slot.id.bit()).to_le_bytes());
            out.extend_from_slice(&flags.to_le_bytes());
            out.extend_from_slice(&slot.seq.unwrap_or(0).to_le_bytes());
            out.extend_from_slice(&slot.age_ns.to_le_bytes());
        }
    }

    /// Reads the published form of the observation of `tick`; `None` if the bytes are not an observation.
    pub fn decode(tick: Stamp, bytes: &[u8]) -> Option<Self> {
        let (mask, slots) = bytes.split_first_chunk()?;
        let (slots, []) = slots.as_chunks::<SLOT_BYTES>() else { return None };
        let slots = slots.iter().map(ObservationSlot::decode).collect::<Option<_>>()?;
        Some(Self { tick, mask: PhysicalMask(u64::from_le_bytes(*mask)), slots })
    }

    /// The slot of a modality.
    pub fn slot(&self, id: ModalityId) -> Option<&ObservationSlot> {
        self.slots.iter().find(|slot| slot.id == id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_published_observation_has_the_documented_layout() {
        let ids: Vec<_> = [0, 5].into_iter().filter_map(ModalityId::new).collect();
        let mut observation = Observation::new(&ids);
        observation.mask = PhysicalMask(0x21);
        observation.slots[0].clear(true, false);
        observation.slots[0].valid = true;
        observation.slots[0].hold(3, 7, Stamp(100), Stamp(102));
        observation.slots[1].clear(true, true);
        observation.slots[1].stale = true;
        let mut bytes = vec![9];
        observation.encode(&mut bytes);
        let slot = |bit: u32, flags: u32, seq: u64, age: i64| {
            [&bit.to_le_bytes()[..], &flags.to_le_bytes(), &seq.to_le_bytes(), &age.to_le_bytes()].concat()
        };
        let expected = [&0x21_u64.to_le_bytes()[..], &slot(0, 1 | 2 | 8, 7, -2), &slot(5, 1 | 4 | 16, 0, 0)].concat();
        assert_eq!(bytes, expected);
        assert_eq!(bytes.len(), HEAD_BYTES + 2 * SLOT_BYTES);

        // The place in a ring is of the process that published it.
        observation.tick = Stamp(100);
        observation.slots[0].handle = None;
        assert_eq!(Observation::decode(Stamp(100), &bytes), Some(observation));
        assert_eq!(Observation::decode(Stamp(100), &bytes[..bytes.len() - 1]), None);
        bytes[HEAD_BYTES] = 64;
        assert_eq!(Observation::decode(Stamp(100), &bytes), None);
        assert_eq!(Observation::decode(Stamp(100), b""), None);
    }
}
