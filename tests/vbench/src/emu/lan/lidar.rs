//! Packets of a LiDAR in the format of a Velodyne VLP-16: twelve blocks of 100 bytes, four of time, two factory bytes.
//!
//! The first block's distances are the packet's number (u32) and send time (u64, ns of CLOCK_MONOTONIC), little-endian.

/// Bytes of a packet.
pub const PACKET: usize = 1206;
/// Their destination port.
pub const PORT: u16 = 2368;

const BLOCK: usize = 100;
const BLOCKS: usize = 12;
/// Flag, azimuth.
const BLOCK_HEAD: usize = 4;
/// Strongest return, VLP-16.
const FACTORY: [u8; 2] = [0x37, 0x22];

/// Packet `number`.
pub fn packet(number: u32, sent_ns: u64) -> [u8; PACKET] {
    let mut packet = [0; PACKET];
    for (block, place) in packet.as_chunks_mut::<BLOCK>().0.iter_mut().zip(0_u32..) {
        // Two blocks per firing, 0.4 degrees apart; azimuth in hundredths of a degree.
        let turn = (u64::from(number) * BLOCKS as u64 + u64::from(place)) * 20 % 36_000;
        block[..2].copy_from_slice(&[0xff, 0xee]);
        block[2..4].copy_from_slice(&turn.to_le_bytes()[..2]);
        for (point, channel) in block[BLOCK_HEAD..].as_chunks_mut::<3>().0.iter_mut().zip(0_u16..) {
            point[..2].copy_from_slice(&(1_000 + channel * 10).to_le_bytes());
            point[2] = 100;
        }
    }
    packet[4..8].copy_from_slice(&number.to_le_bytes());
    packet[8..16].copy_from_slice(&sent_ns.to_le_bytes());
    // Microseconds after the hour.
    let [a, b, c, d, ..] = (sent_ns / 1_000 % 3_600_000_000).to_le_bytes();
    packet[1200..1204].copy_from_slice(&[a, b, c, d]);
    packet[1204..].copy_from_slice(&FACTORY);
    packet
}

/// The number of a packet; `None` if the bytes are not a whole packet of this LiDAR.
pub fn number(packet: &[u8]) -> Option<u32> {
    let whole = packet.len() == PACKET && packet.starts_with(&[0xff, 0xee]) && packet.ends_with(&FACTORY);
    whole.then(|| u32::from_le_bytes([packet[4], packet[5], packet[6], packet[7]]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_has_its_number() {
        let packet = packet(0x0102_0304, 5_000);
        assert_eq!(number(&packet), Some(0x0102_0304));
        assert_eq!(packet[BLOCK * 11..BLOCK * 11 + 2], [0xff, 0xee]);
        assert_eq!(packet[1200..], [5, 0, 0, 0, 0x37, 0x22]);
        assert_eq!(number(&packet[..1205]), None);
        assert_eq!(number(&[0; PACKET]), None);
    }
}
