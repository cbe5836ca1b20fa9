//! What the recorder takes its samples from.

use std::time::Duration;

use crate::modality::ModalityId;
use crate::sample::SampleHeader;

/// Where a sample comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SourceTopic {
    /// A modality.
    Modality(ModalityId),
    /// The physical mask: the payload is u64 mask, u64 sequence, little endian.
    Mask,
}

/// A consumer's end of the bus.
pub trait Source: Send {
    /// Waits until something was published or `timeout` has passed.
    ///
    /// # Errors
    /// When the bus cannot be waited on; the text says why.
    fn wait(&mut self, timeout: Duration) -> Result<(), String>;

    /// Hands over every sample that waits, oldest first within a topic; bytes are lent for the call.
    ///
    /// # Errors
    /// When the bus cannot be read; the text says why.
    fn drain(&mut self, take: &mut dyn FnMut(SourceTopic, &SampleHeader, &[u8])) -> Result<(), String>;
}

impl Source for crate::bus::Inbox {
    fn wait(&mut self, timeout: Duration) -> Result<(), String> {
        Self::wait(self, timeout).map_err(|error| error.to_string())
    }

    fn drain(&mut self, take: &mut dyn FnMut(SourceTopic, &SampleHeader, &[u8])) -> Result<(), String> {
        Self::drain(self, &mut |topic, header, bytes| {
            let topic = match topic {
                crate::bus::TopicId::Modality(id) => SourceTopic::Modality(id),
                crate::bus::TopicId::Mask => SourceTopic::Mask,
            };
            take(topic, header, bytes);
        })
        .map_err(|error| error.to_string())
    }
}
