//! Replay: one topic of a recorded episode, played as a device.
//!
//! The file is read a batch of messages ahead on the blocking pool; each is due at its recorded
//! distance from the scenario's beginning. When the messages are used up the device stays silent, as one that
//! hangs does.
//!
//! Invariant: the file is read chunk by chunk, never held whole.
//! Invariant: a damaged file ends the topic early or leaves out what is damaged; it never ends the
//! program.

mod episode;
mod scenario;
pub mod tape;
mod wire;

use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::task::JoinHandle;
use tokio::time::Instant;

use self::episode::{Episode, Messages};
pub use self::episode::{EpisodeDescription, TopicDescription, describe, read_bytes};
pub use self::scenario::{Replayed, scenario};
use self::wire::Shape;
use super::sim::stamp_of;
use super::{DriverError, Reading, unblock};
use crate::provenance::{KernelDriver, Negotiated};
use crate::registry::scenario::{SimDevice, SimSource};
use crate::sample::FLAG_DEVICE_TIME;
use crate::time::{Stamp, nanoseconds};

/// Messages read at once: at 1 kHz this bridges the reading of a chunk.
const BATCH: usize = 32;
/// Bytes of payload after which a batch is full, for large pictures.
const BATCH_BYTES: usize = 8 << 20;
/// How soon a pulled cable or a silence is noticed, at the latest.
const NOTICE: Duration = Duration::from_millis(10);
/// The first time a device is opened, what was recorded while it was being opened is still played.
const OPENING: Duration = Duration::from_secs(2);

/// A topic being played.
#[derive(Debug)]
pub struct Replay {
    device: Arc<SimDevice>,
    playing: Vec<Message>,
    /// The message of `playing` that is next.
    next: usize,
    /// The batch after `playing`; `None` once the file is used up.
    reading: Option<JoinHandle<Batch>>,
    description: String,
}

#[derive(Debug)]
struct Message {
    /// Recorded capture time after the episode's beginning.
    after: Duration,
    payload: Vec<u8>,
    shape: Shape,
}

/// The payload of one recorded message of the schema named so, with its width and height.
#[doc(hidden)]
#[must_use]
pub fn decode(schema: &str, message: &[u8]) -> Option<(Vec<u8>, u32, u32)> {
    let mut payload = Vec::new();
    let shape = wire::payload(wire::Schema::named(schema)?, message, &mut payload)?;
    Some((payload, shape.width, shape.height))
}

impl Replay {
    /// Begins to play the device's topic from the present moment of the scenario.
    ///
    /// # Errors
    /// When the file cannot be read, has no such topic, or the topic holds no samples.
    pub async fn open(device: Arc<SimDevice>) -> Result<Self, DriverError> {
        let SimSource::Replay { file, topic, begin_ns } = device.source.clone() else {
            return Err(DriverError::Fatal(format!("{} is not a recording", device.name)));
        };
        let elapsed = stamp_of(Instant::now()).since(device.begun);
        let is_first = device.sequence.load(Ordering::Acquire) == 0;
        let from = if is_first { elapsed.saturating_sub(OPENING) } else { elapsed };
        let from_ns = begin_ns.saturating_add(nanoseconds(from));
        let description = format!("replay of {topic} in {}", file.display());
        let messages = unblock(move || Episode::open(&file)?.play(&topic, from_ns)).await?;
        let reader = Reader { messages, begin_ns };
        let reading = Some(tokio::task::spawn_blocking(move || reader.batch(Vec::new())));
        Ok(Self { device, playing: Vec::new(), next: 0, reading, description })
    }

