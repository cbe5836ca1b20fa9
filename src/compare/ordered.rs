//! The samples and masks of an episode in the order in which they were received.
//!
//! A file has them in the order in which they were written, which within a topic is that order, and between
//! topics is nearly it.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use crate::driver::DriverError;
use crate::driver::replay::tape::{Content, Tape, Taped};
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::registry::Registry;
use crate::sample::{Epoch, SampleHeader};

/// By how much the order of the file may be another one: far more than the recorder takes from topic to
/// topic.
const SPAN_NS: u64 = 1_000_000_000;

/// What was received.
#[derive(Debug)]
pub(super) enum Received {
    Sample { id: ModalityId, header: SampleHeader, payload: Vec<u8> },
    Mask(PhysicalMask),
    Opened { id: ModalityId, epoch: Epoch },
}

/// See the module's comment.
#[derive(Debug)]
pub(super) struct Ordered<'a> {
    tape: Tape,
    registry: &'a Registry,
    /// By the time of receipt, then by the order of the file.
    held: BTreeMap<(u64, u64), Received>,
    read: u64,
    newest: u64,
    ended: bool,
}

/// A device was opened: its samples are of this epoch from now on.
#[derive(Deserialize)]
struct Opened {
    device: String,
    epoch: Epoch,
}

impl<'a> Ordered<'a> {
    pub(super) fn open(file: &Path, registry: &'a Registry) -> Result<Self, DriverError> {
        let tape = Tape::open(file)?;
        Ok(Self { tape, registry, held: BTreeMap::new(), read: 0, newest: 0, ended: false })
    }

    /// What was received next, and when, wall time; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<(u64, Received)>, DriverError> {
        loop {
            let oldest = self.held.first_key_value().map(|((at, _), _)| *at);
            if self.ended || oldest.is_some_and(|oldest| self.newest.saturating_sub(oldest) > SPAN_NS) {
                return Ok(self.held.pop_first().map(|((at, _), received)| (at, received)));
            }
            let Some(taped) = self.tape.next_message()? else {
                self.ended = true;
                continue;
            };
            let at = taped.publish_time;
            if let Some(received) = received(&taped, self.registry) {
                self.newest = self.newest.max(at);
                self.held.insert((at, self.read), received);
                self.read += 1;
            }
        }
    }
}

fn received(taped: &Taped<'_>, registry: &Registry) -> Option<Received> {
    match taped.content {
        Content::Mask(mask) => Some(Received::Mask(mask)),
        Content::Event { kind: "opened", json } => {
            let opened: Opened = serde_json::from_str(json).ok()?;
            Some(Received::Opened { id: registry.named(&opened.device)?.id, epoch: opened.epoch })
        }
        Content::Event { .. } => None,
        Content::Sample { encoding, width, height, bytes } => {
            let id = registry.devices.iter().find(|device| device.topic == taped.topic)?.id;
            let header = SampleHeader {
                seq: taped.sequence.into(),
                capture_ns: taped.log_time,
                recv_ns: taped.publish_time,
                id: id.bit().into(),
                encoding: encoding as u32,
                width,
                height,
                ..SampleHeader::default()
            };
            Some(Received::Sample { id, header, payload: bytes.to_vec() })
        }
    }
}
