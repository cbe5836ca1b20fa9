use super::*;

const CAMERA: SimSource = SimSource::Camera { width: 64, height: 48, fps: 30, seed: 7, bytes: 0 };

fn device(source: SimSource) -> Arc<SimDevice> {
    Arc::new(SimDevice::new("sim", source, stamp_of(Instant::now())))
}

#[test]
fn the_grid_does_not_drift_and_first_after_is_the_next_point() {
    let grid = Grid::new(Stamp(1_000), 30.0);
    assert_eq!(grid.tick(30_000_000), Stamp(1_000 + 1_000_000 * 1_000_000_000));
    for point in [0, 1, 2, 3, 29, 30, 31, 1_000_003] {
        let stamp = grid.tick(point);
        assert_eq!(first_after(grid, stamp), point + 1);
        assert_eq!(first_after(grid, Stamp(stamp.0 - 1)), point);
    }
    assert_eq!(first_after(grid, Stamp(0)), 0);
}

#[test]
fn a_picture_is_a_jpeg_that_names_seed_and_sequence() {
    let picture = frame(&CAMERA, 12).unwrap();
    assert_eq!(picture[..4], [0xff, 0xd8, 0xff, 0xfe]);
    assert_eq!(&picture[6..22], b"rapid-sim 7 12\xff\xe0", "the segment ends where the next begins");
    assert_eq!(u16::from_be_bytes([picture[4], picture[5]]), 2 + 14);
    assert_eq!(picture[picture.len() - 2..], [0xff, 0xd9], "end of image");
    assert_ne!(frame(&CAMERA, 13).unwrap()[22..], picture[22..], "something moves");
    assert_eq!(frame(&CAMERA, 20).unwrap()[22..], picture[22..], "and comes back");
    let other = SimSource::Camera { width: 64, height: 48, fps: 30, seed: 8, bytes: 0 };
    assert_ne!(frame(&other, 12).unwrap()[22..], picture[22..]);
}

#[test]
fn a_picture_is_padded_with_segments_that_a_decoder_skips() {
    for bytes in [0, 5_000, 65_600, 150_000] {
        let picture = frame(&SimSource::Camera { width: 64, height: 48, fps: 30, seed: 7, bytes }, 12).unwrap();
        let plain = frame(&CAMERA, 12).unwrap();
        let named = picture.len() - bytes.max(plain.len());
        assert!(named < 64, "{bytes}: {}", picture.len());
        let mut at = 2;
        while picture[at..at + 2] == [0xff, 0xfe] {
            at += 2 + usize::from(u16::from_be_bytes([picture[at + 2], picture[at + 3]]));
        }
        assert!(picture[at..] == plain[20..], "{bytes}: the picture continues where the comments end");
    }
}

#[test]
fn values_begin_with_the_sequence_and_stay_within_one() {
    let bytes = frame(&SimSource::Serial { channels: 3, hz: 100, seed: 1 }, 41).unwrap();
    let values: Vec<f64> = bytes.as_chunks().0.iter().map(|eight| f64::from_le_bytes(*eight)).collect();
    assert_eq!(values.len(), 3);
    assert_eq!(values[0].to_bits(), 41.0_f64.to_bits());
    assert!(values[1..].iter().all(|value| value.abs() <= 1.0));
}

