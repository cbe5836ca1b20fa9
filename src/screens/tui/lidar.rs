//! A scan of a LiDAR from above, from the packets that [`rapid_core::points`] reads.

use std::collections::VecDeque;

use rapid_core::points::{self, PacketFormat};

/// Points that are kept: some two turns, as often as packets are looked at.
const POINTS: usize = 8192;

/// The points of the last packets, metres in the horizontal plane.
#[derive(Debug, Clone, Default)]
pub(super) struct Sweep {
    points: VecDeque<(f64, f64)>,
}

impl Sweep {
    /// Takes a packet of any known format; whether it was one.
    pub(super) fn feed(&mut self, packet: &[u8]) -> bool {
        let taken = PacketFormat::WORDS.iter().any(|(_, format)| {
            points::read(*format, packet, |point| {
                let [ahead, left, _] = point.position;
                self.points.push_back((f64::from(-left), f64::from(ahead)));
            })
        });
        self.points.drain(..self.points.len().saturating_sub(POINTS));
        taken
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_gives_points_at_its_azimuth_and_anything_else_none() {
        // 90 degrees: to the right; 5 m for laser 15, which is 15 degrees up.
        let mut packet = vec![0_u8; 1206];
        for block in packet[..1200].chunks_exact_mut(100) {
            block[..2].copy_from_slice(&[0xff, 0xee]);
            block[2..4].copy_from_slice(&9000_u16.to_le_bytes());
            block[4 + 3 * 15..][..2].copy_from_slice(&2500_u16.to_le_bytes());
        }
        let mut sweep = Sweep::default();
        assert!(sweep.feed(&packet));
        let points: Vec<_> = sweep.points().collect();
        assert_eq!(points.len(), 12);
        let level = 5.0 * 15.0_f64.to_radians().cos();
        assert!(points.iter().all(|(x, y)| (x - level).abs() < 1e-6 && y.abs() < 1e-6), "{points:?}");
        assert!((sweep.range() - level).abs() < 1e-6);
        packet[0] = 0;
        assert!(!sweep.feed(&packet) && !sweep.feed(&packet[1..]) && !sweep.feed(&[]));
        assert_eq!(sweep.points().count(), 12);
    }
}
