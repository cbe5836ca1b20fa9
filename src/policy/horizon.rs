//! The receding horizon: which action of which chunk is executed at which tick, or none.
//!
//! A policy answers an observation of tick o with a chunk of `horizon` actions, and action `action_start + (k - o)` of
//! it is the one of tick k. The next observation is sent `n_action_steps` ticks after o, or at once when a modality
//! comes or goes; the chunk is executed to its end, so that it bridges the time until the new one arrives. The new one
//! is entered at the action of the current tick, never at its beginning: actions belong to ticks, and those of past
//! ticks are skipped.
//!
//! Failures and their handling:
//!
//! * NaN or infinity anywhere in a chunk, or a wrong number of values: the whole chunk is rejected. Likewise one from
//!   which no poses follow (see [`compose`](super::compose)).
//! * A chunk more than one tick late: used from the action of the tick. Too late for any of its
//!   actions: not used.
//! * A value beyond the action's limits: the limit is executed.
//! * An observation too old: no chunk is requested. The current one is executed to its end.
//! * A required modality missing: hold at once: a robot must not continue blindly with actions that were
//!   computed when it could see. Another one missing: continue if the policy is mask-aware; otherwise
//!   hold until it is back, unless configured to continue ([`WithoutMask`]).
//! * None of several pictures present: hold likewise. In training one of them was always present.
//! * No action left: hold.
//!
//! Invariant: pure: time comes in as ticks of the control grid, rising. One call a tick to
//! [`ActionQueue::wants_observation`], then one to [`ActionQueue::step`].
//! Invariant: no action is taken from a chunk whose observation is older than the beginning of the last hold: a plan
//! from before a stop may not fit the world after it.
//! Invariant: nothing here allocates after construction, and no input causes a panic.

use std::time::Duration;

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_registry::Registry;
use serde::Serialize;

use super::bundle::{Bundle, ObservationInput, ObservationSpec};

/// What a policy that was not trained with absent modalities does when an optional one disappears.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum WithoutMask {
    /// Hold until it is back.
    #[default]
    Hold,
    /// Continue, at the request of the operator; the policy was not trained for this.
    GoOn,
}

/// The situation at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Situation {
    /// The modalities present.
    pub mask: PhysicalMask,
    /// Age of the oldest sample of a present modality in the newest step of the observation; `None`
    /// if there is no observation at all.
    pub observation_age: Option<Duration>,
}

/// Why no action is executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum HoldReason {
    /// A required modality is absent.
    RequiredMissing,
    /// A modality is absent, and the policy was not trained without it.
    NotMaskAware,
    /// None of the pictures that the policy observes is present.
    NoPicture,
    /// The newest samples are older than the bundle allows.
    ObservationOld,
    /// The policy is computing, and no action is left of its last chunk.
    Waiting,
    /// The policy's last answer could not be used.
    Unusable,
}

impl HoldReason {
    const fn is_missing(self) -> bool {
        matches!(self, Self::RequiredMissing | Self::NotMaskAware | Self::NoPicture)
    }
}

impl std::fmt::Display for HoldReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::RequiredMissing => "a modality that the policy requires is missing",
            Self::NotMaskAware => "a modality is missing, and the policy was not trained to do without",
            Self::NoPicture => "no picture that the policy observes is there",
            Self::ObservationOld => "the observation is too old",
            Self::Waiting => "the next actions are still being computed",
            Self::Unusable => "the policy's last answer could not be used",
        })
    }
}

/// The decision for a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Step<'a> {
    /// The values to execute, within the limits; `None` means hold.
    pub action: Option<&'a [f32]>,
    /// Why there is no action.
    pub hold: Option<HoldReason>,
    /// Whether a hold begins here, or its reason changes. Reported once.
    pub hold_is_news: bool,
    /// The modality whose absence is the reason.
    pub missing: Option<&'a str>,
    /// The index of the action in its chunk.
    pub index: Option<usize>,
    /// Ticks since the observation on which the action is based.
    pub chunk_age_ticks: Option<u64>,
    /// Whether this is the first action of its chunk beyond the limits. Reported once.
    pub clamped_is_news: bool,
}

