//! The brake of a joint, as its motor has to know it.

use super::{Motor, Phase};
use crate::registry::Stop;
use crate::time::Stamp;

/// What is known of a brake.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Brake {
    is_released: bool,
    is_broken: bool,
    /// When it became engaged or released.
    since: Option<Stamp>,
}

impl Motor {
    /// Takes what its brake is.
    pub(in crate::control::motors) fn take_brake(&mut self, is_released: bool, is_broken: bool, now: Stamp) {
        self.brake.is_broken = is_broken;
        if self.brake.since.is_none() || self.brake.is_released != is_released {
            (self.brake.is_released, self.brake.since) = (is_released, Some(now));
        }
    }

    /// Is its brake to be released? Not before it holds the joint itself, and no longer.
    pub(in crate::control::motors) const fn releases(&self) -> bool {
        matches!(self.phase, Phase::On | Phase::Kept(Stop::Damp | Stop::Hold))
    }

    /// It has a brake, which can be neither engaged nor released.
    pub(in crate::control::motors) const fn has_broken_brake(&self) -> bool {
        self.spec.brake.is_some() && self.brake.is_broken
    }

    /// It has a brake, which may be engaged.
    pub(super) const fn is_braked(&self) -> bool {
        self.spec.brake.is_some() && !self.brake.is_released
    }

    /// Does its brake let it turn?
    pub(in crate::control::motors) fn is_free(&self, now: Stamp) -> bool {
        let Some(spec) = &self.spec.brake else { return true };
        self.brake.is_released && self.brake.since.is_some_and(|since| now.since(since) >= spec.releases_in)
    }

    /// Does its brake hold the joint, so that its motor need not?
    pub(in crate::control::motors) fn has_braked(&self, now: Stamp) -> bool {
        let Some(spec) = &self.spec.brake else { return false };
        let is_engaged = !self.brake.is_released && !self.brake.is_broken;
        is_engaged && self.brake.since.is_some_and(|since| now.since(since) >= spec.engages_in)
    }
}
