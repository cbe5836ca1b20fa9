//! What a motor reports, judged by its [`Supervision`](crate::control::motors::watch::Supervision).

use rapid_core::time::Stamp;
use rapid_registry::{MotorMode, Stop};

use super::{Motor, Phase};
use crate::control::damiao::codec::{Feedback, MotorStatus, Ranges};
use crate::control::limits::Limits;
use crate::control::motors::fault::Fault;
use crate::control::motors::notice::Notice;
use crate::control::motors::notices::Notices;
use crate::control::motors::watch::{Commanded, beyond, fast};

/// So many frames in a row make sure that a motor has turned itself off.
const SURE: u8 = 2;

impl Motor {
    /// Can it be where it reports to be? One that is off may be turned by hand, and its zero set; one that is damped sinks without
    /// regard to where it is.
    pub(super) fn is_possible(
        &mut self,
        feedback: &Feedback,
        ranges: &Ranges,
        now: Stamp,
        notices: &mut Notices,
    ) -> Result<bool, Fault> {
        let motor = self.index;
        let before = self
            .feedback
            .as_ref()
            .filter(|_| matches!(self.phase, Phase::Enabling | Phase::On | Phase::Kept(Stop::Hold | Stop::Brake)));
        let received = self
            .watch
            .receive(before, feedback, (&self.spec, ranges), now)
            .map_err(|what| Fault::Strange { motor, what })?;
        if let Some(what) = received
            && self.watch.is_first_jump()
        {
            notices.notify(Notice::Strange { motor, what });
        }
        Ok(received.is_none())
    }

    /// What is wrong with a motor that should be enabled, or disabled, according to its reported state.
    pub(in crate::control::motors) fn status_fault(&self) -> Option<Fault> {
        let motor = self.index;
        match self.status? {
            // One frame may be damaged, and a joint that is kept from falling falls for it.
            _ if self.is_kept() && self.off_frames < SURE => None,
            MotorStatus::Disabled if self.phase == Phase::On || self.is_kept() => Some(Fault::Dropped { motor }),
            MotorStatus::Enabled | MotorStatus::Disabled => None,
            status => Some(Fault::Latched { motor, status }),
        }
    }

    /// Is it hotter than it may be?
    pub(in crate::control::motors) fn heat_fault(&self) -> Option<Fault> {
        let motor = self.index;
        let hot = |(part, celsius, limit)| (celsius >= limit).then_some(Fault::Hot { motor, part, celsius, limit });
        self.temperatures(self.feedback.as_ref()?).into_iter().find_map(hot)
    }

    /// Counts the frames that report a motor as off which is on.
    pub(super) fn count_as_off(&mut self, status: MotorStatus) {
        let is_on = matches!(self.phase, Phase::On | Phase::Kept(_));
        let is_off = is_on && status != MotorStatus::Enabled;
        self.off_frames = if is_off { self.off_frames.saturating_add(1) } else { 0 };
    }

    /// Will it follow a command? It reports that it is enabled, or a single frame reports that it is not.
    pub(super) fn may_follow(&self) -> bool {
        self.status == Some(MotorStatus::Enabled) || (1..SURE).contains(&self.off_frames)
    }

    /// What is wrong with what it does, once it is a fault.
    pub(in crate::control::motors) fn strange(
        &mut self,
        commanded: Commanded,
        now: Stamp,
        notices: &mut Notices,
    ) -> Option<Fault> {
        let (motor, feedback) = (self.index, self.feedback.as_ref()?);
        let what = self.watch.look((motor, &self.spec), feedback, commanded, now, notices)?;
        Some(Fault::Strange { motor, what })
    }

    /// Is it too far outside its limits, or too fast, to be armed?
    pub(super) fn unfit(&self, is_returning: bool) -> Option<Fault> {
        let feedback = self.feedback.as_ref()?;
        let what = beyond(&self.spec, feedback).filter(|_| !is_returning).or_else(|| fast(&self.spec, feedback))?;
        Some(Fault::Strange { motor: self.index, what })
    }

    /// Is it too far from an action for that to be the first after an arm?
    pub(in crate::control::motors) fn is_far(&self, target: f64, limits: &Limits) -> bool {
        let Some(feedback) = self.feedback else { return false };
        let [low, high] = limits.range();
        // A target beyond the limits is replaced by the limit.
        let far = (target.clamp(low, high) - feedback.q).abs() > self.spec.motion.first_target;
        far && self.spec.mode != MotorMode::Velocity
    }

    /// Why it is not enabled by now, if it is not.
    pub(in crate::control::motors) fn arm_fault(&self) -> Option<Fault> {
        let motor = self.index;
        match (self.phase, self.status) {
            (Phase::On, _) if self.is_braked() => Some(Fault::NotReleased { motor }),
            (Phase::Probed, _) if !self.agrees => Some(Fault::NotEnabled { motor }),
            // Who is probed waits for the others, which come to their own.
            (Phase::On | Phase::Probed, _) => None,
            (Phase::Off { .. }, Some(MotorStatus::Enabled)) | (Phase::Kept(_), _) => Some(Fault::NotDisabled { motor }),
            (Phase::Off { .. }, _) => Some(Fault::Silent { motor }),
            (Phase::Asked { .. }, _) => Some(Fault::Unread { motor, parameter: self.asked_for()? }),
            (Phase::Clearing, Some(status)) if status != MotorStatus::Disabled => {
                Some(Fault::Latched { motor, status })
            }
            (Phase::Clearing | Phase::Enabling, _) => Some(Fault::NotEnabled { motor }),
        }
    }
}
