//! Parts of a device that send on their own clock: a camera, a serial line.
//!
//! Invariant: no clock, no socket, no thread; a number is used up only by data that was sent completely.

use std::time::Duration;

/// A stream that runs, and how often it has data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Live {
    /// Changes when the host starts another stream.
    pub stream: u32,
    /// Time between two frames or lines.
    pub period: Duration,
}

/// What sends through one bulk endpoint of a device, a frame or line at each tick.
pub trait Source {
    /// The running stream, if there is one.
    fn live(&self) -> Option<Live>;

    /// Writes the next frame or line over `out`; `sent_ns` is the time of CLOCK_MONOTONIC.
    fn produce(&self, sent_ns: u64, out: &mut Vec<u8>);

    /// Appends the packet (at most `room` bytes) that continues `whole` at `at`; returns where the next one continues.
    fn packet(&self, whole: &[u8], at: usize, room: usize, out: &mut Vec<u8>) -> usize;

    /// The output of `produce` was sent completely: the next one gets the next number.
    fn sent(&mut self);
}
