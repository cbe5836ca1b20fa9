//! What the previews of the selected device showed so far.
//!
//! Invariant: of fixed size, and of one device: another one begins anew.

use std::collections::VecDeque;

use rapid_core::modality::ModalityId;
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use rapid_status::preview::Preview;

use crate::tui::lidar::Sweep;
use crate::tui::picture::Picture;

/// Samples of numbers that are kept for a plot: some 15 s.
const SAMPLES: usize = 300;
/// What the previews of one device showed: of fixed size.
#[derive(Debug, Default)]
pub(super) struct Seen {
    pub(super) device: Option<ModalityId>,
    seq: Option<u64>,
    pub(super) picture: Option<Result<Picture, String>>,
    pub(super) sweep: Option<Sweep>,
    pub(super) numbers: VecDeque<(Stamp, Vec<f64>)>,
}

impl Seen {
    pub(super) fn update(&mut self, preview: &Preview) {
        if self.device != Some(preview.device) {
            *self = Self { device: Some(preview.device), ..Self::default() };
        }
        if self.seq.replace(preview.seq) == Some(preview.seq) {
            return;
        }
        self.picture = Picture::decode(preview);
        let numbers = preview.numbers();
        if !numbers.is_empty() {
            self.numbers.push_back((preview.captured, numbers));
            self.numbers.drain(..self.numbers.len().saturating_sub(SAMPLES));
        }
        if preview.encoding == Encoding::Bytes {
            let mut sweep = self.sweep.take().unwrap_or_default();
            self.sweep = sweep.feed(&preview.payload).then_some(sweep);
        }
    }
}
