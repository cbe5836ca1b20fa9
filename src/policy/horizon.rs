//! The receding horizon: which action of which chunk is executed at which tick, or that none is.
//!
//! A policy answers an observation of tick o with a chunk of `horizon` actions, and action
//! `action_start + (k - o)` of it is the one of tick k. The next observation is sent
//! `n_action_steps` ticks after o, or at once when a modality comes or goes; the chunk goes on to its end, so that it bridges the time until
//! the new one is there. The new one is joined at the action of the tick, never at its beginning: a
//! chunk stands for moments, and those that have passed are left out.
//!
//! What can go wrong, and what happens then:
//!
//! * NaN or infinity anywhere in a chunk, or not as many values as a chunk has: none of it is used.
//! * A chunk more than one tick late: used from the action of the tick. So late that none of its
//!   actions is left: not used.
//! * A value beyond the action's limits: the limit is executed.
//! * An observation too old: no chunk is asked for. The one there is goes on to its end.
//! * A required modality missing: hold at once, for a robot must not go on blindly with what was
//!   decided when it could see. Another one missing: go on if the policy knows of the mask; if it
//!   does not, hold until it is back, unless told to go on ([`WithoutMask`]).
//! * None of several pictures present: hold likewise. In training one of them was always there.
//! * No action left: hold.
//!
//! Invariant: pure: time comes in as ticks of the control grid, rising. One call a tick to
//! [`Executor::wants_observation`], then one to [`Executor::step`].
//! Invariant: no action is given of a chunk whose observation is older than the last hold's
//! beginning: what was planned before a stop says nothing about the world after it.
//! Invariant: at most one observation is with the policy at a time.
//! Invariant: nothing here allocates after construction, and no input makes it panic.

mod told;

use std::time::Duration;

use super::bundle::{Bundle, ObservationInput};
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::registry::Registry;

pub use told::{Counts, HoldReason, Refused, Step};

/// What a policy that was not trained with modalities left out does when one leaves that it does not
/// require.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum WithoutMask {
    /// Hold until it is back.
    #[default]
    Hold,
    /// Go on, as the operator wishes; what the policy does then nobody has taught it.
    GoOn,
}

/// What is known at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Situation {
    /// The modalities present.
    pub mask: PhysicalMask,
    /// Age of the oldest sample of a present modality in the newest step of the observation; `None`
    /// if there is no observation at all.
    pub observation_age: Option<Duration>,
}

/// See the module's comment.
#[derive(Debug)]
pub struct Executor {
    horizon: u64,
    n_action_steps: u64,
    action_start: u64,
    max_observation_age: Duration,
    needs: Needs,
    modalities: Vec<Modality>,
    min: Vec<f32>,
    max: Vec<f32>,
    /// `[Tp, Da]`.
    chunk: Vec<f32>,
    /// The observation of what is in `chunk`; `None` if nothing usable is.
    observed: Option<u64>,
    clamped_told: bool,
    /// The observation that is with the policy.
    in_flight: Option<u64>,
    /// What of the policy's modalities was present in the last observation sent.
    asked_with: Option<PhysicalMask>,
    /// Chunks of earlier observations are not used.
    fence: u64,
    /// The first tick that no step was made for.
    next: u64,
    hold: Option<HoldReason>,
    too_old: bool,
    out: Vec<f32>,
    counts: Counts,
}

/// What must be there beside the modalities that are required.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Needs {
    Nothing,
    /// One picture at least, of several.
    APicture,
    All,
}

#[derive(Debug)]
struct Modality {
    name: String,
    /// `None` if the registry does not know it: then it is never there.
    id: Option<ModalityId>,
    required: bool,
    is_picture: bool,
}

