//! Modalities: what a rig can observe, one entry of the registry each.
//!
//! Owns the names and numbers that every other module uses. A [`ModalityId`] is the bit in the
//! physical mask, the event id on the bus, the index into every per-modality array and the row on
//! screen.
//!
//! Invariant: an id is below [`MAX_MODALITIES`].

use serde::{Deserialize, Serialize};

/// The most modalities one rig can have: the physical mask is one 64-bit word (paper, appendix
/// "Physical Mask Data Format").
pub const MAX_MODALITIES: usize = 64;

/// Number of a modality, `0..64`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "u8", into = "u8")]
pub struct ModalityId(u8);

/// A number that is not a bit of the mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{0} is not a bit of the mask: 0 to 63 are")]
pub struct NoModality(u8);

impl TryFrom<u8> for ModalityId {
    type Error = NoModality;

    fn try_from(bit: u8) -> Result<Self, NoModality> {
        Self::new(bit).ok_or(NoModality(bit))
    }
}

impl From<ModalityId> for u8 {
    fn from(id: ModalityId) -> Self {
        id.0
    }
}

impl ModalityId {
    /// `Some` when `bit` is below [`MAX_MODALITIES`].
    pub const fn new(bit: u8) -> Option<Self> {
        if (bit as usize) < MAX_MODALITIES { Some(Self(bit)) } else { None }
    }

    /// The bit in the physical mask, `0..64`.
    pub const fn bit(self) -> u8 {
        self.0
    }

    /// The index into per-modality arrays, `0..64`.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

impl std::fmt::Display for ModalityId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.0)
    }
}

/// What the samples of a modality hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ModalityKind {
    /// Pictures, as the camera encodes them.
    Image,
    /// Depth images of 16 bits.
    Depth,
    /// A vector of numbers per sample.
    Scalars,
    /// Bytes that `rapid` forwards and records without interpreting them.
    Bytes,
}

/// A modality: its name, what its samples hold, and their shape.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Modality {
    /// The name given in `devices.toml`, for example `cam_wrist`.
    pub name: String,
    /// What the samples hold.
    pub kind: ModalityKind,
    /// Image and depth: `[height, width]` in pixels. Scalars: `[channels]`. Bytes: empty.
    pub shape: Vec<u32>,
}
