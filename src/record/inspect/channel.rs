//! What is counted of the messages of one channel.
//!
//! Invariant: memory is fixed, however many messages there are.

use super::super::quality::Tally;
use super::{Lateness, TopicReport};
use crate::episode_format::FRAME_TOPIC;
use crate::modality::ModalityId;

/// A channel and what came on it.
#[derive(Debug, Default)]
pub(super) struct Channel {
    pub(super) topic: String,
    /// The modality, if it is one's, and its name.
    pub(super) id: Option<ModalityId>,
    pub(super) modality: Option<String>,
    messages: u64,
    first: u64,
    previous: u64,
    latest: u64,
    longest_gap: u64,
    next: u32,
    missing: u64,
    /// Receipt minus capture. Absent without messages: a file may define thousands of channels.
    lateness: Option<Tally>,
}

impl Channel {
    pub(super) fn new(topic: String, id: Option<ModalityId>, modality: Option<String>) -> Self {
        Self { topic, id, modality, ..Self::default() }
    }

    pub(super) fn count(&mut self, sequence: u32, captured: u64, received: u64) {
        if self.messages == 0 {
            (self.first, self.latest) = (captured, captured);
        } else {
            self.longest_gap = self.longest_gap.max(captured.saturating_sub(self.previous));
            // Numbers wrap after 32 bits; a step of more than half of that goes backwards.
            let step = sequence.wrapping_sub(self.next);
            self.missing += u64::from(if step <= u32::MAX / 2 { step } else { 0 });
        }
        self.messages += 1;
        self.next = sequence.wrapping_add(1);
        self.previous = captured;
        self.first = self.first.min(captured);
        self.latest = self.latest.max(captured);
        self.lateness.get_or_insert_with(Tally::new).push(received.saturating_sub(captured));
    }

    pub(super) fn report(&self) -> TopicReport {
        let span = super::collect::from(self.first, self.latest);
        let hz = if self.messages > 1 && span > 0.0 { (self.messages - 1) as f64 / span } else { 0.0 };
        // A frame waits for its deadline, always as long.
        let lateness = self.lateness.as_ref().filter(|_| self.topic != FRAME_TOPIC).and_then(Lateness::of);
        TopicReport {
            topic: self.topic.clone(),
            messages: self.messages,
            hz,
            missing: self.missing,
            longest_gap: self.longest_gap as f64 / 1e9,
            lateness,
        }
    }
}

impl Lateness {
    /// Of the times of a tally; `None` without any.
    pub(super) fn of(times: &Tally) -> Option<Self> {
        times.spread().map(|spread| Self { p50: spread.p50, p99: spread.p99, max: spread.max })
    }
}
