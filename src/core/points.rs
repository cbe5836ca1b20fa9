//! Packets of LiDARs, read as points. The reader of each published format is here and nowhere else.
//!
//! Velodyne's sensors with 16 lasers (VLP-16 user manual 63-9243, sections 6, 9 and appendix A): a data packet has 1206
//! bytes: 12 blocks of 100 bytes, a time of 4 bytes, the return mode and the model. A block is `ff ee`, the azimuth in
//! hundredths of a degree (u16), and 32 returns of 3 bytes: distance in 2 mm (u16; 0 is no return) and reflectivity. The 16 lasers
//! fire twice in a block, the second time half way to the azimuth of the next; the laser of return n is n modulo 16. All
//! of a firing get its azimuth: the last fires a tenth to a quarter of a degree later.
//!
//! Livox sensors of the second protocol (Mid-360, HAP; "Point Cloud & IMU Data Protocol"): a header of 36 bytes (version,
//! length u16 at 1, number of points u16 at 5, type u8 at 10, time at 28), then the points: type 1 x, y, z in mm (i32),
//! type 2 in cm (i16), type 3 distance in mm (u32), zenith and azimuth in hundredths of a degree (u16), each followed by
//! reflectivity and a tag. Type 0 is the state of its gyroscope. Numbers of both are little-endian.
//!
//! Invariant: any bytes are survived; what is not a whole packet of the format gives no point.
//! Invariant: nothing here allocates.

/// A published format of packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PacketFormat {
    /// VLP-16, Puck LITE.
    Velodyne,
    /// Mid-360, HAP.
    Livox,
}

crate::words! {
    /// Every format and its name.
    PacketFormat, 2: "velodyne" = Velodyne, "livox" = Livox;
}

/// A point: x ahead of the sensor, y to its left, z up, in m (ROS REP 103).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// m.
    pub position: [f32; 3],
    /// 0 to 255.
    pub reflectivity: u8,
}

/// Passes each point of a packet on, in its order; false, and nothing passed on, if it is not a packet of points.
pub fn read(format: PacketFormat, packet: &[u8], each: impl FnMut(Point)) -> bool {
    match format {
        PacketFormat::Velodyne => velodyne::read(packet, each).is_some(),
        PacketFormat::Livox => livox::read(packet, each).is_some(),
    }
}

/// The little-endian bytes at `at`; zeros beyond the end, before which the length was checked.
fn bytes<const N: usize>(packet: &[u8], at: usize) -> [u8; N] {
    packet.get(at..).and_then(|rest| rest.first_chunk::<N>()).copied().unwrap_or([0; N])
}

#[expect(clippy::cast_possible_truncation, reason = "nearest, of metres")]
fn point([x, y, z]: [f64; 3], reflectivity: u8) -> Point {
    Point { position: [x as f32, y as f32, z as f32], reflectivity }
}

mod velodyne {
    use super::{Point, bytes, point};

    const PACKET: usize = 1206;
    const BLOCK: usize = 100;
    const BLOCKS: usize = 12;
    const LASERS: usize = 16;
    /// Hundredths of a degree.
    const TURN: u32 = 36_000;
    /// The return mode of two returns: each azimuth has two blocks.
    const DUAL: u8 = 0x39;
    /// VLP-16, Puck LITE, and what firmware before 3.0.29 writes. Other models send packets of this size with other lasers: HDL-32E,
    /// Puck Hi-Res, VLP-32C, VLS-128.
    const MODELS: [u8; 3] = [0x22, 0x23, 0];
    /// Vertical angle of each laser in degrees, and where its beam begins above the middle, in mm.
    const LASER: [(f64, f64); LASERS] = [
        (-15.0, 11.2),
        (1.0, -0.7),
        (-13.0, 9.7),
        (3.0, -2.2),
        (-11.0, 8.1),
        (5.0, -3.7),
        (-9.0, 6.6),
        (7.0, -5.1),
        (-7.0, 5.1),
        (9.0, -6.6),
        (-5.0, 3.7),
        (11.0, -8.1),
        (-3.0, 2.2),
        (13.0, -9.7),
        (-1.0, 0.7),
        (15.0, -11.2),
    ];

    pub(super) fn read(packet: &[u8], mut each: impl FnMut(Point)) -> Option<()> {
        let blocks = packet.get(..BLOCK * BLOCKS).filter(|_| packet.len() == PACKET)?;
        let [mode, model] = bytes(packet, PACKET - 2);
        let is_one = blocks.chunks_exact(BLOCK).all(|block| block.starts_with(&[0xff, 0xee]));
        if !is_one || !MODELS.contains(&model) {
            return None;
        }
        let azimuth = |block: usize| u32::from(u16::from_le_bytes(bytes(packet, block * BLOCK + 2))) % TURN;
        let apart = if mode == DUAL { 2 } else { 1 };
        for (index, block) in blocks.chunks_exact(BLOCK).enumerate() {
            // The last has no next: it turns as far as the one before it.
            let from = if index + apart < BLOCKS { index } else { index - apart };
            let step = (azimuth(from + apart) + TURN - azimuth(from)) % TURN;
            for firing in 0..2 {
                let half = f64::from(step) / 2.0 * f64::from(u8::from(firing == 1));
                let (sin, cos) = ((f64::from(azimuth(index)) + half) / 100.0).to_radians().sin_cos();
                for (laser, (angle, above)) in LASER.iter().enumerate() {
                    let [low, high, reflectivity] = bytes(block, 4 + 3 * (firing * LASERS + laser));
                    let distance = f64::from(u16::from_le_bytes([low, high])) * 0.002;
                    if distance > 0.0 {
                        let (up, level) = angle.to_radians().sin_cos();
                        let level = distance * level;
                        // The azimuth is counted clockwise, seen from above.
                        each(point([level * cos, -level * sin, distance * up + above / 1000.0], reflectivity));
                    }
                }
            }
        }
        Some(())
    }
}

mod livox {
    use super::{Point, bytes, point};

    const HEADER: usize = 36;
    const COUNT: usize = 5;
    const TYPE: usize = 10;

    pub(super) fn read(packet: &[u8], mut each: impl FnMut(Point)) -> Option<()> {
        let points = packet.get(HEADER..)?;
        let [kind] = bytes(packet, TYPE);
        let size = match kind {
            1 => 14,
            2 => 8,
            3 => 10,
            _ => return None,
        };
        let count = usize::from(u16::from_le_bytes(bytes(packet, COUNT)));
        let length = usize::from(u16::from_le_bytes(bytes(packet, 1)));
        if length != packet.len() || points.len() != count * size {
            return None;
        }
        for bytes_of in points.chunks_exact(size) {
            let position = match kind {
                1 => [0, 4, 8].map(|at| f64::from(i32::from_le_bytes(bytes(bytes_of, at))) / 1000.0),
                2 => [0, 2, 4].map(|at| f64::from(i16::from_le_bytes(bytes(bytes_of, at))) / 100.0),
                _ => {
                    let distance = f64::from(u32::from_le_bytes(bytes(bytes_of, 0))) / 1000.0;
                    let angle =
                        |at| (f64::from(u16::from_le_bytes(bytes(bytes_of, at))) / 100.0).to_radians().sin_cos();
                    let ((level, up), (left, ahead)) = (angle(4), angle(6));
                    [distance * level * ahead, distance * level * left, distance * up]
                }
            };
            let [reflectivity] = bytes(bytes_of, size - 2);
            // At the sensor itself: no return.
            if position.iter().any(|part| *part != 0.0) {
                each(point(position, reflectivity));
            }
        }
        Some(())
    }
}

#[cfg(test)]
mod tests;