    /// The next recorded sample, when it is due.
    ///
    /// # Errors
    /// [`DriverError::Gone`] once the cable is pulled.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let captured = self.wait_due().await?;
        // Nothing waits from here on: a future that is dropped has taken no sample.
        self.device.sequence.fetch_add(1, Ordering::AcqRel);
        let Some(Message { payload, shape, .. }) = self.playing.get(self.next) else {
            return Err(DriverError::Gone);
        };
        self.next += 1;
        let Shape { encoding, width, height } = *shape;
        Ok(Reading { bytes: payload, encoding, captured, flags: FLAG_DEVICE_TIME, width, height, lost: 0 })
    }

    /// What is played.
    #[must_use]
    pub fn description(&self) -> &str {
        &self.description
    }

    /// The same for a recording of the replay: the file takes the place of the device.
    #[must_use]
    pub fn negotiated(&self) -> Negotiated {
        let version = Some(env!("CARGO_PKG_VERSION").to_owned());
        let driver = Some(KernelDriver { name: "rapid-replay".to_owned(), version });
        Negotiated { driver, bus: Some(self.description.clone()), ..Negotiated::default() }
    }

    /// Waits until the message at `next` is due.
    async fn wait_due(&mut self) -> Result<Stamp, DriverError> {
        loop {
            if self.device.is_unplugged() {
                return Err(DriverError::Gone);
            }
            let now = Instant::now();
            let Some(message) = self.playing.get(self.next) else {
                self.turn_over(now + NOTICE).await;
                continue;
            };
            let due = self.device.begun.after(message.after);
            let now_stamp = stamp_of(now);
            if due > now_stamp {
                tokio::time::sleep_until((now + due.since(now_stamp)).min(now + NOTICE)).await;
            } else if self.device.is_silent() {
                // What a silent device would have sent now is not sent later.
                self.next += 1;
            } else {
                return Ok(due);
            }
        }
    }

    /// Takes the batch that was read meanwhile and has the next one read; gives up at `until`.
    async fn turn_over(&mut self, until: Instant) {
        let Some(reading) = &mut self.reading else {
            // The file is used up.
            tokio::time::sleep_until(until).await;
            return;
        };
        // Dropped here, the handle and the batch behind it stay.
        let Ok(read) = tokio::time::timeout_at(until, reading).await else { return };
        self.reading = None;
        // It ends without a batch only when the runtime is going down.
        let Ok(Batch { messages, rest }) = read else { return };
        let used = std::mem::replace(&mut self.playing, messages);
        self.next = 0;
        self.reading = rest.map(|reader| tokio::task::spawn_blocking(move || reader.batch(used)));
    }
}

/// Messages, and what is to be read after them; `None` at the end of the file.
#[derive(Debug)]
struct Batch {
    messages: Vec<Message>,
    rest: Option<Reader>,
}

/// Reads the file, on the blocking pool.
#[derive(Debug)]
struct Reader {
    messages: Messages<File>,
    begin_ns: u64,
}

impl Reader {
    /// The next messages, in the memory of `used` ones. The file's end or its first damage is the end.
    fn batch(mut self, used: Vec<Message>) -> Batch {
        let mut spare = used.into_iter().map(|message| message.payload);
        let (mut messages, mut bytes) = (Vec::with_capacity(BATCH), 0);
        while messages.len() < BATCH && bytes < BATCH_BYTES {
            let next = match self.messages.next() {
                Ok(Some(next)) => next,
                Ok(None) => return Batch { messages, rest: None },
                Err(error) => {
                    tracing::warn!(%error, "the recording ends early");
                    return Batch { messages, rest: None };
                }
            };
            let mut payload = spare.next().unwrap_or_default();
            // A message that cannot be read was not recorded by us; it has no sample to play.
            let Some(shape) = wire::payload(next.schema, next.data, &mut payload) else { continue };
            let after = Duration::from_nanos(next.log_time.saturating_sub(self.begin_ns));
            bytes += payload.len();
            messages.push(Message { after, payload, shape });
        }
        Batch { messages, rest: Some(self) }
    }
}

fn fatal(file: &Path, why: impl std::fmt::Display) -> DriverError {
    DriverError::Fatal(format!("{}: {why}", file.display()))
}

#[cfg(test)]
mod tests;
