//! A policy at the controls: what it sees at each tick, when it is asked, and what is done.
//!
//! [`Observer`] and [`Executor`] put together, without thread, clock or network: who keeps the time says
//! which tick it is, and carries requests to a [`Model`](super::model::Model) and answers back.
//!
//! Invariant: an answer belongs to the request that is out; there is one at most.

use std::time::Duration;

use super::bundle::Bundle;
use super::horizon::{Counts, Executor, Refused, Situation, Step, WithoutMask};
use super::observer::Observer;
use super::request::Request;
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::registry::Registry;
use crate::sample::SampleHeader;
use crate::time::Stamp;

/// The first tick is this much later than the capture of the newest sample that it waited for: what a device and
/// the bus take.
pub const FIRST_TICK_AFTER: Duration = Duration::from_millis(10);

/// See the module's comment.
#[derive(Debug)]
pub struct Pilot {
    observer: Observer,
    executor: Executor,
    mask: PhysicalMask,
    seed: u64,
    situation: Situation,
}

impl Pilot {
    /// A policy that has seen nothing. `seed` chooses its noise.
    #[must_use]
    pub fn new(bundle: &Bundle, registry: &Registry, without_mask: WithoutMask, seed: u64) -> Self {
        let mask = PhysicalMask::EMPTY;
        Self {
            observer: Observer::new(bundle, registry),
            executor: Executor::new(bundle, registry, without_mask),
            mask,
            seed,
            situation: Situation { mask, observation_age: None },
        }
    }

    /// Takes a sample.
    pub fn sample(&mut self, id: ModalityId, header: &SampleHeader, payload: &[u8]) {
        self.observer.push(id, header, payload);
    }

    /// Takes a publication of the mask.
    pub fn mask(&mut self, mask: PhysicalMask) {
        self.mask = mask;
    }

    /// Forgets the samples it was given.
    pub fn forget(&mut self) {
        self.observer.clear();
    }

    /// The mask in force.
    #[must_use]
    pub const fn mask_in_force(&self) -> PhysicalMask {
        self.mask
    }

    /// The capture of the newest sample, once every modality that is present has sent one.
    #[must_use]
    pub fn first_sight(&self) -> Option<Stamp> {
        self.observer.first_sight(self.mask)
    }

    /// Looks at tick number `number` of the control grid, which is at `tick`. Says whether the policy is to
    /// be asked; if so, [`Self::fill`] says what, and [`Self::answer`] or [`Self::failed`] must follow.
    pub fn look(&mut self, number: u64, tick: Stamp, now: Stamp) -> bool {
        let observation_age = self.observer.look(tick, now, self.mask);
        self.situation = Situation { mask: self.mask, observation_age };
        self.executor.wants_observation(number, self.situation)
    }

    /// Makes `request` the question of tick `number`, which was looked at last and is at `tick`.
    pub fn fill(&self, number: u64, tick: Stamp, request: &mut Request) {
        (request.tick, request.stamp, request.mask) = (number, tick, self.mask);
        // Of each request its own, so that a chunk can be computed again without those before it.
        request.seed = self.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(number);
        self.observer.fill(request);
    }

    /// What is to be done at tick `number`, which was looked at.
    pub fn step(&mut self, number: u64) -> Step<'_> {
        self.executor.step(number, self.situation)
    }

    /// The answer to the request of tick `asked`. Returns how many of its actions came too late.
    ///
    /// # Errors
    /// Why it is not used.
    pub fn answer(&mut self, asked: u64, chunk: &[f32]) -> Result<u64, Refused> {
        self.executor.take(asked, chunk)
    }

    /// There is no answer to the request of tick `asked`.
    pub fn failed(&mut self, asked: u64) {
        self.executor.failed(asked);
    }

    /// What has happened so far.
    #[must_use]
    pub const fn counts(&self) -> Counts {
        self.executor.counts()
    }
}
