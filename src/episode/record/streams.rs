//! All streams, recording or not: the last sample of each, and the recent masks.

use rapid_bus::TopicId;
use rapid_core::mask::Bits;
use rapid_core::modality::MAX_MODALITIES;
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;

use super::hole::Last;
use super::mask_history::MaskHistory;
use super::open_episode::OpenEpisode;

/// What is kept of all samples, recording or not.
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

    /// Takes a sample, for `open` too if there is one.
    pub(super) fn receive(
        &mut self,
        open: Option<&mut OpenEpisode>,
        topic: TopicId,
        header: &SampleHeader,
        payload: &[u8],
    ) {
        match topic {
            TopicId::Modality(id) => {
                let now = Last { seq: header.seq, lost: header.lost, captured: Stamp(header.capture_ns) };
                let hole = self.last.get_mut(id.index()).and_then(|last| last.replace(now)?.hole(now));
                if let Some(open) = open {
                    open.sample(id, header, payload, hole);
                }
            }
            // The frames of an episode are its own: they also know samples that were in transit at a tick.
            TopicId::Observation => {}
            TopicId::Action => {
                let now = Last { seq: header.seq, lost: header.lost, captured: Stamp(header.capture_ns) };
                let hole = self.last_action.replace(now).and_then(|last| last.hole(now));
                if let Some(open) = open {
                    open.action(header, payload, hole);
                }
            }
            TopicId::Mask => {
                let Some((bits, sequence)) = Bits::of_payload(payload) else { return };
                let now = Last { seq: sequence, lost: 0, captured: Stamp(header.capture_ns) };
                let hole = self.last_mask.replace(now).and_then(|last| last.hole(now));
                self.masks.push(header, bits, sequence);
                if let Some(open) = open {
                    open.mask(header, bits, sequence, hole);
                }
            }
        }
    }
}
