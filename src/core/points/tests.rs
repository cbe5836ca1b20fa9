//! Packets as their formats describe them, and any other bytes.

use proptest::prelude::*;

use super::*;

/// A packet whose blocks are `step` hundredths of a degree apart, from `azimuth` on, with a return of every laser at
/// `distance` (2 mm).
fn velodyne(azimuth: u16, step: u16, distance: u16, factory: [u8; 2]) -> Vec<u8> {
    let mut packet = Vec::new();
    for block in 0..12 {
        packet.extend([0xff, 0xee]);
        packet.extend(((azimuth + block * step) % 36_000).to_le_bytes());
        for place in 0..32 {
            packet.extend(distance.to_le_bytes());
            packet.push(place);
        }
    }
    packet.extend([0, 0, 0, 0]);
    packet.extend(factory);
    packet
}

fn livox(kind: u8, points: &[Vec<u8>]) -> Vec<u8> {
    let mut packet = vec![0; 36];
    let length = 36 + points.iter().map(Vec::len).sum::<usize>();
    packet[1..3].copy_from_slice(&u16::try_from(length).unwrap().to_le_bytes());
    packet[5..7].copy_from_slice(&u16::try_from(points.len()).unwrap().to_le_bytes());
    packet[10] = kind;
    packet.extend(points.concat());
    packet
}

fn points(format: PacketFormat, packet: &[u8]) -> Option<Vec<Point>> {
    let mut points = Vec::new();
    let is_packet = read(format, packet, |point| points.push(point));
    assert!(is_packet || points.is_empty(), "points of what is not a packet");
    is_packet.then_some(points)
}

fn is_near(point: Point, position: [f64; 3]) -> bool {
    point.position.iter().zip(position).all(|(is, wanted)| (f64::from(*is) - wanted).abs() < 1e-4)
}

#[test]
fn a_packet_of_velodyne_has_a_point_for_each_return() {
    // 5 m, straight ahead.
    let ahead = points(PacketFormat::Velodyne, &velodyne(0, 0, 2500, [0x37, 0x22])).unwrap();
    assert_eq!(ahead.len(), 12 * 32);
    let high = 15.0_f64.to_radians();
    // The highest laser, whose beam begins below the middle.
    assert!(is_near(ahead[15], [5.0 * high.cos(), 0.0, 5.0 * high.sin() - 0.0112]), "{:?}", ahead[15]);
    assert!(is_near(ahead[0], [5.0 * high.cos(), 0.0, -5.0 * high.sin() + 0.0112]), "{:?}", ahead[0]);
    assert_eq!((ahead[0].reflectivity, ahead[31].reflectivity), (0, 31));
    // 90 degrees clockwise: to the right.
    let right = points(PacketFormat::Velodyne, &velodyne(9000, 0, 2500, [0x37, 0x22])).unwrap();
    assert!(is_near(right[15], [0.0, -5.0 * high.cos(), 5.0 * high.sin() - 0.0112]), "{:?}", right[15]);
    assert_eq!(points(PacketFormat::Velodyne, &velodyne(0, 40, 0, [0x37, 0x22])), Some(Vec::new()), "no returns");
}

#[test]
fn the_second_firing_is_half_way_to_the_next_block() {
    let angle = |point: Point| -f64::from(point.position[1]).atan2(f64::from(point.position[0])).to_degrees();
    let turned = |packet: &[u8]| {
        let points = points(PacketFormat::Velodyne, packet).unwrap();
        [0, 16, 11 * 32, 11 * 32 + 16].map(|at| angle(points[at]))
    };
    let near = |is: [f64; 4], wanted: [f64; 4]| is.iter().zip(wanted).all(|(is, wanted)| (is - wanted).abs() < 1e-3);
    // Across 360 degrees: 359.8, 0.2 ... 4.2.
    let once = turned(&velodyne(35_980, 40, 2500, [0x37, 0x22]));
    assert!(near(once, [-0.2, 0.0, 4.2, 4.4]), "{once:?}");
    // Two returns: pairs of blocks have one azimuth.
    let mut dual = velodyne(0, 0, 2500, [0x39, 0x22]);
    for block in 0..12_u16 {
        let at = usize::from(block) * 100 + 2;
        dual[at..at + 2].copy_from_slice(&(block / 2 * 40).to_le_bytes());
    }
    let twice = turned(&dual);
    assert!(near(twice, [0.0, 0.2, 2.0, 2.2]), "{twice:?}");
}