impl Executor {
    /// For a bundle that fits the registry, with nothing computed yet.
    #[must_use]
    pub fn new(bundle: &Bundle, registry: &Registry, without_mask: WithoutMask) -> Self {
        let modality = |observation: &super::bundle::ObservationSpec| Modality {
            name: observation.modality.clone(),
            id: registry.named(&observation.modality).map(|device| device.id),
            required: observation.required,
            is_picture: matches!(observation.input, ObservationInput::Image(_)),
        };
        let modalities: Vec<Modality> = bundle.observations.iter().map(modality).collect();
        let pictures = modalities.iter().filter(|modality| modality.is_picture).count();
        let needs = match (without_mask, bundle.mask_aware) {
            (WithoutMask::Hold, false) => Needs::All,
            (WithoutMask::Hold, true) if pictures > 1 => Needs::APicture,
            _ => Needs::Nothing,
        };
        let values = bundle.action.len();
        Self {
            horizon: bundle.horizon as u64,
            n_action_steps: bundle.n_action_steps as u64,
            action_start: bundle.action_start as u64,
            max_observation_age: bundle.max_observation_age,
            needs,
            modalities,
            min: bundle.action.min.clone(),
            max: bundle.action.max.clone(),
            chunk: vec![0.0; bundle.horizon * values],
            observed: None,
            clamped_told: false,
            in_flight: None,
            asked_with: None,
            fence: 0,
            next: 0,
            hold: None,
            too_old: false,
            out: vec![0.0; values],
            counts: Counts::default(),
        }
    }

    /// Is the observation of `tick` to be sent to the policy? If so, it counts as sent:
    /// [`Self::take`] or [`Self::failed`] must follow before there is another.
    pub fn wants_observation(&mut self, tick: u64, situation: Situation) -> bool {
        self.too_old = false;
        let seen = self.relevant(situation.mask);
        let due = self.observed.is_none_or(|observed| tick.saturating_sub(observed) >= self.n_action_steps);
        // What was decided with other senses is to be decided again, at once.
        let due = due || self.asked_with != Some(seen);
        if self.in_flight.is_some() || !due || self.missing(situation.mask).is_some() {
            return false;
        }
        if situation.observation_age.is_none_or(|age| age > self.max_observation_age) {
            self.too_old = true;
            self.counts.old_observations += 1;
            return false;
        }
        self.in_flight = Some(tick);
        self.asked_with = Some(seen);
        self.counts.requests += 1;
        true
    }

    /// The policy's answer to the observation of tick `observed`: `[Tp, Da]`, in the action's units.
    /// Returns how many actions were skipped because it came more than one tick late.
    ///
    /// # Errors
    /// Why none of it is used; whatever was used before goes on.
    pub fn take(&mut self, observed: u64, values: &[f32]) -> Result<u64, Refused> {
        let taken = self.check(observed, values);
        if self.in_flight == Some(observed) {
            self.in_flight = None;
        }
        let counts = &mut self.counts;
        let counter = match taken {
            Ok(_) => &mut counts.chunks,
            Err(Refused::Unasked) => &mut counts.unasked_chunks,
            Err(Refused::Length) => &mut counts.wrong_length_chunks,
            Err(Refused::NotFinite) => &mut counts.not_finite_chunks,
            Err(Refused::BeforeHold) => &mut counts.before_hold_chunks,
            Err(Refused::Expired) => &mut counts.expired_chunks,
        };
        *counter += 1;
        let skipped = taken?;
        counts.late_chunks += u64::from(skipped > 0);
        counts.skipped_actions += skipped;
        self.chunk.copy_from_slice(values);
        self.observed = Some(observed);
        self.clamped_told = false;
        Ok(skipped)
    }

    fn check(&self, observed: u64, values: &[f32]) -> Result<u64, Refused> {
        if self.in_flight != Some(observed) {
            return Err(Refused::Unasked);
        }
        if values.len() != self.chunk.len() {
            return Err(Refused::Length);
        }
        if !values.iter().all(|value| value.is_finite()) {
            return Err(Refused::NotFinite);
        }
        if observed < self.fence {
            return Err(Refused::BeforeHold);
        }
        let passed = self.next.saturating_sub(observed);
        if passed >= self.horizon.saturating_sub(self.action_start) {
            return Err(Refused::Expired);
        }
        // The action of the observation's own tick is not expected to be there in time.
        Ok(passed.saturating_sub(1))
    }

    /// The policy has no answer to the observation of tick `observed`.
    pub fn failed(&mut self, observed: u64) {
        if self.in_flight == Some(observed) {
            self.in_flight = None;
            self.counts.failed_requests += 1;
        }
    }

