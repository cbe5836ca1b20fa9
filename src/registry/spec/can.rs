//! `[device.NAME.can]`: a CAN adapter and what is behind it.

use super::motors::DamiaoSpec;
use crate::modality::ModalityKind;

/// Numbers in a sample of one motor: position rad, velocity rad/s, torque Nm, temperatures of its
/// transistors and of its winding °C, and its error code.
pub const MOTOR_CHANNELS: usize = 6;

/// Bytes that stand for one frame in a sample of [`CanProtocol::Raw`].
pub const CAN_RECORD: usize = 24;
/// Frames in such a sample, at most.
pub const CAN_BATCH: usize = 128;
/// A controller that left the bus after too many errors is made to return after this many ms.
pub const CAN_RESTART_MS: u32 = 100;
/// Bit rates that slcan has a name for, `S0` to `S8`.
pub const SLCAN_BITRATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// See the module's comment.
#[derive(Debug, Clone, PartialEq)]
pub struct CanSpec {
    /// How the adapter is spoken to, default `SocketCAN`.
    pub adapter: CanAdapter,
    /// Bits a second on the bus, `10_000..=1_000_000`, default 1,000,000.
    pub bitrate: u32,
    /// What is on the bus, default [`CanProtocol::Raw`].
    pub protocol: CanProtocol,
}

/// How a CAN adapter is spoken to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanAdapter {
    /// The kernel has a driver for it, which makes it a network interface.
    SocketCan,
    /// A serial line that speaks slcan (Lawicel's protocol).
    Slcan,
    /// A serial line with the framing of Damiao's adapter.
    Damiao,
}

/// What is on the bus.
#[derive(Debug, Clone, PartialEq)]
pub enum CanProtocol {
    /// Frames, not looked into. None is sent.
    Raw,
    /// Damiao's motors.
    Damiao(DamiaoSpec),
}

impl CanSpec {
    /// What its samples hold.
    #[must_use]
    pub const fn modality_kind(&self) -> ModalityKind {
        match self.protocol {
            CanProtocol::Raw => ModalityKind::Bytes,
            CanProtocol::Damiao(_) => ModalityKind::Scalars,
        }
    }

    /// Scalars: how many. Bytes: empty.
    #[must_use]
    pub fn shape(&self) -> Vec<u32> {
        match self.channels() {
            0 => Vec::new(),
            channels => vec![u32::try_from(channels).unwrap_or(u32::MAX)],
        }
    }

    /// Numbers in a sample; 0 if it holds bytes.
    #[must_use]
    pub fn channels(&self) -> usize {
        match &self.protocol {
            CanProtocol::Raw => 0,
            CanProtocol::Damiao(damiao) => MOTOR_CHANNELS * damiao.motors.len(),
        }
    }
}
