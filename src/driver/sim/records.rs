//! What a simulated device sends whose samples are bytes as they come: frames of a bus, packets, messages.

use crate::control::can::CanFrame;
use crate::driver::can::link::{Arrival, Received};
use crate::driver::can::raw;
use crate::modality::ModalityKind;
use crate::registry::NodeSpec;
use crate::time::Stamp;

/// Identifier of every frame.
const ID: u16 = 0x123;

/// See the module's comment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Records {
    /// One frame a sample, laid out as those of a real bus are.
    Frames,
    /// A packet, or a message.
    Packets,
}

impl Records {
    /// What a device of this kind sends; `None` where it sends pictures or numbers.
    pub(super) fn of(node: &NodeSpec) -> Option<Self> {
        match node {
            _ if node.modality_kind() != ModalityKind::Bytes => None,
            NodeSpec::Can(_) => Some(Self::Frames),
            _ => Some(Self::Packets),
        }
    }

    /// Number `sequence`, taken at `captured`: it begins with the number, or a frame's data does.
    pub(super) fn write(self, seed: u64, sequence: u32, captured: Stamp, payload: &mut Vec<u8>) {
        payload.clear();
        // The lower half of the seed behind the number: little-endian, as all numbers here.
        let data = (u64::from(sequence) | seed << 32).to_le_bytes();
        match self {
            Self::Frames => {
                let arrival = Arrival { at: captured, from_kernel: true };
                raw::write(&Received { frame: CanFrame::standard(ID, data), arrival }, payload);
            }
            Self::Packets => payload.extend_from_slice(&data),
        }
    }

    /// For people.
    pub(super) const fn describe(self) -> &'static str {
        match self {
            Self::Frames => "simulated bus, frames",
            Self::Packets => "simulated device, packets",
        }
    }
}
