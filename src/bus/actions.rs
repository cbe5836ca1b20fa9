//! Where the actuator is to go: the topic of actions, for the one stream that reads the device.
//!
//! Invariant: once this process, which runs a policy, has published an action, those of other programs move nothing.
//! Invariant: what is no list of at most [`MAX_ACTION`] finite numbers is no action, whoever published it.

use std::sync::atomic::{AtomicBool, Ordering};

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::subscriber::Subscriber;

use super::error::topic_error;
use super::guard::{Guarded, contained};
use super::{BusError, Service, TopicFactory, TopicSpec, Writer, sigbus};
use crate::action::MAX_ACTION;
use crate::sample::{Encoding, SampleHeader};
use crate::time::Stamp;

/// The consumer of actions.
pub struct Actions {
    topic: String,
    depth: usize,
    subscriber: Guarded<Subscriber<Service, [u8], SampleHeader>>,
    /// The one of this process.
    writer: UniquePublisherId,
    /// It has published.
    is_written: AtomicBool,
}

/// Why what was published moves nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NoAction {
    /// It is no list of finite numbers.
    #[error("an action is no list of 1 to {MAX_ACTION} finite 64-bit floats")]
    NoNumbers,
    /// A policy of this process drives the actuator.
    #[error("another program publishes actions while a policy runs here: end one of them")]
    Foreign,
}

impl std::fmt::Debug for Actions {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Actions").field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl Actions {
    pub(super) fn open(spec: &TopicSpec, factory: &TopicFactory, writer: &Writer) -> Result<Self, BusError> {
        let subscriber = factory.subscriber_builder().buffer_size(spec.depth).create();
        let subscriber = subscriber.map_err(|error| topic_error(&spec.name, &error))?;
        let subscriber = Guarded::new(subscriber);
        Ok(Self {
            topic: spec.name.clone(),
            depth: spec.depth,
            subscriber,
            writer: writer.id(),
            is_written: AtomicBool::new(false),
        })
    }

    /// Forgets actions that were meant for a device before this one.
    pub fn discard(&self) {
        let _ = self.newest(&mut [0.0; MAX_ACTION]);
    }

    /// Writes the newest action that waits into `action` and forgets the older ones; gives it with the tick it
    /// is the action of, or `None` if none waits.
    ///
    /// # Errors
    /// When nothing but what is no action, or is not to be followed, waited.
    pub fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction> {
        let (mut newest, mut refused) = (None, None);
        for _ in 0..self.depth {
            let Ok(Ok(Some(sample))) = contained(|| self.subscriber.receive()) else { break };
            let sample = Guarded::new(sample);
            if sample.header().publisher_id() == self.writer {
                self.is_written.store(true, Ordering::Relaxed);
            } else if self.is_written.load(Ordering::Relaxed) {
                refused = Some(NoAction::Foreign);
                continue;
            }
            let (numbers, rest) = sample.payload().as_chunks::<8>();
            let is_numbers = sample.user_header().encoding == Encoding::F64 as u32 && rest.is_empty();
            let finite = numbers.iter().all(|number| f64::from_le_bytes(*number).is_finite());
            if !is_numbers || !finite || numbers.is_empty() || numbers.len() > MAX_ACTION {
                refused = Some(NoAction::NoNumbers);
                continue;
            }
            for (place, number) in action.iter_mut().zip(numbers) {
                *place = f64::from_le_bytes(*number);
            }
            newest = Some((numbers.len(), Stamp(sample.user_header().capture_ns)));
        }
        // What was read may be the zeros of a page that was lost, and no action.
        if sigbus::happened() {
            return Ok(None);
        }
        match (newest, refused) {
            (Some((axes, tick)), _) => Ok(action.get(..axes).map(|numbers| (numbers, tick))),
            (None, Some(refused)) => Err(refused),
            (None, None) => Ok(None),
        }
    }
}