    /// What to do at `tick`.
    pub fn step(&mut self, tick: u64, situation: Situation) -> Step<'_> {
        self.next = self.next.max(tick.saturating_add(1));
        let missing = self.missing(situation.mask);
        match missing.map(|(_, reason)| reason).map_or_else(|| self.index(tick), Err) {
            Ok((index, age)) => self.act(index, age),
            Err(reason) => self.hold(tick, reason, missing.map(|(at, _)| at)),
        }
    }

    /// What has happened so far.
    #[must_use]
    pub const fn counts(&self) -> Counts {
        self.counts
    }

    /// The observation that is with the policy.
    #[must_use]
    pub const fn in_flight(&self) -> Option<u64> {
        self.in_flight
    }

    /// Which of the modalities that the policy observes are present.
    fn relevant(&self, mask: PhysicalMask) -> PhysicalMask {
        let ids = self.modalities.iter().filter_map(|modality| modality.id);
        ids.fold(PhysicalMask::EMPTY, |seen, id| seen.with(id, mask.contains(id)))
    }

    /// The index of the action of `tick`, and the chunk's age in ticks.
    fn index(&self, tick: u64) -> Result<(usize, u64), HoldReason> {
        let age = self.observed.and_then(|observed| tick.checked_sub(observed));
        let found = age.and_then(|age| Some((self.action_start.checked_add(age)?, age)));
        match found.filter(|(index, _)| *index < self.horizon) {
            Some((index, age)) => Ok((usize::try_from(index).map_err(|_| HoldReason::Unusable)?, age)),
            None if self.in_flight.is_some() => Err(HoldReason::Waiting),
            None if self.too_old => Err(HoldReason::ObservationOld),
            None => Err(HoldReason::Unusable),
        }
    }

    /// The position of the first modality that must be there and is not.
    fn missing(&self, mask: PhysicalMask) -> Option<(usize, HoldReason)> {
        let absent = |modality: &Modality| !modality.id.is_some_and(|id| mask.contains(id));
        let first =
            |required| self.modalities.iter().position(|modality| modality.required == required && absent(modality));
        if let Some(at) = first(true) {
            return Some((at, HoldReason::RequiredMissing));
        }
        if let Some(at) = first(false).filter(|_| self.needs == Needs::All) {
            return Some((at, HoldReason::NotMaskAware));
        }
        let mut pictures = self.modalities.iter().filter(|modality| modality.is_picture);
        let at = self.modalities.iter().position(|modality| modality.is_picture)?;
        (self.needs == Needs::APicture && pictures.all(absent)).then_some((at, HoldReason::NoPicture))
    }

    fn act(&mut self, index: usize, age: u64) -> Step<'_> {
        let values = self.out.len();
        let action = self.chunk.iter().skip(index * values);
        let mut clamped = false;
        for ((out, value), (min, max)) in self.out.iter_mut().zip(action).zip(self.min.iter().zip(&self.max)) {
            *out = value.max(*min).min(*max);
            clamped |= !(*min..=*max).contains(value);
        }
        self.hold = None;
        self.counts.actions += 1;
        self.counts.clamped_actions += u64::from(clamped);
        let clamped_is_news = clamped && !self.clamped_told;
        self.clamped_told |= clamped;
        Step {
            action: Some(&self.out),
            hold: None,
            hold_is_news: false,
            missing: None,
            index: Some(index),
            chunk_age_ticks: Some(age),
            clamped_is_news,
        }
    }

    fn hold(&mut self, tick: u64, reason: HoldReason, missing: Option<usize>) -> Step<'_> {
        let begins = self.hold.is_none();
        let news = self.hold != Some(reason);
        // What is computed while nothing is missing may be used when only the wait changes its name.
        if begins || (news && reason.is_missing()) {
            // What is missing now is missing in this tick's observation.
            self.fence = tick.saturating_add(u64::from(reason.is_missing()));
        }
        if self.observed.is_some_and(|observed| observed < self.fence) {
            self.observed = None;
        }
        self.hold = Some(reason);
        self.counts.holds += u64::from(begins);
        self.counts.held_ticks += 1;
        Step {
            action: None,
            hold: Some(reason),
            hold_is_news: news,
            missing: missing.and_then(|at| self.modalities.get(at)).map(|modality| modality.name.as_str()),
            index: None,
            chunk_age_ticks: None,
            clamped_is_news: false,
        }
    }
}

#[cfg(test)]
mod tests;
