//! A topic's writer: one copy from the driver's buffer into shared memory.
//!
//! Invariant: a pool whose first page is lost or overwritten is not written to: it holds iceoryx2's write position.

use std::fs::File;
use std::mem::{ManuallyDrop, MaybeUninit};
use std::os::unix::fs::FileExt;

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::LoanError;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::*;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use rapid_core::modality::MAX_MODALITIES;
use rapid_core::sample::SampleHeader;

use super::containment::{Guarded, contained};
use super::error::topic_error;
use super::{BusError, EventFactory, Header, Service, TopicFactory, TopicId, TopicSpec, sigbus, space, stale_files};

type Loan = SampleMutUninit<Service, [MaybeUninit<u8>], Header>;
type Filled = SampleMut<Service, [u8], Header>;

/// The one writer of a topic.
pub struct Writer {
    topic: String,
    max_bytes: usize,
    publisher: Guarded<Publisher<Service, [u8], Header>>,
    /// The publisher's segment, to check its first page.
    pool: Option<File>,
    /// First the actuator's, which is the most urgent, then those of all consumers.
    wakes: Vec<Guarded<Notifier<Service>>>,
}

impl std::fmt::Debug for Writer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Writer").field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl Writer {
    /// `own` is the event service of this topic alone, if any.
    pub(super) fn open(
        spec: &TopicSpec,
        factory: &TopicFactory,
        wake: &EventFactory<Service>,
        own: Option<&EventFactory<Service>>,
    ) -> Result<Self, BusError> {
        // A topic that another program kept open from an earlier run may have deeper queues than requested.
        let samples = TopicSpec::pool_for(factory.static_config().subscriber_max_buffer_size().max(spec.depth));
        let publisher = factory
            .publisher_builder()
            .initial_max_slice_len(spec.max_bytes)
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(1)
            .override_sample_preallocation(move |_| samples)
            // A reader that does not keep up loses samples; the writer never waits for it.
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|error| topic_error(&spec.name, &error))?;
        let event = match spec.id {
            TopicId::Modality(modality) => Some(modality.index()),
            // Consumers poll the mask; 500 wake-ups a second would be useless to them. Who waits for samples is awake
            // at their observation.
            TopicId::Mask | TopicId::Observation => None,
            TopicId::Action => Some(MAX_MODALITIES),
        };
        let notifiers = own.map(|own| (own, 0)).into_iter().chain(event.map(|event| (wake, event)));
        let wakes = notifiers
            .map(|(service, event)| {
                let notifier = service.notifier_builder().default_event_id(EventId::new(event)).create();
                notifier.map(Guarded::new).map_err(|error| topic_error(&spec.name, &error))
            })
            .collect::<Result<_, _>>()?;
        let publisher = Guarded::new(publisher);
        let pool = pool(publisher.id());
        Ok(Self { topic: spec.name.clone(), max_bytes: spec.max_bytes, publisher, pool, wakes })
    }

    /// Identifies this writer in every sample it publishes.
    pub(super) fn id(&self) -> UniquePublisherId {
        self.publisher.id()
    }

    /// Publishes one sample and wakes the consumers.
    ///
    /// # Errors
    /// When the payload is larger than the topic allows, the pool is exhausted because a dead subscriber still holds
    /// samples, or memory of the bus has been lost.
    pub fn publish(&self, header: SampleHeader, payload: &[u8]) -> Result<(), BusError> {
        if payload.len() > self.max_bytes {
            let (size, max) = (payload.len(), self.max_bytes);
            return Err(BusError::TooLarge { topic: self.topic.clone(), size, max });
        }
        // One system call; takes a fraction of a microsecond.
        let mut head = [0; 8];
        let is_whole = |pool: &File| pool.read_exact_at(&mut head, 0).is_ok() && stale_files::is_head(head);
        if !self.pool.as_ref().is_none_or(is_whole) {
            sigbus::damaged();
        }
        contained(|| self.send(header, payload))?
    }

    fn send(&self, header: SampleHeader, payload: &[u8]) -> Result<(), BusError> {
        let sample =
            self.publisher.loan_slice_uninit(payload.len()).map_err(|error| self.transfer(&describe(error)))?;
        let sample = filled(sample, header, payload)?;
        sample.send().map_err(|error| self.transfer(&format!("{error:?}")))?;
        for wake in &self.wakes {
            // A consumer that cannot be woken polls soon after; the sample is not lost.
            let _ = wake.notify();
        }
        Ok(())
    }

    fn transfer(&self, reason: &str) -> BusError {
        BusError::Transfer { topic: self.topic.clone(), reason: reason.to_owned() }
    }
}

