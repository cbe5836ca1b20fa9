//! Where the actuator should move: the topic of actions, for the thread or task that drives the actuator.
//!
//! An event service of the same name wakes it; actions of programs that do not notify are found by polling.
//!
//! Invariant: once this process, which runs a policy, has published an action, actions of other programs are ignored.
//! Invariant: a payload that is not a list of at most [`MAX_ACTION`] finite numbers is rejected.

use std::os::fd::{BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use rapid_core::action::{ActionSource, MAX_ACTION, NoAction};
use rapid_core::sample::Encoding;
use rapid_core::time::Stamp;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::error::topic_error;
use super::{BusError, EventFactory, Header, Service, TopicFactory, TopicSpec, Writer};

/// An event for a task to wait for; `None` where the system cannot watch it and the caller must poll.
pub fn watch(bell: BorrowedFd<'_>) -> Option<AsyncFd<OwnedFd>> {
    let bell = bell.try_clone_to_owned().ok()?;
    // SAFETY: the registered value owns one descriptor for its whole life.
    unsafe { AsyncFd::register_with_interest(bell, Interest::READABLE) }.ok()
}

/// The consumer of actions.
pub struct Actions {
    topic: String,
    depth: usize,
    subscriber: Subscriber<Service, [u8], Header>,
    listener: Listener<Service>,
    /// Publisher of this process.
    writer: UniquePublisherId,
    /// Set once `writer` has published.
    is_written: AtomicBool,
}

impl std::fmt::Debug for Actions {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Actions").field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl Actions {
    pub(super) fn open(
        spec: &TopicSpec,
        factory: &TopicFactory,
        wake: &EventFactory<Service>,
        writer: &Writer,
    ) -> Result<Self, BusError> {
        let subscriber = factory.subscriber_builder().buffer_size(spec.depth).create();
        let subscriber = subscriber.map_err(|error| topic_error(&spec.name, &error))?;
        let listener = wake.listener_builder().create();
        let listener = listener.map_err(|error| topic_error(&spec.name, &error))?;
        Ok(Self {
            topic: spec.name.clone(),
            depth: spec.depth,
            subscriber,
            listener,
            writer: writer.id(),
            is_written: AtomicBool::new(false),
        })
    }

    /// Discards actions that were meant for a previous device.
    pub fn discard(&self) {
        let _ = self.newest(&mut [0.0; MAX_ACTION]);
    }
}

impl ActionSource for Actions {
    fn bell(&self) -> Option<BorrowedFd<'_>> {
        // SAFETY: the descriptor belongs to the listener, which lives as long as `self` and does not close or replace
        // it before then.
        Some(unsafe { BorrowedFd::borrow_raw(self.listener.file_descriptor().native_handle()) })
    }

    fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction> {
        // First clear the event: what it announced is received below.
        let _ = self.listener.try_wait(|_| {});
        let (mut newest, mut refused) = (None, None);
        for _ in 0..self.depth {
            let Ok(Some(sample)) = self.subscriber.receive() else { break };
            if sample.header().publisher_id() == self.writer {
                self.is_written.store(true, Ordering::Relaxed);
            } else if self.is_written.load(Ordering::Relaxed) {
                refused = Some(NoAction::Foreign);
                continue;
            }
            let (numbers, rest) = sample.payload().as_chunks::<8>();
            let is_numbers = sample.user_header().encoding == Encoding::F64 as u32 && rest.is_empty();
            // Before they are read: another program's sample may have any length.
            let fits = (1..=MAX_ACTION).contains(&numbers.len());
            if !is_numbers || !fits || !numbers.iter().all(|number| f64::from_le_bytes(*number).is_finite()) {
                refused = Some(NoAction::NoNumbers);
                continue;
            }
            for (place, number) in action.iter_mut().zip(numbers) {
                *place = f64::from_le_bytes(*number);
            }
            newest = Some((numbers.len(), Stamp(sample.user_header().capture_ns)));
        }
        match (newest, refused) {
            (Some((axes, tick)), _) => Ok(action.get(..axes).map(|numbers| (numbers, tick))),
            (None, Some(refused)) => Err(refused),
            (None, None) => Ok(None),
        }
    }
}
