//! What only the recorder makes, for those who show an episode while it is recorded: the frame index, and where the sensors of
//! the mounted modules sit.
//!
//! Invariant: the bytes are those that were written to the file.
//! Invariant: nothing here waits, allocates or locks: without room in the channel a message is left out.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use rapid_core::modality::MAX_MODALITIES;

/// A message about a modality takes at most this many bytes in a `rapid.Frame`: tag, length, and its fields.
const OF_A_SLOT: usize = 36;
/// Bytes of the largest message: a frame of every modality, with its head. A transform is shorter, because the names of
/// frames are.
const MOST: usize = 64 + MAX_MODALITIES * OF_A_SLOT;
/// Messages that wait, at most: two seconds of frames at 30 Hz.
const WAITING: usize = 64;

/// Which message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MadeKind {
    /// None: an episode begins, and the transforms of the one before are no longer valid.
    Beginning,
    /// A `rapid.Frame`: a tick of the frame index.
    Frame,
    /// A `foxglove.FrameTransform`: where a sensor of a mounted module sits.
    Transform,
}

/// A message as it was written.
#[derive(Debug, Clone, Copy)]
pub struct Made {
    /// Which message.
    pub kind: MadeKind,
    /// Its time in the file, ns since 1970.
    pub log_time: u64,
    length: usize,
    bytes: [u8; MOST],
}

impl Made {
    /// Its bytes.
    pub fn message(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }
}

/// Gives messages to one who shows them.
#[derive(Debug, Clone)]
pub struct Shown(SyncSender<Made>);

impl Shown {
    /// A channel.
    pub fn channel() -> (Self, Receiver<Made>) {
        let (sender, receiver) = sync_channel(WAITING);
        (Self(sender), receiver)
    }

    /// Gives this message, if there is room for it.
    pub(crate) fn show(&self, kind: MadeKind, log_time: u64, message: &[u8]) {
        let mut made = Made { kind, log_time, length: message.len(), bytes: [0; MOST] };
        if let Some(room) = made.bytes.get_mut(..message.len()) {
            room.copy_from_slice(message);
            // Full, or no one shows them any more: the file has it.
            let _ = self.0.try_send(made);
        }
    }
}

#[cfg(test)]
mod tests {
    use rapid_core::mask::PhysicalMask;
    use rapid_core::modality::ModalityId;
    use rapid_core::observation::{Observation, ObservationSlot};
    use rapid_core::time::Stamp;

    use super::super::encode;
    use super::*;

    #[test]
    fn the_largest_frame_has_room() {
        let slots = (0..64).filter_map(ModalityId::new).map(|id| ObservationSlot {
            plugged: true,
            present: true,
            valid: true,
            stale: true,
            age_ns: i64::MIN,
            seq: Some(u64::MAX),
            ..ObservationSlot::empty(id)
        });
        let observation = Observation { tick: Stamp(u64::MAX), mask: PhysicalMask(u64::MAX), slots: slots.collect() };
        let mut message = Vec::new();
        encode::frame(&mut message, u64::MAX, u64::MAX, &observation);
        let (shown, made) = Shown::channel();
        shown.show(MadeKind::Frame, 7, &message);
        let made = made.try_recv().unwrap();
        assert_eq!((made.log_time, made.message()), (7, message.as_slice()));
    }

    #[test]
    fn without_room_a_message_is_left_out() {
        let (shown, made) = Shown::channel();
        for number in 0..WAITING as u64 + 3 {
            shown.show(MadeKind::Frame, number, b"x");
        }
        let numbers: Vec<_> = made.try_iter().map(|made| made.log_time).collect();
        assert_eq!(numbers, (0..WAITING as u64).collect::<Vec<_>>());
        shown.show(MadeKind::Frame, 0, &[0; MOST + 1]);
        assert!(made.try_recv().is_err(), "none is cut");
        drop(made);
        shown.show(MadeKind::Frame, 0, b"x");
    }
}
