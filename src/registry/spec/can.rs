//! CAN buses, as `[device.NAME.can]` tells of them.

use super::motors::DamiaoSpec;

/// `[device.NAME.can]`.
#[derive(Debug, Clone, PartialEq)]
pub struct CanSpec {
    /// How frames go to and from the adapter, default [`CanAdapter::SocketCan`].
    pub adapter: CanAdapter,
    /// Bits a second on the bus, `10_000..=1_000_000`, default 1,000,000.
    pub bitrate: u32,
    /// What the frames mean, default [`CanProtocol::Raw`].
    pub protocol: CanProtocol,
}

/// How a CAN adapter is talked to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CanAdapter {
    /// It is a network interface: gs_usb, PEAK, Kvaser and whatever else the kernel has a driver of.
    SocketCan,
    /// It is a serial line that carries frames as text (Lawicel).
    Slcan,
    /// It is a serial line that carries frames as Damiao's USB2CAN adapter does.
    Damiao,
}

/// What is spoken on a bus.
#[derive(Debug, Clone, PartialEq)]
pub enum CanProtocol {
    /// Frames are recorded as they are, and none is sent.
    Raw,
    /// Motors.
    Damiao(DamiaoSpec),
}
