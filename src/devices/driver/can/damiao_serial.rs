//! The serial line of Damiao's USB2CAN adapter: 30 bytes to send a frame, 16 for each received.
//!
//! Source: the adapter's public host libraries (`DM_CAN.py`, `damiao.h`), which agree. To the adapter, at 921600
//! baud: `55 AA`, the length 0x1E, command 3 (send without an answer), how many times as u32, the interval as u32 in
//! 0.1 ms, 1 where the identifier has 29 bits, identifier as u32, 1 for a remote frame, the length of the data, two
//! zeros, 8 bytes of data, zero. From it: `AA`, command, a byte with length (6 bits), IDE and RTR, identifier as
//! u32, 8 bytes of data, `55`. Numbers are little endian.
//!
//! There is no check sum, and data may look like a head or a tail: where 16 bytes are no message, the search continues
//! one byte later.
//!
//! Invariant: no bytes make the decoder panic, and it holds less than one message of them.

use rapid_motors::control::can::CanFrame;

/// Bits a second of the line.
pub const BAUD: u32 = 921_600;
/// Bytes that send one frame.
pub const SENT: usize = 30;
/// Bytes of one message of the adapter.
pub const RECEIVED: usize = 16;

const HEAD: u8 = 0xaa;
const TAIL: u8 = 0x55;

/// The bytes that send `frame` once; `None` for an error frame, which cannot be sent.
pub fn encode(frame: &CanFrame) -> Option<[u8; SENT]> {
    if frame.error {
        return None;
    }
    let mut bytes = [0; SENT];
    bytes[..12].copy_from_slice(&[0x55, 0xaa, 0x1e, 0x03, 1, 0, 0, 0, 10, 0, 0, 0]);
    bytes[12] = u8::from(frame.extended);
    bytes[13..17].copy_from_slice(&frame.id.to_le_bytes());
    bytes[17] = u8::from(frame.remote);
    bytes[18] = frame.len.min(8);
    bytes[21..29].copy_from_slice(&frame.data);
    Some(bytes)
}

/// The kind of a message of the adapter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// The adapter is alive.
    Heartbeat = 0x00,
    /// A frame on the bus was not received.
    ReceiveFailed = 0x01,
    /// A frame was received.
    Received = 0x11,
    /// A frame was not sent.
    SendFailed = 0x02,
    /// A frame was sent.
    Sent = 0x12,
    /// The bit rate was not set.
    BaudFailed = 0x03,
    /// The bit rate was set.
    BaudSet = 0x13,
    /// The adapter cannot communicate with the bus.
    BusError = 0xee,
}

impl Kind {
    const ALL: [Self; 8] = [
        Self::Heartbeat,
        Self::ReceiveFailed,
        Self::Received,
        Self::SendFailed,
        Self::Sent,
        Self::BaudFailed,
        Self::BaudSet,
        Self::BusError,
    ];

    fn from_byte(byte: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| *kind as u8 == byte)
    }
}

/// A message of the adapter: its kind, and its frame if it has one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Message {
    /// What happened.
    pub kind: Kind,
    /// Meaningful where `kind` is [`Kind::Received`].
    pub frame: CanFrame,
}

/// Decodes messages from bytes that arrive in pieces.
#[derive(Debug, Clone, Default)]
pub struct Decoder {
    held: [u8; RECEIVED],
    len: usize,
    skipped: u64,
}

impl Decoder {
    /// Consumes bytes up to the end of at most one message; returns how many.
    pub fn feed(&mut self, bytes: &[u8]) -> (usize, Option<Message>) {
        for (at, byte) in bytes.iter().enumerate() {
            if let Some(message) = self.push(*byte) {
                return (at + 1, Some(message));
            }
        }
        (bytes.len(), None)
    }

    /// Bytes so far that belonged to no message.
    pub const fn skipped(&self) -> u64 {
        self.skipped
    }

    fn push(&mut self, byte: u8) -> Option<Message> {
        // Less than a message is held, so that there is always room.
        if let Some(place) = self.held.get_mut(self.len) {
            *place = byte;
            self.len += 1;
        }
        if self.len < RECEIVED {
            self.seek(0);
            return None;
        }
        let message = message(&self.held);
        if message.is_some() {
            self.len = 0;
        } else {
            self.seek(1);
        }
        message
    }

    /// Discards held bytes up to the next head at or after `from`.
    fn seek(&mut self, from: usize) {
        let held = self.held.get(from..self.len).unwrap_or_default();
        let gone = from + held.iter().position(|byte| *byte == HEAD).unwrap_or(held.len());
        if gone > 0 {
            self.held.copy_within(gone..self.len, 0);
            self.len -= gone;
            self.skipped += gone as u64;
        }
    }
}

fn message(bytes: &[u8; RECEIVED]) -> Option<Message> {
    let [HEAD, kind, format, id0, id1, id2, id3, data @ .., TAIL] = bytes else { return None };
    let kind = Kind::from_byte(*kind)?;
    let (len, extended, remote) = (format & 0x3f, format & 0x40 != 0, format & 0x80 != 0);
    let id = u32::from_le_bytes([*id0, *id1, *id2, *id3]);
    let legal = len <= 8 && id <= if extended { 0x1fff_ffff } else { 0x7ff };
    if kind == Kind::Received && !legal {
        return None;
    }
    let mut frame = CanFrame { id, extended, remote, error: false, len: len.min(8), data: [0; 8] };
    if !remote {
        let carried = frame.data.iter_mut().zip(data).take(usize::from(frame.len));
        carried.for_each(|(to, from)| *to = *from);
    }
    Some(Message { kind, frame })
}

#[cfg(test)]
mod tests;