/// Why a chunk is not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum ChunkError {
    /// The policy has no such request.
    #[error("actions for an observation that was not asked about")]
    Unasked,
    /// Not `horizon` actions.
    #[error("a chunk of the wrong length")]
    Length,
    /// NaN or infinity.
    #[error("a chunk with values that are not finite numbers")]
    NotFinite,
    /// A rotation in it is invalid.
    #[error("a chunk with an invalid rotation: its rows are zero or parallel, or its quaternion is zero")]
    NoRotation,
    /// The pose that its actions are relative to is invalid.
    #[error("a chunk relative to a sample that has no pose: it is too short, not finite, or its quaternion is zero")]
    NoBase,
    /// Its observation precedes the start of the last hold.
    #[error("actions that were decided before the policy had to hold")]
    BeforeHold,
    /// All of its actions are in the past.
    #[error("actions so late that the time for all of them has passed")]
    Expired,
}

/// Counts of events so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Counts {
    /// Ticks with an action.
    pub actions: u64,
    /// Ticks without an action.
    pub held_ticks: u64,
    /// Number of holds, including the one at the start.
    pub holds: u64,
    /// Observations sent to the policy.
    pub requests: u64,
    /// Chunks that were used.
    pub chunks: u64,
    /// Those that arrived more than one tick after their observation.
    pub late_chunks: u64,
    /// Actions of late chunks that were skipped.
    pub skipped_actions: u64,
    /// Chunks whose actions were all in the past.
    pub expired_chunks: u64,
    /// Chunks with NaN or infinity.
    pub not_finite_chunks: u64,
    /// Chunks from which no poses follow: a rotation, or the pose that they are relative to, is invalid.
    pub no_pose_chunks: u64,
    /// Chunks of the wrong length.
    pub wrong_length_chunks: u64,
    /// Chunks for an observation that was not requested.
    pub unasked_chunks: u64,
    /// Chunks from before a hold.
    pub before_hold_chunks: u64,
    /// Observations for which the policy had no answer.
    pub failed_requests: u64,
    /// Executed actions with a value clamped to a limit.
    pub clamped_actions: u64,
    /// Ticks at which an observation was due but too old.
    pub old_observations: u64,
}

/// See the module's comment.
#[derive(Debug)]
pub struct ActionQueue {
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
    /// The tick of the observation of `chunk`; `None` if `chunk` holds nothing usable.
    observed: Option<u64>,
    clamp_reported: bool,
    /// The observation that the policy is computing.
    in_flight: Option<u64>,
    /// The policy's modalities that were present in the last request.
    asked_with: Option<PhysicalMask>,
    /// Chunks of earlier observations are not used.
    fence: u64,
    /// The first tick without a step so far.
    next: u64,
    hold: Option<HoldReason>,
    too_old: bool,
    out: Vec<f32>,
    counts: Counts,
}

/// What must be present besides the required modalities.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Needs {
    Nothing,
    /// At least one of several pictures.
    APicture,
    All,
}

#[derive(Debug)]
struct Modality {
    name: String,
    /// `None` if the registry does not have it: it is then never present.
    id: Option<ModalityId>,
    required: bool,
    is_picture: bool,
}

