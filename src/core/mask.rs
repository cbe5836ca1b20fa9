//! The Physical Mask: which modalities are physically present and running, one bit each.
//!
//! Owns the 64-bit value and its 32-byte record (paper, appendix "Physical Mask Data Format"). It is
//! published by `rig/presence`.
//!
//! Invariant: a bit is a [`ModalityId`]; nothing here decides when a bit changes: the rule is `DeviceState::is_present` in
//! `rapid-status`, and the rig (`rig/core`) applies it.

use serde::{Deserialize, Serialize};

use crate::modality::ModalityId;

/// File the mask is published in, read by other processes.
pub const MASK_PATH: &str = "/dev/shm/rapid_hardware_mask";
/// Topic on which it is published, on the bus and in recordings.
pub const MASK_TOPIC: &str = "/rapid/mask";
/// Size of the published record in bytes.
pub const RECORD_LEN: usize = 32;

const MAGIC: [u8; 4] = *b"RAPD";
const VERSION: u8 = 1;

/// Size of the payload on the topic in bytes.
pub const PAYLOAD_LEN: usize = 24;

/// One bit per modality: set exactly while its device is attached and its samples have begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PhysicalMask(pub u64);

impl PhysicalMask {
    /// No modality present.
    pub const EMPTY: Self = Self(0);

    /// Whether the modality is present.
    pub const fn contains(self, id: ModalityId) -> bool {
        self.0 >> id.bit() & 1 == 1
    }

    /// The mask with the bit of `id` set to `present`.
    #[must_use]
    pub const fn with(self, id: ModalityId, present: bool) -> Self {
        let bit = 1_u64 << id.bit();
        if present { Self(self.0 | bit) } else { Self(self.0 & !bit) }
    }

    /// How many modalities are present.
    pub const fn online_count(self) -> u32 {
        self.0.count_ones()
    }

    /// Digits of the most significant bit first, at least 8 and as many whole bytes as
    /// `device_count` needs: `00000101`.
    pub fn binary(self, device_count: usize) -> String {
        let width = digits(self, device_count);
        format!("{:0width$b}", self.0)
    }

    /// Hexadecimal with at least two digits: `0x05`.
    pub fn hex(self, device_count: usize) -> String {
        let width = digits(self, device_count) / 4;
        format!("0x{:0width$x}", self.0)
    }
}

/// The mask, and which devices are plugged in. What runs is plugged in: each bit of the mask is one of the others too. A
/// device that is plugged in without a bit in the mask is being opened, or its driver failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Bits {
    /// The mask.
    pub mask: PhysicalMask,
    /// One bit per modality: set exactly while its device is attached and no source has reported it gone.
    pub plugged: PhysicalMask,
}

impl From<PhysicalMask> for Bits {
    /// Nothing is plugged in that does not run, as far as is known.
    fn from(mask: PhysicalMask) -> Self {
        Self { mask, plugged: mask }
    }
}

impl Bits {
    /// The payload of the mask's topic: mask, number of the publication, and what is plugged in, little endian.
    pub fn payload(self, sequence: u64) -> [u8; PAYLOAD_LEN] {
        let mut payload = [0; PAYLOAD_LEN];
        for (place, value) in payload.as_chunks_mut::<8>().0.iter_mut().zip([self.mask.0, sequence, self.plugged.0]) {
            *place = value.to_le_bytes();
        }
        payload
    }

    /// What such a payload holds; `None` if it is too short. One without the last number is of an earlier version.
    pub fn of_payload(payload: &[u8]) -> Option<(Self, u64)> {
        let mut numbers = payload.as_chunks().0.iter().map(|number| u64::from_le_bytes(*number));
        let (mask, sequence) = (PhysicalMask(numbers.next()?), numbers.next()?);
        let plugged = numbers.next().map_or(mask, |plugged| PhysicalMask(plugged | mask.0));
        Some((Self { mask, plugged }, sequence))
    }
}

/// A mask with the number of devices it represents, which decides how many digits its text has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SizedMask {
    /// The mask.
    pub mask: PhysicalMask,
    /// Number of registered modalities.
    pub devices: usize,
}

impl std::fmt::Display for SizedMask {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.mask.hex(self.devices))
    }
}

