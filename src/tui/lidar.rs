//! A scan of a LiDAR from above, from the packets of Velodyne's sensors with 16 lasers.
//!
//! A data packet has 1206 bytes: 12 blocks of 100 bytes, then a time and two bytes about the sensor. A block is `ff ee`,
//! the azimuth in hundredths of a degree (u16, little endian), and 32 returns of 3 bytes: distance in 2 mm (u16, little
//! endian) and reflectivity. The 16 lasers fire twice in a block; the laser of return n is n modulo 16, and its vertical
//! angle is -15° + 2° for each pair, even ones first (VLP-16 user manual 63-9243, sections 6 and 9).

use std::collections::VecDeque;

/// Bytes of a data packet.
const PACKET: usize = 1206;
const BLOCK: usize = 100;
const BLOCKS: usize = 12;
const LASERS: usize = 16;
/// Points that are kept: some two turns, as often as packets are looked at.
const POINTS: usize = 8192;

/// The points of the last packets, metres in the horizontal plane.
#[derive(Debug, Clone, Default)]
pub(super) struct Sweep {
    points: VecDeque<(f64, f64)>,
}

impl Sweep {
    /// Takes a packet; whether it was one.
    pub(super) fn take(&mut self, packet: &[u8]) -> bool {
        let Some(blocks) = packet.get(..BLOCK * BLOCKS).filter(|_| packet.len() == PACKET) else { return false };
        if !blocks.chunks_exact(BLOCK).all(|block| block.starts_with(&[0xff, 0xee])) {
            return false;
        }
        for block in blocks.chunks_exact(BLOCK) {
            let number = |at: usize| {
                block.get(at..at + 2).map_or(0, |bytes| {
                    u16::from_le_bytes([bytes.first().copied().unwrap_or(0), bytes.get(1).copied().unwrap_or(0)])
                })
            };
            let azimuth = (f64::from(number(2)) / 100.0).to_radians();
            for place in 0..2 * LASERS {
                let distance = f64::from(number(4 + 3 * place)) * 0.002;
                // Zero is no return.
                if distance > 0.0 {
                    let level = distance * elevation(place % LASERS).to_radians().cos();
                    self.points.push_back((level * azimuth.sin(), level * azimuth.cos()));
                }
            }
        }
        self.points.drain(..self.points.len().saturating_sub(POINTS));
        true
    }

    /// x to the right, y ahead.
    pub(super) fn points(&self) -> impl Iterator<Item = (f64, f64)> {
        self.points.iter().copied()
    }

    /// Metres that hold nine points of ten, at least 1.
    pub(super) fn range(&self) -> f64 {
        let mut ranges: Vec<f64> = self.points().map(|(x, y)| x.hypot(y)).collect();
        ranges.sort_by(f64::total_cmp);
        ranges.get(ranges.len() * 9 / 10).copied().unwrap_or(1.0).max(1.0)
    }
}

/// Vertical angle of a laser, degrees.
fn elevation(laser: usize) -> f64 {
    let step = f64::from(u8::try_from(laser / 2).unwrap_or(0)) * 2.0;
    if laser.is_multiple_of(2) { -15.0 + step } else { 1.0 + step }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_gives_points_at_its_azimuth_and_anything_else_none() {
        let mut packet = vec![0_u8; PACKET];
        for block in packet[..BLOCK * BLOCKS].chunks_exact_mut(BLOCK) {
            block[..2].copy_from_slice(&[0xff, 0xee]);
            // 90 degrees: to the right.
            block[2..4].copy_from_slice(&9000_u16.to_le_bytes());
            // Laser 15, the highest: 15 degrees up, 5 m.
            block[4 + 3 * 15..][..2].copy_from_slice(&2500_u16.to_le_bytes());
        }
        let mut sweep = Sweep::default();
        assert!(sweep.take(&packet));
        let points: Vec<_> = sweep.points().collect();
        assert_eq!(points.len(), BLOCKS);
        let level = 5.0 * 15.0_f64.to_radians().cos();
        assert!(points.iter().all(|(x, y)| (x - level).abs() < 1e-9 && y.abs() < 1e-9), "{points:?}");
        assert!((sweep.range() - level).abs() < 1e-9);
        packet[0] = 0;
        assert!(!sweep.take(&packet) && !sweep.take(&packet[1..]) && !sweep.take(&[]));
        assert_eq!((elevation(0), elevation(14)), (-15.0, -1.0));
    }
}
