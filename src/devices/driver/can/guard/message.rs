//! What a guard is told, and under which name it runs.
//!
//! A message is a byte, `OFF`, `ON`, `DISMISSED` or `BRAKE`. After `ON` come the bits of the motors whose brakes are
//! to be engaged at once (u16, little endian; the others are when the motors are disabled), and a frame of `FRAME` bytes
//! for each motor; after `BRAKE` the bits of the motors of a brake, and the level that engages it, 0 or 1, with the open
//! line as a descriptor, or without one when it was closed.

use std::time::Duration;

use rapid_motors::control::can::CanFrame;
use rapid_registry::MAX_MOTORS;

/// Argument 0 of the guard. It does not contain "rapid": `pkill rapid` must not end the guard.
pub const NAME: &str = "motor-guard";
/// How long motors that are not to be limp are damped, or hold, before they are disabled: a damped joint has sunk to
/// rest by then, and nothing stays on unattended for longer.
pub const KEEP_FOR: Duration = Duration::from_secs(5);

/// No motor is on.
pub(super) const OFF: u8 = 0;
/// Motors are on; their last will follows.
pub(super) const ON: u8 = 1;
/// It is no longer needed.
pub(super) const DISMISSED: u8 = 2;
/// The line of a brake.
pub(super) const BRAKE: u8 = 3;
/// Bytes of a frame: identifier (u32, little endian), length, three zeros, data.
pub(super) const FRAME: usize = 16;
pub(super) const LONGEST: usize = 3 + MAX_MOTORS * FRAME;

pub(super) fn encode(frame: &CanFrame) -> [u8; FRAME] {
    let mut bytes = [0; FRAME];
    bytes[..4].copy_from_slice(&frame.id.to_le_bytes());
    bytes[4] = frame.len;
    bytes[8..].copy_from_slice(&frame.data);
    bytes
}

pub(super) fn decode(bytes: &[u8; FRAME]) -> CanFrame {
    let [a, b, c, d, len, _, _, _, data @ ..] = *bytes;
    CanFrame { id: u32::from_le_bytes([a, b, c, d]), len: len.min(8), data, ..CanFrame::default() }
}
