//! A frame of a CAN 2.0 bus.

/// One received frame, or one to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CanFrame {
    /// Identifier, 11 bits, or 29 of an extended frame.
    pub id: u32,
    /// The identifier has 29 bits.
    pub extended: bool,
    /// A request for a frame, without data.
    pub remote: bool,
    /// A report of the controller about the bus, not a frame of the bus.
    pub error: bool,
    /// Bytes of data, `0..=8`.
    pub len: u8,
    /// The data, zero beyond `len`.
    pub data: [u8; 8],
}

impl CanFrame {
    /// A data frame of eight bytes with an 11-bit identifier. Bits of `id` beyond them are dropped.
    pub const fn standard(id: u16, data: [u8; 8]) -> Self {
        Self { id: (id & 0x7ff) as u32, extended: false, remote: false, error: false, len: 8, data }
    }

    /// The bytes in use.
    pub fn data(&self) -> &[u8] {
        self.data.get(..usize::from(self.len)).unwrap_or(&self.data)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_ends_at_its_length_and_at_eight_bytes_at_most() {
        let frame = CanFrame::standard(0x1805, [1, 2, 3, 4, 5, 6, 7, 8]);
        assert_eq!((frame.id, frame.data().len()), (5, 8));
        for (len, there) in [(0, 0), (3, 3), (8, 8), (9, 8), (255, 8)] {
            assert_eq!(CanFrame { len, ..frame }.data().len(), there);
        }
    }
}
