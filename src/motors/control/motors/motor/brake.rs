//! The brake of a joint, as its motor has to know it.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::Stop;

use super::{Motor, Phase};

/// What is known of a brake.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Brake {
    is: BrakeIs,
    /// Since when; `None` until something is known.
    since: Option<Stamp>,
    /// It is to be engaged while its motor still damps or holds the joint, which is turned off after that.
    is_due: bool,
    /// That it cannot hold the joint was reported.
    is_missed: bool,
}

/// What a brake is, by its line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(in crate::control::motors) enum BrakeIs {
    Engaged,
    /// Its line is being set: what it is, is not known.
    Moving,
    Released,
    /// It can be neither engaged nor released: what it is, is not known.
    #[default]
    Broken,
}

impl Motor {
    /// Takes what its brake is.
    pub(in crate::control::motors) fn take_brake(&mut self, is: BrakeIs, now: Stamp) {
        if self.brake.since.is_none() || self.brake.is != is {
            (self.brake.is, self.brake.since) = (is, Some(now));
        }
    }

    /// Is its brake to be released? Not before it holds the joint itself, and no longer.
    pub(in crate::control::motors) const fn releases(&self) -> bool {
        matches!(self.phase, Phase::On | Phase::Kept(Stop::Damp | Stop::Hold)) && !self.brake.is_due
    }

    /// It has a brake, which can be neither engaged nor released.
    pub(in crate::control::motors) const fn has_broken_brake(&self) -> bool {
        self.spec.brake.is_some() && matches!(self.brake.is, BrakeIs::Broken)
    }

    /// Its joint waits for a brake that cannot be driven; `true` once.
    pub(in crate::control::motors) fn misses_brake(&mut self) -> bool {
        let is_missed = self.waits_for_brake() && self.has_broken_brake();
        is_missed && !std::mem::replace(&mut self.brake.is_missed, true)
    }

    /// It is kept until its brake holds the joint.
    pub(in crate::control::motors) const fn waits_for_brake(&self) -> bool {
        matches!(self.phase, Phase::Kept(Stop::Brake)) || self.is_kept() && self.brake.is_due
    }

    /// It has a brake, which may be engaged.
    pub(super) const fn is_braked(&self) -> bool {
        self.spec.brake.is_some() && !matches!(self.brake.is, BrakeIs::Released)
    }

    /// Does its brake let it turn?
    pub(in crate::control::motors) fn is_free(&self, now: Stamp) -> bool {
        self.spec.brake.as_ref().is_none_or(|spec| self.is_since(BrakeIs::Released, spec.releases_in, now))
    }

    /// Does its brake hold the joint, so that its motor need not?
    pub(super) fn has_braked(&self, now: Stamp) -> bool {
        self.spec.brake.as_ref().is_some_and(|spec| self.is_since(BrakeIs::Engaged, spec.engages_in, now))
    }

    fn is_since(&self, is: BrakeIs, limit: Duration, now: Stamp) -> bool {
        self.brake.is == is && self.brake.since.is_some_and(|since| now.since(since) >= limit)
    }

    /// Lets its brake, if it has one, be engaged before it is turned off.
    pub(super) const fn call_brake(&mut self) {
        self.brake.is_due = self.spec.brake.is_some();
    }

    /// It is no longer kept.
    pub(super) const fn dismiss_brake(&mut self) {
        (self.brake.is_due, self.brake.is_missed) = (false, false);
    }
}