#[tokio::test(start_paused = true)]
async fn samples_lie_on_the_grid() {
    let device = device(CAMERA);
    let mut sim = Sim::open(Arc::clone(&device)).await.unwrap();
    for sequence in 0..40 {
        let reading = sim.read().await.unwrap();
        assert_eq!(reading.bytes, frame(&CAMERA, sequence).unwrap());
        assert_eq!((reading.width, reading.height, reading.lost), (64, 48, 0));
        let offset = reading.captured.since(device.begun).as_nanos() * 30;
        assert!(offset % 1_000_000_000 < 30 || offset % 1_000_000_000 > 999_999_970, "{offset}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_late_reader_gets_the_number_of_lost_samples() {
    let mut sim = Sim::open(device(CAMERA)).await.unwrap();
    sim.read().await.unwrap();
    tokio::time::sleep(Duration::from_secs(2)).await;
    let reading = sim.read().await.unwrap();
    let lost = u32::try_from(reading.lost).unwrap();
    assert!(lost >= 50, "{lost}");
    assert_eq!(reading.bytes, frame(&CAMERA, 1 + lost).unwrap());
    assert_eq!(sim.read().await.unwrap().lost, 0);
}

#[tokio::test(start_paused = true)]
async fn a_silent_device_sends_nothing_and_then_continues_its_sequence() {
    let device = device(CAMERA);
    let mut sim = Sim::open(Arc::clone(&device)).await.unwrap();
    let before = sim.read().await.unwrap().captured;
    device.set_silent(true);
    assert!(tokio::time::timeout(Duration::from_secs(5), sim.read()).await.is_err());
    device.set_silent(false);
    let reading = sim.read().await.unwrap();
    assert_eq!(reading.lost, 0);
    assert!(reading.captured.since(before) >= Duration::from_secs(5));
    assert_eq!(reading.bytes, frame(&CAMERA, 1).unwrap());
}

#[tokio::test(start_paused = true)]
async fn the_sequence_continues_across_a_replug() {
    let first = device(CAMERA);
    let mut sim = Sim::open(Arc::clone(&first)).await.unwrap();
    for _ in 0..3 {
        sim.read().await.unwrap();
    }
    first.unplug();
    assert!(matches!(sim.read().await, Err(DriverError::Gone)));
    let second = Arc::new(SimDevice::new("sim", CAMERA, first.begun));
    second.sequence.store(first.sequence.load(Ordering::Acquire), Ordering::Release);
    let mut sim = Sim::open(second).await.unwrap();
    assert_eq!(sim.read().await.unwrap().bytes, frame(&CAMERA, 3).unwrap());
}

#[test]
fn impossible_pictures_are_refused() {
    assert!(encode(0, 10, 1, 0).is_err());
    assert!(encode(100_000, 10, 1, 0).is_err());
    assert!(encode(1, 1, 1, 7).is_ok());
    assert!(encode(2, 300, 1, 7).is_ok());
}

#[tokio::test]
async fn simulated_motors_reach_the_commanded_position() {
    let text = "[device.arm]\nvid = \"1d50\"\npid = \"606f\"\nnode = \"can\"\n[device.arm.can]\nprotocol = \"damiao\"\n\
                motors = [{ name = \"a\", slave = 1, type = \"DM4310\", kp = 1, kd = 0.1, position = [-1, 1] },\n\
                          { name = \"b\", slave = 2, type = \"DM4310\", kp = 1, kd = 0.1, position = [-1, 1] }]\n";
    let registry = rapid_registry::Registry::parse(text, None).unwrap().registry;
    let arm = &registry.devices[0];
    let sends = |channels| device(SimSource::Serial { channels, hz: 1000, seed: 1 });
    assert!(check(arm, &sends(11)).is_err());
    let twelve = sends(12);
    check(arm, &twelve).unwrap();
    let mut sim = Sim::open(twelve).await.unwrap().with_node(&arm.node).unwrap();
    assert!(sim.command(&[0.5]).is_err(), "a target is missing");
    sim.joints.order(rapid_core::action::Order::Arm);
    sim.command(&[0.5, -0.25]).unwrap();
    let bytes = sim.read().await.unwrap().bytes.to_vec();
    let values: Vec<f64> = bytes.chunks(8).map(|value| f64::from_le_bytes(value.try_into().unwrap())).collect();
    assert_eq!((values.len(), values[0], values[6]), (12, 0.5, -0.25));
}

#[tokio::test]
async fn simulated_byte_streams_match_the_real_device() {
    let text = "[device.bus]\nvid = \"1d50\"\npid = \"606f\"\nnode = \"can\"\n[device.bus.can]\nprotocol = \"raw\"\n\
                [device.lidar]\nnode = \"lan\"\n[device.lidar.lan]\nprotocol = \"udp\"\nport = 2368\nhost = \"10.0.0.9\"\n";
    let registry = rapid_registry::Registry::parse(text, None).unwrap().registry;
    for (name, length) in [("bus", CAN_RECORD), ("lidar", 8)] {
        let spec = registry.named(name).unwrap();
        let source = device(SimSource::Serial { channels: 1, hz: 1000, seed: 0x0102_0304 });
        check(spec, &source).unwrap();
        let mut sim = Sim::open(source).await.unwrap().with_node(&spec.node).unwrap();
        for _ in 0..3 {
            let sequence = sim.device.sequence.load(std::sync::atomic::Ordering::Relaxed);
            let reading = sim.read().await.unwrap();
            assert_eq!((reading.encoding, reading.width, reading.bytes.len()), (Encoding::Bytes, 0, length), "{name}");
            let (head, data) = reading.bytes.split_at(length - 8);
            assert_eq!(data, [sequence.to_le_bytes(), [4, 3, 2, 1]].concat(), "{name}");
            if name == "bus" {
                assert_eq!(head, [&reading.captured.0.to_le_bytes()[..], &[0x23, 1, 0, 0, 8, 0, 0, 0]].concat());
            }
        }
    }
}