impl ActionQueue {
    /// For a bundle that matches the registry, with nothing computed yet.
    pub fn new(bundle: &Bundle, registry: &Registry, without_mask: WithoutMask) -> Self {
        let is_picture = |observation: &ObservationSpec| matches!(observation.input, ObservationInput::Image(_));
        let modality = |(at, observation): (usize, &ObservationSpec)| {
            // A history is not a picture besides those that its modality is observed by now.
            let counted = |(other_at, other): (usize, &ObservationSpec)| {
                let goes_before = other.history.is_none() || other_at < at;
                other.modality == observation.modality && is_picture(other) && goes_before
            };
            let is_counted = observation.history.is_some() && bundle.observations.iter().enumerate().any(counted);
            Modality {
                name: observation.modality.clone(),
                id: registry.named(&observation.modality).map(|device| device.id),
                required: observation.required,
                is_picture: is_picture(observation) && !is_counted,
            }
        };
        let modalities: Vec<Modality> = bundle.observations.iter().enumerate().map(modality).collect();
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
            clamp_reported: false,
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

    /// Whether the observation of `tick` must be sent to the policy. If so, it counts as sent: [`Self::accept_chunk`] or
    /// [`Self::failed`] must follow before the next one. At most one observation is with the policy at a time.
    pub fn wants_observation(&mut self, tick: u64, situation: Situation) -> bool {
        self.too_old = false;
        let seen = self.relevant(situation.mask);
        let due = self.observed.is_none_or(|observed| tick.saturating_sub(observed) >= self.n_action_steps);
        // A decision made with other modalities is repeated at once.
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

    /// The policy's answer to the observation of tick `observed`: `[Tp, executed values]`, in the action's units.
    /// Returns how many actions were skipped because it came more than one tick late.
    ///
    /// # Errors
    /// Why the chunk is rejected; the previous chunk stays in use.
    pub fn accept_chunk(&mut self, observed: u64, values: &[f32]) -> Result<u64, ChunkError> {
        let taken = self.check(observed, values);
        let skipped = taken.map_err(|reason| self.refuse(observed, reason))?;
        self.in_flight = None;
        let counts = &mut self.counts;
        counts.chunks += 1;
        counts.late_chunks += u64::from(skipped > 0);
        counts.skipped_actions += skipped;
        self.chunk.copy_from_slice(values);
        self.observed = Some(observed);
        self.clamp_reported = false;
        Ok(skipped)
    }

    fn check(&self, observed: u64, values: &[f32]) -> Result<u64, ChunkError> {
        if self.in_flight != Some(observed) {
            return Err(ChunkError::Unasked);
        }
        if values.len() != self.chunk.len() {
            return Err(ChunkError::Length);
        }
        if !values.iter().all(|value| value.is_finite()) {
            return Err(ChunkError::NotFinite);
        }
        if observed < self.fence {
            return Err(ChunkError::BeforeHold);
        }
        let passed = self.next.saturating_sub(observed);
        if passed >= self.horizon.saturating_sub(self.action_start) {
            return Err(ChunkError::Expired);
        }
        // The action of the observation's own tick is not expected in time.
        Ok(passed.saturating_sub(1))
    }

    /// The policy's answer to the observation of tick `observed` is not used, for this reason. Returns the reason that
    /// counts: an answer that was not asked for is nothing else. The previous chunk stays in use.
    pub fn refuse(&mut self, observed: u64, reason: ChunkError) -> ChunkError {
        let reason = if self.in_flight == Some(observed) { reason } else { ChunkError::Unasked };
        let counts = &mut self.counts;
        let counter = match reason {
            ChunkError::Unasked => &mut counts.unasked_chunks,
            ChunkError::Length => &mut counts.wrong_length_chunks,
            ChunkError::NotFinite => &mut counts.not_finite_chunks,
            ChunkError::NoRotation | ChunkError::NoBase => &mut counts.no_pose_chunks,
            ChunkError::BeforeHold => &mut counts.before_hold_chunks,
            ChunkError::Expired => &mut counts.expired_chunks,
        };
        *counter += 1;
        if reason != ChunkError::Unasked {
            self.in_flight = None;
        }
        reason
    }

    /// The policy has no answer to the observation of tick `observed`.
    pub fn failed(&mut self, observed: u64) {
        if self.in_flight == Some(observed) {
            self.in_flight = None;
            self.counts.failed_requests += 1;
        }
    }

    /// The decision for `tick`.
    pub fn step(&mut self, tick: u64, situation: Situation) -> Step<'_> {
        self.next = self.next.max(tick.saturating_add(1));
        let missing = self.missing(situation.mask);
        match missing.map(|(_, reason)| reason).map_or_else(|| self.index(tick), Err) {
            Ok((index, age)) => self.act(index, age),
            Err(reason) => self.hold(tick, reason, missing.map(|(at, _)| at)),
        }
    }

    /// Counts of events so far.
    pub const fn counts(&self) -> Counts {
        self.counts
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

    /// The index of the first modality that must be present and is not.
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
        let clamped_is_news = clamped && !self.clamp_reported;
        self.clamp_reported |= clamped;
        Step {
            action: Some(&self.out),
            index: Some(index),
            chunk_age_ticks: Some(age),
            clamped_is_news,
            ..Step::default()
        }
    }

    fn hold(&mut self, tick: u64, reason: HoldReason, missing: Option<usize>) -> Step<'_> {
        let begins = self.hold.is_none();
        let news = self.hold != Some(reason);
        // An answer computed while nothing is missing stays usable if only the reason for waiting changes.
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
            hold: Some(reason),
            hold_is_news: news,
            missing: missing.and_then(|at| self.modalities.get(at)).map(|modality| modality.name.as_str()),
            ..Step::default()
        }
    }
}

#[cfg(test)]
mod tests;
