//! The brake of a joint, as its motor has to know it.
//!
//! Invariant: a brake counts as engaged, or released, only once its time for that has passed.

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_registry::BrakeSpec;

#[derive(Debug)]
pub(in crate::control::motors) struct Brake {
    /// `None` if the joint has no brake.
    spec: Option<BrakeSpec>,
    is: BrakeIs,
    /// Since when; `None` until something is known.
    since: Option<Stamp>,
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

impl Brake {
    pub(super) fn new(spec: Option<BrakeSpec>) -> Self {
        Self { spec, is: BrakeIs::default(), since: None }
    }

    pub(super) fn update(&mut self, is: BrakeIs, now: Stamp) {
        if self.since.is_none() || self.is != is {
            (self.is, self.since) = (is, Some(now));
        }
    }

    pub(super) const fn exists(&self) -> bool {
        self.spec.is_some()
    }

    /// Is there one that can be neither engaged nor released?
    pub(in crate::control::motors) const fn is_broken(&self) -> bool {
        self.exists() && matches!(self.is, BrakeIs::Broken)
    }

    /// Is there one that may be engaged?
    pub(super) const fn may_hold(&self) -> bool {
        self.exists() && !matches!(self.is, BrakeIs::Released)
    }

    /// How long it takes until it holds the joint; `None` if it cannot.
    pub(super) fn engages_in(&self) -> Option<Duration> {
        self.spec.as_ref().filter(|_| !self.is_broken()).map(|spec| spec.engages_in)
    }

    /// Does the joint turn, as far as a brake is concerned?
    pub(super) fn is_free(&self, now: Stamp) -> bool {
        self.spec.as_ref().is_none_or(|spec| self.is_since(BrakeIs::Released, spec.releases_in, now))
    }

    /// Does it hold the joint, so that its motor need not?
    pub(super) fn holds(&self, now: Stamp) -> bool {
        self.spec.as_ref().is_some_and(|spec| self.is_since(BrakeIs::Engaged, spec.engages_in, now))
    }

    fn is_since(&self, is: BrakeIs, limit: Duration, now: Stamp) -> bool {
        self.is == is && self.since.is_some_and(|since| now.since(since) >= limit)
    }
}
