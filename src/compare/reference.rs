//! Is the picture known with which a policy compared all later ones of a modality?
//!
//! It is the first one that the policy used. A recording may have begun later than that; then what it
//! computed from is unknown, though every sample of the chunk is there.

use super::survey::Survey;
use crate::policy::bundle::{Bundle, ObservationInput, ObservationSpec, Operation};
use crate::registry::Registry;

/// Of one observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reference {
    /// There is none: its pictures are looked at as they are, or it has none.
    None,
    /// The next picture is it.
    Next,
    /// It was read.
    Known,
    /// It is not in the file.
    Lost,
}

impl Reference {
    /// At the first chunk of the file, of every observation.
    pub(super) fn all(survey: &Survey, bundle: &Bundle, registry: &Registry) -> Vec<Self> {
        let whole = holds_every_chunk(survey, bundle);
        let of = |observation: &ObservationSpec| {
            let ObservationInput::Image(image) = &observation.input else { return Self::None };
            if image.operation != Some(Operation::DiffToReference) {
                return Self::None;
            }
            // With the very first sample of the run in the file, none can have been used before.
            let device = registry.named(&observation.modality);
            let first = || device.is_some_and(|device| survey.holds(&device.topic, 0));
            if whole || first() { Self::Next } else { Self::Lost }
        };
        bundle.observations.iter().map(of).collect()
    }
}

/// Was the recording there before the policy's first chunk?
fn holds_every_chunk(survey: &Survey, bundle: &Bundle) -> bool {
    let Some(chunk) = survey.chunks.first() else { return true };
    // Told when the policy is loaded.
    if survey.policy.is_some() || chunk.tick == 0 {
        return true;
    }
    let begun = chunk.observed_ns as f64 - chunk.tick as f64 * 1e9 / bundle.control_hz;
    // Half a tick is more than what is lost in these numbers, and less than a chunk takes.
    let slack = 0.5e9 / bundle.control_hz;
    survey.begin_monotonic_ns.is_some_and(|begin| begun + slack >= begin as f64)
}