#[test]
fn a_packet_of_another_model_or_length_has_no_points() {
    let packet = velodyne(0, 40, 2500, [0x37, 0x22]);
    for model in [0x21, 0x24, 0x28, 0xa1, 0x42] {
        assert_eq!(points(PacketFormat::Velodyne, &velodyne(0, 40, 2500, [0x37, model])), None, "{model:x}");
    }
    let mut other = packet.clone();
    other[1100] = 0;
    for wrong in [&packet[1..], &packet[..1205], &other, &[]] {
        assert_eq!(points(PacketFormat::Velodyne, wrong), None);
    }
}

#[test]
fn packets_of_livox_have_points_in_three_forms() {
    let mm = [2500_i32, -1500, 40].map(i32::to_le_bytes).concat();
    let cm = [250_i16, -150, 4].map(i16::to_le_bytes).concat();
    // 2 m away, at a zenith of 90 and an azimuth of 90 degrees: to the left.
    let spherical = [&2000_u32.to_le_bytes()[..], &9000_u16.to_le_bytes(), &9000_u16.to_le_bytes()].concat();
    for (kind, coordinates, wanted) in
        [(1, mm, [2.5, -1.5, 0.04]), (2, cm, [2.5, -1.5, 0.04]), (3, spherical, [0.0, 2.0, 0.0])]
    {
        let none = [vec![0; coordinates.len()], vec![9, 9]].concat();
        let one = [coordinates, vec![77, 1]].concat();
        let packet = livox(kind, &[one.clone(), none, one]);
        let read = points(PacketFormat::Livox, &packet).unwrap();
        assert_eq!(read.len(), 2, "{kind}: what has no distance is not a point");
        assert!(read.iter().all(|point| is_near(*point, wanted) && point.reflectivity == 77), "{kind}: {read:?}");
        assert_eq!(points(PacketFormat::Livox, &packet[..packet.len() - 1]), None, "{kind}: cut");
    }
    assert_eq!(points(PacketFormat::Livox, &livox(0, &[vec![0; 24]])), None, "of the gyroscope");
    assert_eq!(points(PacketFormat::Livox, &[0; 35]), None);
}

proptest! {
    #[test]
    fn any_bytes_are_survived(mut packet in prop::collection::vec(any::<u8>(), 0..1400), kind in 0_u8..5) {
        points(PacketFormat::Velodyne, &packet);
        points(PacketFormat::Livox, &packet);
        // With a header that fits, so that the points are reached.
        let size = [24, 14, 8, 10, 7][usize::from(kind)];
        let count = packet.len().saturating_sub(36) / size;
        packet.truncate(36 + count * size);
        if packet.len() >= 36 {
            packet[1..3].copy_from_slice(&u16::try_from(36 + count * size).unwrap().to_le_bytes());
            packet[5..7].copy_from_slice(&u16::try_from(count).unwrap().to_le_bytes());
            packet[10] = kind;
            let read = points(PacketFormat::Livox, &packet);
            prop_assert_eq!(read.is_some(), (1..4).contains(&kind));
        }
        packet.resize(1206, 7);
        packet[..1200].chunks_exact_mut(100).for_each(|block| block[..2].copy_from_slice(&[0xff, 0xee]));
        packet[1205] = 0x22;
        prop_assert!(points(PacketFormat::Velodyne, &packet).is_some());
    }
}
