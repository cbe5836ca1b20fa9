//! `[device.NAME.lan]`: a device on the network, or behind a network adapter.

use crate::modality::ModalityKind;

/// See the module's comment.
#[derive(Debug, Clone, PartialEq)]
pub struct LanSpec {
    /// What it speaks.
    pub protocol: LanProtocol,
}

/// What a device on the network speaks.
#[derive(Debug, Clone, PartialEq)]
pub enum LanProtocol {
    /// Packets sent to a port of ours, one sample each.
    Udp {
        /// The port.
        port: u16,
    },
}

impl LanSpec {
    /// What its samples hold.
    #[must_use]
    pub const fn modality_kind(&self) -> ModalityKind {
        match self.protocol {
            LanProtocol::Udp { .. } => ModalityKind::Bytes,
        }
    }

    /// Image: `[height, width]`. Scalars: how many. Bytes: empty.
    #[must_use]
    pub fn shape(&self) -> Vec<u32> {
        match self.protocol {
            LanProtocol::Udp { .. } => Vec::new(),
        }
    }

    /// The format on one line: `udp port 2368`.
    #[must_use]
    pub fn format(&self) -> String {
        match self.protocol {
            LanProtocol::Udp { port } => format!("udp port {port}"),
        }
    }
}
