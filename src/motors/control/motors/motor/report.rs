//! The newest feedback of a motor, as its joint's, and how old it is.
//!
//! Invariant: a sample is taken once.

use std::time::Duration;

use rapid_core::time::Stamp;

use crate::control::damiao::codec::Feedback;

/// Values per motor in a sample: position rad, velocity rad/s and torque Nm of its joint, temperature of the transistors °C,
/// of the winding °C, and the code of its status.
pub const SAMPLE_VALUES: usize = 6;

#[derive(Debug)]
pub(in crate::control::motors) struct Report {
    /// `None` before its ranges are known.
    feedback: Option<Feedback>,
    /// When the feedback arrived.
    seen: Stamp,
    /// The feedback is newer than the last sample.
    is_new: bool,
    /// Its newest two positions are consistent.
    agrees: bool,
    /// Time of the first frame sent since its last answer.
    asked: Option<Stamp>,
    /// It is silent once it has left frames unanswered for this long.
    silent_after: Duration,
}

impl Report {
    pub(super) const fn new(silent_after: Duration) -> Self {
        Self { feedback: None, seen: Stamp(0), is_new: false, agrees: false, asked: None, silent_after }
    }

    /// A frame was sent to it.
    pub(super) fn ask(&mut self, now: Stamp) {
        self.asked.get_or_insert(now);
    }

    /// It has answered.
    pub(super) const fn answer(&mut self) {
        self.asked = None;
    }

    /// Has it left our frames unanswered for too long?
    pub(in crate::control::motors) fn is_silent(&self, now: Stamp) -> bool {
        self.asked.is_some_and(|asked| now.since(asked) >= self.silent_after)
    }

    /// Takes a feedback. `is_near`: could the joint move to it, from the one before, in this time?
    pub(super) fn update(&mut self, feedback: Feedback, now: Stamp, is_near: impl FnOnce(&Feedback, Duration) -> bool) {
        self.agrees = self.feedback.is_some_and(|before| is_near(&before, now.since(self.seen)));
        (self.feedback, self.seen, self.is_new) = (Some(feedback), now, true);
    }

    /// Forgets the feedback: counted in other ranges, it means something else.
    pub(super) const fn forget(&mut self) {
        (self.feedback, self.is_new) = (None, false);
    }

    /// The newest feedback.
    pub(super) const fn feedback(&self) -> Option<&Feedback> {
        self.feedback.as_ref()
    }

    /// Are the newest two positions consistent? One of two frames may be damaged.
    pub(super) const fn agrees(&self) -> bool {
        self.agrees
    }

    /// When the feedback arrived, if it is newer than the last sample.
    pub(in crate::control::motors) fn unsampled(&self) -> Option<Stamp> {
        self.is_new.then_some(self.seen)
    }

    /// The newest feedback as a part of a sample.
    pub(super) fn sample(&mut self) -> Option<[f64; SAMPLE_VALUES]> {
        let Feedback { q, dq, tau, mos, rotor, status, .. } = self.feedback?;
        self.is_new = false;
        Some([q, dq, tau, f64::from(mos), f64::from(rotor), f64::from(status.code())])
    }
}
