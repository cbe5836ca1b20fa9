//! A policy in control: its observation at each tick, its requests, and the action of the tick.
//!
//! [`Observer`] and [`ActionQueue`] put together, without thread, clock or network: the caller keeps the time, names
//! the tick, and carries requests to a [`Model`](super::model::Model) and answers back.
//!
//! Invariant: an answer belongs to the request that is out; there is one at most.

use std::time::Duration;

use super::bundle::Bundle;
use super::horizon::{ActionQueue, Situation, Step, WithoutMask};
use super::observer::Observer;
use super::request::Request;
use crate::bus::TopicId;
use crate::mask::PhysicalMask;
use crate::registry::Registry;
use crate::sample::SampleHeader;
use crate::time::Stamp;

/// The first tick is this much later than the capture of the newest sample that it waited for: what a device and
/// the bus take.
pub const FIRST_TICK_AFTER: Duration = Duration::from_millis(10);

/// See the module's comment.
#[derive(Debug)]
pub struct Pilot {
    /// What is seen; takes samples.
    pub observer: Observer,
    /// What is done; takes the answers to requests.
    pub queue: ActionQueue,
    /// The mask in force, as it was published last.
    pub mask: PhysicalMask,
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
            queue: ActionQueue::new(bundle, registry, without_mask),
            mask,
            seed,
            situation: Situation { mask, observation_age: None },
        }
    }

    /// Takes what the bus brought.
    pub fn take(&mut self, topic: TopicId, header: &SampleHeader, payload: &[u8]) {
        match topic {
            TopicId::Modality(id) => self.observer.push(id, header, payload),
            TopicId::Mask => {
                if let Some(mask) = payload.first_chunk() {
                    self.mask = PhysicalMask(u64::from_le_bytes(*mask));
                }
            }
            TopicId::Action => {}
        }
    }

    /// The capture of the newest sample, once every modality that is present has sent one.
    #[must_use]
    pub fn first_sight(&self) -> Option<Stamp> {
        self.observer.first_sight(self.mask)
    }

    /// Looks at tick number `number` of the control grid, which is at `tick`. Returns whether a request to the policy
    /// is due; if so, [`Self::fill`] fills it, and [`ActionQueue::take`] or [`ActionQueue::failed`] must follow.
    pub fn look(&mut self, number: u64, tick: Stamp, now: Stamp) -> bool {
        let observation_age = self.observer.look(tick, now, self.mask);
        self.situation = Situation { mask: self.mask, observation_age };
        self.queue.wants_observation(number, self.situation)
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
        self.queue.step(number, self.situation)
    }
}