impl Serialize for SizedMask {
    /// As hexadecimal text: `0x05`.
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

fn digits(mask: PhysicalMask, device_count: usize) -> usize {
    let highest = 64 - mask.0.leading_zeros() as usize;
    device_count.max(highest).max(1).div_ceil(8) * 8
}

/// The published record.
///
/// Little endian: bytes `RAPD`, u8 version 1, u8 device count, u16 write generation (padding in the
/// paper's own format; odd while a write is in progress), u64 mask, u64 `CLOCK_REALTIME` in ns,
/// u64 sequence from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MaskRecord {
    /// Number of registered modalities.
    pub device_count: u8,
    /// Even in a complete record.
    pub generation: u16,
    /// The mask.
    pub mask: PhysicalMask,
    /// `CLOCK_REALTIME` of the publication, ns since 1970.
    pub realtime_ns: u64,
    /// Number of publications so far, from 1.
    pub sequence: u64,
}

/// Why 32 bytes are not a mask record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum MaskRecordError {
    /// The first four bytes are not `RAPD`.
    #[error("not a physical mask: it does not begin with \"RAPD\"")]
    Magic,
    /// A version this program does not know.
    #[error("physical mask of version {0}, this program reads version {VERSION}")]
    Version(u8),
}

impl MaskRecord {
    /// The record's bytes.
    pub fn to_bytes(&self) -> [u8; RECORD_LEN] {
        let mut bytes = [0; RECORD_LEN];
        bytes[0..4].copy_from_slice(&MAGIC);
        bytes[4] = VERSION;
        bytes[5] = self.device_count;
        bytes[6..8].copy_from_slice(&self.generation.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.mask.0.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.realtime_ns.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.sequence.to_le_bytes());
        bytes
    }

    /// Reads a record.
    ///
    /// # Errors
    /// When the magic or the version is unknown.
    pub fn from_bytes(bytes: &[u8; RECORD_LEN]) -> Result<Self, MaskRecordError> {
        let word = |at: usize| {
            let mut eight = [0; 8];
            eight.copy_from_slice(&bytes[at..at + 8]);
            u64::from_le_bytes(eight)
        };
        if bytes[0..4] != MAGIC {
            return Err(MaskRecordError::Magic);
        }
        if bytes[4] != VERSION {
            return Err(MaskRecordError::Version(bytes[4]));
        }
        Ok(Self {
            device_count: bytes[5],
            generation: u16::from_le_bytes([bytes[6], bytes[7]]),
            mask: PhysicalMask(word(8)),
            realtime_ns: word(16),
            sequence: word(24),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_record_of_the_predecessor_is_read_and_written_byte_for_byte() {
        // 5 devices, mask 0b10011, sequence 42, as the paper's own daemon writes it.
        let golden: [u8; 32] = [
            0x52, 0x41, 0x50, 0x44, 0x01, 0x05, 0x00, 0x00, 0x13, 0, 0, 0, 0, 0, 0, 0, 0x15, 0xcd, 0x85, 0x3d, 0xfe,
            0x9c, 0x97, 0x17, 0x2a, 0, 0, 0, 0, 0, 0, 0,
        ];
        let record = MaskRecord {
            device_count: 5,
            generation: 0,
            mask: PhysicalMask(0b10011),
            realtime_ns: 1_700_000_000_123_456_789,
            sequence: 42,
        };
        assert_eq!(record.to_bytes(), golden);
        assert_eq!(MaskRecord::from_bytes(&golden), Ok(record));
    }

    #[test]
    fn foreign_bytes_are_refused() {
        assert_eq!(MaskRecord::from_bytes(&[0; 32]), Err(MaskRecordError::Magic));
        let mut newer =
            MaskRecord { device_count: 0, generation: 0, mask: PhysicalMask::EMPTY, realtime_ns: 0, sequence: 1 }
                .to_bytes();
        newer[4] = 2;
        assert_eq!(MaskRecord::from_bytes(&newer), Err(MaskRecordError::Version(2)));
    }

    #[test]
    fn text_forms_match_the_paper() {
        assert_eq!(PhysicalMask(5).hex(3), "0x05");
        assert_eq!(PhysicalMask(5).binary(3), "00000101");
        assert_eq!(PhysicalMask(1 << 9).hex(3), "0x0200");
        assert_eq!(PhysicalMask(u64::MAX).binary(64).len(), 64);
    }
}
