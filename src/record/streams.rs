//! What passes by, recording or not: how far each stream has come, and the mask of late.

use super::hole::Last;
use super::masks::MaskHistory;
use super::session::Session;
use crate::bus::TopicId;
use crate::mask::PhysicalMask;
use crate::modality::MAX_MODALITIES;
use crate::sample::SampleHeader;
use crate::time::Stamp;

/// What is kept of the samples that pass, recording or not.
pub(super) struct Streams {
    /// The last publications of the mask.
    pub(super) masks: MaskHistory,
    /// The last sample of each modality.
    last: [Option<Last>; MAX_MODALITIES],
    last_mask: Option<Last>,
    last_action: Option<Last>,
}

impl Streams {
    pub(super) fn new() -> Self {
        Self { masks: MaskHistory::new(), last: [None; MAX_MODALITIES], last_mask: None, last_action: None }
    }

    /// Takes a sample, for `session` too if there is one.
    pub(super) fn take(
        &mut self,
        session: Option<&mut Session>,
        topic: TopicId,
        header: &SampleHeader,
        payload: &[u8],
    ) {
        match topic {
            TopicId::Modality(id) => {
                let now = Last { seq: header.seq, lost: header.lost, captured: Stamp(header.capture_ns) };
                let hole = self.last.get_mut(id.index()).and_then(|last| last.replace(now)?.hole(now));
                if let Some(session) = session {
                    session.sample(id, header, payload, hole);
                }
            }
            TopicId::Action => {
                let now = Last { seq: header.seq, lost: header.lost, captured: Stamp(header.capture_ns) };
                let hole = self.last_action.replace(now).and_then(|last| last.hole(now));
                if let Some(session) = session {
                    session.action(header, payload, hole);
                }
            }
            TopicId::Mask => {
                let Some((mask, sequence)) = read_mask(payload) else { return };
                let now = Last { seq: sequence, lost: 0, captured: Stamp(header.capture_ns) };
                let hole = self.last_mask.replace(now).and_then(|last| last.hole(now));
                self.masks.push(header, mask, sequence);
                if let Some(session) = session {
                    session.mask(header, mask, sequence, hole);
                }
            }
        }
    }
}

fn read_mask(payload: &[u8]) -> Option<(PhysicalMask, u64)> {
    let (mask, rest) = payload.split_first_chunk()?;
    let (sequence, _) = rest.split_first_chunk()?;
    Some((PhysicalMask(u64::from_le_bytes(*mask)), u64::from_le_bytes(*sequence)))
}
