//! What the recorder takes its samples from: an inbox of the bus, or a test's script.

use std::time::Duration;

use crate::bus::{Foreign, Inbox, TopicId};
use crate::sample::SampleHeader;

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
    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String>;

    /// Hands over who else has published on our topics since the last call; none, unless the source can know.
    fn foreign(&mut self, take: &mut dyn FnMut(Foreign<'_>)) {
        let _ = take;
    }

    /// Why what is drained can be relied on no longer.
    fn lost(&self) -> Option<String> {
        None
    }
}

impl Source for Inbox {
    fn wait(&mut self, timeout: Duration) -> Result<(), String> {
        Self::wait(self, timeout).map_err(|error| error.to_string())
    }

    fn drain(&mut self, take: &mut dyn FnMut(TopicId, &SampleHeader, &[u8])) -> Result<(), String> {
        Self::drain(self, take).map_err(|error| error.to_string())
    }

    fn foreign(&mut self, take: &mut dyn FnMut(Foreign<'_>)) {
        Self::foreign(self, take);
    }

    fn lost(&self) -> Option<String> {
        Self::lost(self).map(|error| error.to_string())
    }
}
