//! `node = "can"`: a CAN adapter and what is behind it, with its table `[device.NAME.can]`.

mod effector;
mod keys;
mod motors;
mod mounting;

use rapid_core::modality::ModalityKind;

use super::Kind;
use crate::spec::Opens;
use crate::system_files::{GPIO, Needs};

pub(crate) use effector::{EffectorKeys, refuse as refuse_effector};
pub use effector::{EffectorSpec, GripperSpec, TipRotation};
pub(crate) use keys::{TABLE, axes, read, warn_of_slow_stop};
pub use motors::{
    BrakeSpec, DamiaoSpec, MAX_MOTORS, MotionSpec, MotorKind, MotorMode, MotorSpec, Stop, StopSpec, WatchSpec,
};
pub use mounting::Mounting;

/// Numbers in a sample of one motor: position rad, velocity rad/s, torque Nm, temperatures of its
/// transistors and of its winding °C, and its error code.
pub const MOTOR_CHANNELS: usize = 6;

/// Bytes per frame in a sample of [`CanProtocol::Raw`].
pub const CAN_RECORD: usize = 24;
/// Frames in such a sample, at most.
pub const CAN_BATCH: usize = 128;
/// A controller that left the bus after too many errors is restarted after this many ms.
pub const CAN_RESTART_MS: u32 = 100;
/// Bit rates that slcan has a name for, `S0` to `S8`.
pub const SLCAN_BITRATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// `[device.NAME.can]`: a CAN adapter and what is behind it.
#[derive(Debug, Clone, PartialEq)]
pub struct CanSpec {
    /// How the adapter is accessed, default `SocketCAN`.
    pub adapter: CanAdapter,
    /// Bits a second on the bus, `10_000..=1_000_000`, default 1,000,000.
    pub bitrate: u32,
    /// What is on the bus, default [`CanProtocol::Raw`].
    pub protocol: CanProtocol,
}

/// How a CAN adapter is accessed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanAdapter {
    /// The kernel has a driver for it, which makes it a network interface.
    SocketCan,
    /// A serial line with the protocol slcan (Lawicel).
    Slcan,
    /// A serial line with the framing of Damiao's adapter.
    Damiao,
}

/// What is on the bus.
#[derive(Debug, Clone, PartialEq)]
pub enum CanProtocol {
    /// Frames, not parsed. None is sent.
    Raw,
    /// Damiao's motors.
    Damiao(DamiaoSpec),
}

rapid_core::words! {
    /// Every kind of adapter and its name.
    CanAdapter, 3: "socketcan" = SocketCan, "slcan" = Slcan, "damiao" = Damiao;
}

impl CanSpec {
    /// Numbers in a sample; 0 if it holds bytes.
    pub fn channels(&self) -> usize {
        match &self.protocol {
            CanProtocol::Raw => 0,
            CanProtocol::Damiao(damiao) => {
                MOTOR_CHANNELS * damiao.motors.len() + damiao.effector.as_ref().map_or(0, |effector| effector.numbers())
            }
        }
    }
}

impl Kind for CanSpec {
    fn modality_kind(&self) -> ModalityKind {
        if self.protocol == CanProtocol::Raw { ModalityKind::Bytes } else { ModalityKind::Scalars }
    }

    fn shape(&self) -> Vec<u32> {
        match self.protocol {
            CanProtocol::Raw => Vec::new(),
            CanProtocol::Damiao(_) => vec![u32::try_from(self.channels()).unwrap_or(u32::MAX)],
        }
    }

    fn opens(&self) -> Opens {
        if self.adapter == CanAdapter::SocketCan { Opens::Net } else { Opens::Tty }
    }

    fn format(&self) -> String {
        let protocol = match &self.protocol {
            CanProtocol::Raw => "raw".to_owned(),
            CanProtocol::Damiao(damiao) => format!("damiao x{}", damiao.motors.len()),
        };
        format!("{} {} bit/s {protocol}", self.adapter, self.bitrate)
    }

    fn descriptor(&self) -> String {
        format!("    adapter: \"{}\"\n    bitrate: {}\n", self.adapter, self.bitrate)
    }

    fn sizes(&self) -> (u64, u64) {
        let bytes = match self.channels() {
            0 => CAN_BATCH * CAN_RECORD,
            channels => 8 * channels,
        };
        (bytes as u64, bytes as u64)
    }

    fn bytes_per_second(&self, _: usize) -> Option<f64> {
        Some(f64::from(self.bitrate) / 8.0)
    }

    fn need(&self, needs: &mut Needs) {
        if self.adapter == CanAdapter::SocketCan {
            needs.sockets.insert("AF_CAN");
        }
        if let CanProtocol::Damiao(damiao) = &self.protocol {
            needs.guard = true;
            if damiao.motors.iter().any(|motor| motor.brake.is_some()) {
                needs.nodes.insert(GPIO);
            }
        }
    }

    /// Brings up the interface. Not every driver returns from bus-off automatically, `gs_usb` among them: current kernels
    /// (tested with 6.1.192) then refuse the whole command that requests it ("Device doesn't support restart from Bus
    /// Off"). So it is a separate command, whose failure does not prevent the other.
    fn on_plug(&self) -> Option<[String; 2]> {
        /// The number of a CAN interface in `linux/if_arp.h` (`ARPHRD_CAN`).
        const ARPHRD_CAN: u32 = 280;
        let set = "RUN+=\"/usr/sbin/ip link set dev $name";
        let commands =
            format!("{set} type can restart-ms {CAN_RESTART_MS}\", {set} up type can bitrate {}\"", self.bitrate);
        (self.adapter == CanAdapter::SocketCan).then(|| [format!("ATTR{{type}}==\"{ARPHRD_CAN}\""), commands])
    }

    fn only_at_start(&self) -> Option<&'static str> {
        Some("its interface is brought up at the start")
    }
}
