//! A policy in control: its observation at each tick, its requests, and the action of the tick.
//!
//! [`Observer`], [`Composer`] and [`ActionQueue`] put together, without thread, clock or network: the caller keeps the time, names
//! the tick, and carries requests to a [`Model`](super::model::Model) and answers back.
//!
//! Invariant: an answer belongs to the request that is out; there is one at most.

use std::time::Duration;

use rapid_bus::TopicId;
use rapid_core::mask::{Bits, PhysicalMask};
use rapid_core::sample::SampleHeader;
use rapid_core::time::Stamp;
use rapid_registry::Registry;

use super::bundle::Bundle;
use super::compose::Composer;
use super::horizon::{ActionQueue, ChunkError, Situation, Step, WithoutMask};
use super::observer::Observer;
use super::request::Request;

/// The first tick is this much later than the capture of the newest sample that it waited for: what a device and
/// the bus take.
pub const FIRST_TICK_AFTER: Duration = Duration::from_millis(10);

/// See the module's comment.
#[derive(Debug)]
pub struct Pilot {
    /// The observations; takes samples.
    pub observer: Observer,
    /// The actions; takes what is executed of the answers to requests, see [`Pilot::answer`].
    pub queue: ActionQueue,
    /// The mask published last.
    pub mask: PhysicalMask,
    seed: u64,
    situation: Situation,
    composer: Composer,
    /// What the last answer wants executed: `[Tp, executed values]`.
    chunk: Vec<f32>,
}

impl Pilot {
    /// A policy without samples. `seed` determines its noise.
    pub fn new(bundle: &Bundle, registry: &Registry, without_mask: WithoutMask, seed: u64) -> Self {
        let mask = PhysicalMask::EMPTY;
        let composer = Composer::new(bundle);
        Self {
            observer: Observer::new(bundle, registry),
            queue: ActionQueue::new(bundle, registry, without_mask),
            mask,
            seed,
            situation: Situation { mask, observation_age: None },
            chunk: vec![0.0; composer.chunk_len()],
            composer,
        }
    }

    /// Takes a sample from the bus.
    pub fn receive(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]) {
        match topic {
            TopicId::Modality(id) => self.observer.push(id, header, payload),
            TopicId::Mask => {
                if let Some((Bits { mask, .. }, _)) = Bits::of_payload(payload) {
                    self.mask = mask;
                }
            }
            TopicId::Action | TopicId::Observation => {}
        }
    }

    /// The capture of the newest sample, once every modality that is present has sent one.
    pub fn first_sight(&self) -> Option<Stamp> {
        self.observer.first_sight(self.mask)
    }

    /// Observes tick number `number` of the control grid, at `tick`. Returns whether a request to the policy
    /// is due; if so, [`Self::fill`] fills it, and [`Self::answer`] or [`ActionQueue::failed`] must follow.
    pub fn observe(&mut self, number: u64, tick: Stamp, now: Stamp) -> bool {
        let observation_age = self.observer.observe(number, tick, now, self.mask);
        self.situation = Situation { mask: self.mask, observation_age };
        self.queue.wants_observation(number, self.situation)
    }

    /// Fills `request` for tick `number` at `tick`, the last one observed.
    pub fn fill(&self, number: u64, tick: Stamp, request: &mut Request) {
        (request.tick, request.stamp, request.mask) = (number, tick, self.mask);
        // Each request has its own seed, so that a chunk can be recomputed without the earlier ones.
        request.seed = self.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(number);
        self.observer.fill(request);
    }

    /// Takes the answer to `request`: the network's output `[Tp, Da]`, denormalised. Returns how many actions were
    /// skipped because it came more than one tick late.
    ///
    /// # Errors
    /// Why the chunk is not used; the previous one stays in use.
    pub fn answer(&mut self, request: &Request, output: &[f32]) -> Result<u64, ChunkError> {
        match self.composer.compose(request, output, &mut self.chunk) {
            Ok(()) => self.queue.accept_chunk(request.tick, &self.chunk),
            Err(reason) => Err(self.queue.refuse(request.tick, reason)),
        }
    }

    /// What the last answer wants executed, within no limits yet: `[Tp, executed values]`. NaN throughout if nothing
    /// follows from it.
    pub fn chunk(&self) -> &[f32] {
        &self.chunk
    }

    /// The action of tick `number`, after it was observed.
    pub fn step(&mut self, number: u64) -> Step<'_> {
        self.queue.step(number, self.situation)
    }
}