/// A loaned sample with this content.
///
/// Its length is in shared memory, where another program may have overwritten it since the loan. iceoryx2 panics over that,
/// and again when the panic drops the sample, which ends the process: such a sample is never dropped.
fn filled(loan: Loan, header: SampleHeader, payload: &[u8]) -> Result<Filled, BusError> {
    let mut loan = ManuallyDrop::new(loan);
    *loan.user_header_mut() = Header(header);
    let place = loan.payload_mut();
    if place.len() != payload.len() {
        sigbus::damaged();
        return Err(sigbus::error());
    }
    // SAFETY: both are as long as checked, and a loan is no one else's. Every byte is written before it is assumed to be.
    unsafe {
        std::ptr::copy_nonoverlapping(payload.as_ptr(), place.as_mut_ptr().cast(), payload.len());
        Ok(ManuallyDrop::into_inner(loan).assume_init())
    }
}

/// The segment that contains a publisher's samples.
fn pool(publisher: UniquePublisherId) -> Option<File> {
    let ending = format!("_{}.data", publisher.value());
    let mut entries = std::fs::read_dir(space::PLACE).ok()?.flatten();
    let found = entries.find(|entry| entry.file_name().to_str().is_some_and(|name| name.ends_with(&ending)))?;
    File::open(found.path()).ok()
}

fn describe(error: LoanError) -> String {
    match error {
        LoanError::OutOfMemory => "the pool is exhausted: a subscriber holds too many samples".to_owned(),
        other => format!("{other:?}"),
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd as _;

    use super::super::Bus;
    use super::super::tests::registry;
    use super::*;

    const DEPTH: usize = 16;

    /// A writer whose loan or sample is overwritten, at a moment that `publish` cannot be stopped at.
    fn overwritten(name: &str, work: impl FnOnce(&Writer, &dyn Fn()) -> Result<(), BusError>) {
        let registry = registry(DEPTH);
        let bus = Bus::open(&registry, Some(&format!("{name}{}", std::process::id()))).unwrap();
        let _inbox = bus.inbox().unwrap();
        let writer = bus.writer(TopicId::Modality(registry.devices[0].id)).unwrap();
        // More than the consumer's queue holds: the next sample pushes one out of it, which returns to the pool.
        for _ in 0..2 * DEPTH {
            writer.publish(SampleHeader::default(), &[7; 24]).unwrap();
        }
        let segment = format!("/proc/self/fd/{}", writer.pool.as_ref().unwrap().as_raw_fd());
        let segment = File::options().write(true).open(segment).unwrap();
        let error =
            contained(|| work(&writer, &|| segment.write_all_at(&[0; 4096], 0).unwrap())).flatten().unwrap_err();
        assert!(matches!(&error, BusError::Lost { file } if file.to_string_lossy().ends_with(".data")), "{error}");
        assert!(sigbus::happened() && writer.publish(SampleHeader::default(), &[7; 24]).is_err());
    }

    /// Not a test of its own: its effect on the process is permanent.
    #[test]
    #[ignore = "run by a_sample_whose_memory_is_overwritten_ends_the_use_of_the_bus_and_not_the_process"]
    fn before_it_is_filled() {
        overwritten("busw", |writer, overwrite| {
            let loan = writer.publisher.loan_slice_uninit(24).unwrap();
            overwrite();
            filled(loan, SampleHeader::default(), &[7; 24]).map(drop)
        });
    }

    /// As above.
    #[test]
    #[ignore = "run by a_sample_whose_memory_is_overwritten_ends_the_use_of_the_bus_and_not_the_process"]
    fn before_it_is_sent() {
        overwritten("busx", |writer, overwrite| {
            let sample = filled(writer.publisher.loan_slice_uninit(24).unwrap(), SampleHeader::default(), &[7; 24])?;
            overwrite();
            sample.send().map_err(|error| writer.transfer(&format!("{error:?}"))).map(drop)
        });
    }

    #[test]
    fn a_sample_whose_memory_is_overwritten_ends_the_use_of_the_bus_and_not_the_process() {
        for name in ["before_it_is_filled", "before_it_is_sent"] {
            let ended = std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--exact", &format!("writer::tests::{name}"), "--ignored", "--nocapture"])
                .output()
                .unwrap();
            // Of a name that fits no test nothing runs, and nothing fails.
            let passed = String::from_utf8_lossy(&ended.stdout).contains("1 passed");
            assert!(ended.status.success() && passed, "{name}: {ended:?}");
        }
    }
}
