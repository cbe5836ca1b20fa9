//! Where the actuator is to go: the topic of actions, for the one stream that reads the device.

use iceoryx2::port::subscriber::Subscriber;

use super::error::topic_error;
use super::guard::{Guarded, contained};
use super::{BusError, Service, TopicFactory, TopicSpec, sigbus};
use crate::action::MAX_ACTION;
use crate::sample::{Encoding, SampleHeader};
use crate::time::Stamp;

/// The consumer of actions.
pub struct Actions {
    topic: String,
    depth: usize,
    subscriber: Guarded<Subscriber<Service, [u8], SampleHeader>>,
}

impl std::fmt::Debug for Actions {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Actions").field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl Actions {
    pub(super) fn open(spec: &TopicSpec, factory: &TopicFactory) -> Result<Self, BusError> {
        let subscriber = factory.subscriber_builder().buffer_size(spec.depth).create();
        let subscriber = subscriber.map_err(|error| topic_error(&spec.name, &error))?;
        let subscriber = Guarded::new(subscriber);
        Ok(Self { topic: spec.name.clone(), depth: spec.depth, subscriber })
    }

    /// Forgets actions that were meant for a device before this one.
    pub fn discard(&self) {
        let _ = self.newest(&mut [0.0; MAX_ACTION]);
    }

    /// Writes the newest action that waits into `action` and forgets the older ones; gives it with the tick it
    /// is the action of, or `None` if none waits. What is no list of at most [`MAX_ACTION`] finite numbers is no action, whoever published it.
    pub fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Option<(&'a [f64], Stamp)> {
        let mut newest = None;
        for _ in 0..self.depth {
            let Ok(Ok(Some(sample))) = contained(|| self.subscriber.receive()) else { break };
            let sample = Guarded::new(sample);
            let (numbers, rest) = sample.payload().as_chunks::<8>();
            let is_numbers = sample.user_header().encoding == Encoding::F64 as u32 && rest.is_empty();
            let finite = numbers.iter().all(|number| f64::from_le_bytes(*number).is_finite());
            if !is_numbers || !finite || numbers.is_empty() || numbers.len() > MAX_ACTION {
                continue;
            }
            for (place, number) in action.iter_mut().zip(numbers) {
                *place = f64::from_le_bytes(*number);
            }
            newest = Some((numbers.len(), Stamp(sample.user_header().capture_ns)));
        }
        // What was read may be the zeros of a page that was lost, and no action.
        let (axes, tick) = newest.filter(|_| !sigbus::happened())?;
        Some((action.get(..axes)?, tick))
    }
}
