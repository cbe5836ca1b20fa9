//! A CAN bus: adapters of three kinds, the motors behind them, and a generator of frames.
//!
//! The bus exists whether its adapter is plugged in or not: a motor has its own power supply, continues when the cable
//! to the computer is unplugged, and stops by its own timeout.
//!
//! Invariant: no clock, no socket, no thread below this module; times are passed in as ns of CLOCK_MONOTONIC.

pub mod adapter;
pub mod bus;
pub mod damiao;
pub mod gsusb;
pub mod motion;
pub mod motor;
pub mod plant;
pub mod registers;
pub mod run;
pub mod slcan;

/// A classic CAN frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Frame {
    /// Identifier: 11 bits, or 29 of an extended frame.
    pub id: u32,
    /// The identifier has 29 bits.
    pub extended: bool,
    /// A request for data: it has a length and no bytes.
    pub remote: bool,
    len: u8,
    bytes: [u8; 8],
}

impl Frame {
    /// A data frame with a standard identifier.
    pub fn data(id: u16, bytes: [u8; 8]) -> Self {
        Self { id: u32::from(id & 0x7ff), len: 8, bytes, ..Self::default() }
    }

    /// A frame with these bytes; `None` if the identifier is too large or there are more than eight bytes.
    pub fn new(id: u32, extended: bool, remote: bool, len: usize, bytes: &[u8]) -> Option<Self> {
        let limit = if extended { 1 << 29 } else { 1 << 11 };
        let len = u8::try_from(len).ok().filter(|len| *len <= 8)?;
        if id >= limit || (!remote && bytes.len() != usize::from(len)) {
            return None;
        }
        let mut frame = Self { id, extended, remote, len, bytes: [0; 8] };
        if !remote {
            frame.bytes[..bytes.len()].copy_from_slice(bytes);
        }
        Some(frame)
    }

    /// Its bytes; a remote frame has none.
    pub fn bytes(&self) -> &[u8] {
        if self.remote { &[] } else { &self.bytes[..usize::from(self.len)] }
    }

    /// Data length code.
    pub fn len(&self) -> u8 {
        self.len
    }

    /// Carries no bytes.
    pub fn is_empty(&self) -> bool {
        self.bytes().is_empty()
    }

    /// All eight bytes, those after its length zero.
    pub fn padded(&self) -> [u8; 8] {
        self.bytes
    }
}

#[cfg(test)]
pub(crate) mod strategies {
    use proptest::prelude::*;

    use super::Frame;

    /// Any frame a classic bus can carry.
    pub(crate) fn frame() -> impl Strategy<Value = Frame> {
        let id = prop_oneof![(0_u32..1 << 11).prop_map(|id| (id, false)), (0_u32..1 << 29).prop_map(|id| (id, true))];
        (id, any::<bool>(), proptest::collection::vec(any::<u8>(), 0..=8)).prop_map(
            |((id, extended), remote, bytes)| {
                Frame::new(id, extended, remote, bytes.len(), &bytes).expect("within its limits")
            },
        )
    }
}
