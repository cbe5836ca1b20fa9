//! Replay: one topic of a recorded episode, played as a device.
//!
//! A thread reads the file a few messages ahead; what it hands over is due at the recorded distance
//! from the scenario's beginning. When the messages are used up the device stays silent, as one that
//! hangs does.
//!
//! Invariant: the file is read chunk by chunk, never held whole.
//! Invariant: a damaged file ends the topic early; it never ends the program.

mod episode;
mod wire;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::Instant;

use self::episode::{Episode, Messages};
pub use self::episode::{EpisodeDescription, TopicDescription, describe, scenario};
use self::wire::{Schema, Shape};
use super::sim::stamp_of;
use super::{DriverError, Reading, unblock};
use crate::registry::scenario::{SimDevice, SimSource};
use crate::sample::FLAG_DEVICE_TIME;
use crate::time::{Stamp, nanoseconds};

/// Messages read ahead: at 1 kHz this bridges the reading of a chunk.
const AHEAD: usize = 32;
/// How soon a pulled cable or a silence is noticed, at the latest.
const NOTICE: Duration = Duration::from_millis(10);
/// The first time a device is opened, what was recorded while it was being opened is still played.
const OPENING: Duration = Duration::from_secs(2);

/// A topic being played.
#[derive(Debug)]
pub struct Replay {
    device: Arc<SimDevice>,
    messages: mpsc::Receiver<Message>,
    /// Used buffers, back to the thread.
    used: mpsc::Sender<Vec<u8>>,
    /// Read from the file, not yet due.
    waiting: Option<Message>,
    current: Option<Message>,
    is_over: bool,
    description: String,
}

#[derive(Debug)]
struct Message {
    /// Recorded capture time after the episode's beginning.
    after: Duration,
    payload: Vec<u8>,
    shape: Shape,
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
        let (messages, schema) = unblock(move || Episode::open(&file)?.play(&topic, from_ns)).await?;
        let (ahead, receiver) = mpsc::channel(AHEAD);
        let (used, returned) = mpsc::channel(AHEAD + 2);
        std::thread::Builder::new()
            .name("replay".to_owned())
            .spawn(move || read_ahead(messages, schema, begin_ns, &ahead, returned))
            .map_err(|error| DriverError::Retry(format!("no thread to read the recording: {error}")))?;
        Ok(Self { device, messages: receiver, used, waiting: None, current: None, is_over: false, description })
    }

    /// The next recorded sample, when it is due.
    ///
    /// # Errors
    /// [`DriverError::Gone`] once the cable is pulled.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let captured = self.wait_due().await?;
        // Nothing waits from here on: a future that is dropped has taken no sample.
        self.device.sequence.fetch_add(1, Ordering::AcqRel);
        if let Some(previous) = self.current.take() {
            // A full channel has buffers enough.
            let _ = self.used.try_send(previous.payload);
        }
        self.current = self.waiting.take();
        let Some(Message { payload, shape, .. }) = &self.current else { return Err(DriverError::Gone) };
        let Shape { encoding, width, height } = *shape;
        Ok(Reading { bytes: payload, encoding, captured, flags: FLAG_DEVICE_TIME, width, height, lost: 0 })
    }

    /// What is played.
    #[must_use]
    pub fn description(&self) -> &str {
        &self.description
    }

    async fn wait_due(&mut self) -> Result<Stamp, DriverError> {
        loop {
            if self.device.is_unplugged() {
                return Err(DriverError::Gone);
            }
            let now = Instant::now();
            let Some(message) = &self.waiting else {
                if self.is_over {
                    tokio::time::sleep_until(now + NOTICE).await;
                    continue;
                }
                // Dropped between the two, a receive leaves the message in the channel.
                if let Ok(received) = tokio::time::timeout_at(now + NOTICE, self.messages.recv()).await {
                    self.is_over = received.is_none();
                    self.waiting = received;
                }
                continue;
            };
            let due = self.device.begun.after(message.after);
            let now_stamp = stamp_of(now);
            if due > now_stamp {
                tokio::time::sleep_until((now + due.since(now_stamp)).min(now + NOTICE)).await;
            } else if self.device.is_silent() {
                // What a silent device would have sent now is not sent later.
                self.waiting = None;
            } else {
                return Ok(due);
            }
        }
    }
}

/// The thread's work: ends with the file, with its first damage, or when nobody listens any more.
fn read_ahead(
    mut messages: Messages,
    schema: Schema,
    begin_ns: u64,
    ahead: &mpsc::Sender<Message>,
    mut returned: mpsc::Receiver<Vec<u8>>,
) {
    loop {
        let mut payload = returned.try_recv().unwrap_or_default();
        let next = match messages.next() {
            Ok(Some(next)) => next,
            Ok(None) => return,
            Err(error) => {
                tracing::warn!(%error, "the recording ends early");
                return;
            }
        };
        // A message that cannot be read was not recorded by us; it has no sample to play.
        let Some(shape) = wire::payload(schema, next.data, &mut payload) else { continue };
        let after = Duration::from_nanos(next.log_time.saturating_sub(begin_ns));
        if ahead.blocking_send(Message { after, payload, shape }).is_err() {
            return;
        }
    }
}

fn fatal(file: &Path, why: impl std::fmt::Display) -> DriverError {
    DriverError::Fatal(format!("{}: {why}", file.display()))
}

#[cfg(test)]
mod tests;
