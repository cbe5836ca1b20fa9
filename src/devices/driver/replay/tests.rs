use std::io::Write as _;

use rapid_core::mask::PhysicalMask;
use rapid_registry::scenario::ScenarioAction;

use crate::recorded::{BEGIN, REGISTRY, episode, layouts, mutated, mutations, options};
use proptest::prelude::*;

use super::*;
use crate::effort::{cases, every};

fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(bytes).unwrap();
    file
}

fn device(file: &Path, topic: &str) -> Arc<SimDevice> {
    let source =
        SimSource::Replay { file: file.to_owned(), topic: topic.to_owned(), begin_ns: BEGIN, of: Arc::default() };
    Arc::new(SimDevice::new("tof", source, stamp_of(Instant::now())))
}

fn value(reading: &Reading<'_>) -> f64 {
    f64::from_le_bytes(reading.bytes.try_into().unwrap())
}

#[tokio::test(start_paused = true)]
async fn samples_are_replayed_in_order_at_their_recorded_intervals_then_silence() {
    for options in layouts() {
        let file = file(&episode(options));
        let device = device(file.path(), "/rapid/tof");
        let mut replay = Replay::open(Arc::clone(&device)).await.unwrap();
        for i in 0..100_u32 {
            let reading = replay.read().await.unwrap();
            assert_eq!(value(&reading).to_bits(), f64::from(i).to_bits());
            assert_eq!((reading.encoding, reading.width), (rapid_core::sample::Encoding::F64, 1));
            assert_eq!(reading.captured.since(device.begun), Duration::from_millis(u64::from(i) * 10));
            assert!(stamp_of(Instant::now()) >= reading.captured, "a sample is not given before its time");
        }
        assert!(tokio::time::timeout(Duration::from_millis(50), replay.read()).await.is_err());
        device.unplug();
        assert!(matches!(replay.read().await, Err(DriverError::Gone)));
    }
}

#[tokio::test(start_paused = true)]
async fn a_replugged_device_continues_at_the_present_moment() {
    let file = file(&episode(options()));
    let first = device(file.path(), "/rapid/tof");
    let mut replay = Replay::open(Arc::clone(&first)).await.unwrap();
    replay.read().await.unwrap();
    tokio::time::sleep(Duration::from_millis(505)).await;
    let second = Arc::new(SimDevice::new("tof", first.source.clone(), first.begun));
    second.sequence.store(first.sequence.load(Ordering::Acquire), Ordering::Release);
    let mut replay = Replay::open(second).await.unwrap();
    assert_eq!(value(&replay.read().await.unwrap()).to_bits(), 51.0_f64.to_bits());
}

#[test]
fn an_episode_describes_itself() {
    let file = file(&episode(options()));
    let episode = describe(file.path()).unwrap();
    assert_eq!((episode.begin_ns, episode.end_ns), (BEGIN, BEGIN + 990_000_000));
    let topics: Vec<_> = episode.topics.iter().map(|t| (t.topic.as_str(), t.schema.as_str(), t.messages)).collect();
    assert_eq!(topics, [("/rapid/mask", "rapid.Mask", 100), ("/rapid/tof", "rapid.Scalars", 100)]);
    let layout: Vec<_> = episode.layout.iter().map(|(name, id)| (name.as_str(), id.bit())).collect();
    assert_eq!(layout, [("tof", 0), ("cam", 3)]);
    let ms = |at: u64| BEGIN + at * 1_000_000;
    let changes = [(ms(0), 1), (ms(400), 0), (ms(500), 8), (ms(700), 9)];
    assert_eq!(episode.mask, changes.map(|(at, bits)| (at, PhysicalMask(bits))));
}

#[test]
fn a_scenario_follows_the_recorded_mask() {
    let file = file(&episode(options()));
    let Replayed { registry, scenario, length } = scenario(file.path()).unwrap();
    assert_eq!(length.as_millis(), 990);
    assert_eq!(registry, rapid_registry::Registry::parse(REGISTRY, None).unwrap().registry);
    let plugged: Vec<_> = scenario.devices.iter().map(|device| (device.name.as_str(), device.plugged)).collect();
    assert_eq!(plugged, [("tof", true), ("cam", false)]);
    let [tof, cam] = &scenario.devices[..] else { panic!("two devices") };
    assert_eq!((tof.usb.vid, tof.usb.pid, tof.usb.serial.as_deref()), (0x10c4, 0xea60, Some("T1")));
    assert_eq!((cam.usb.vid, cam.usb.pid, cam.usb.port.as_str()), (0x046d, 0x0825, "1-2.3"));
    let SimSource::Replay { of, .. } = &cam.source else { panic!("{cam:?}") };
    assert_eq!((of.file.as_str(), of.begin_ns, of.verdict.as_str()), (&*file.path().to_string_lossy(), BEGIN, "BAD"));
    assert!(!of.reasons.is_empty(), "nothing in it can be judged");
    let of = Arc::clone(of);
    let topic = SimSource::Replay { file: file.path().to_owned(), topic: "/rapid/cam".into(), begin_ns: BEGIN, of };
    assert_eq!(cam.source, topic);
    let events: Vec<_> =
        scenario.events.iter().map(|event| (event.at.as_millis(), event.device.as_str(), &event.action)).collect();
    let plug = ScenarioAction::Plug { port: None };
    // A device is attached 100 ms before the first sample that sets its bit.
    assert_eq!(events, [(400, "tof", &ScenarioAction::Unplug), (400, "cam", &plug), (600, "tof", &plug)]);
}

#[tokio::test]
async fn unplayable_files_are_errors() {
    let whole = file(&episode(options()));
    let refused = |file: &Path, topic: &str| {
        let device = device(file, topic);
        async move { Replay::open(device).await.unwrap_err().to_string() }
    };
    let unknown = refused(whole.path(), "/rapid/zip").await;
    assert!(unknown.contains("no topic /rapid/zip; it has /rapid/mask, /rapid/tof"), "{unknown}");
    let mask = refused(whole.path(), "/rapid/mask").await;
    assert!(mask.contains("\"rapid.Mask\""), "{mask}");
    let bytes = episode(options());
    let cut = file(&bytes[..bytes.len() - 20]);
    let unclosed = refused(cut.path(), "/rapid/tof").await;
    assert!(unclosed.contains("was not closed") && unclosed.contains("`rapid recover /"), "{unclosed}");
    let mut bytes = bytes;
    let last = bytes.len() - 30;
    bytes[last] = 0xff;
    let error = describe(file(&bytes).path()).unwrap_err().to_string();
    assert!(error.contains("is damaged; `rapid recover /"), "{error}");
    assert!(refused(Path::new("/no/such.mcap"), "/rapid/tof").await.contains("/no/such.mcap"));
    assert!(describe(file(b"").path()).is_err());
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe.mcap");
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, 0o600.into(), 0).unwrap();
    let link = folder.path().join("link.mcap");
    std::os::unix::fs::symlink(&pipe, &link).unwrap();
    for path in [folder.path(), &pipe, &link, Path::new("/dev/zero")] {
        let error = describe(path).unwrap_err().to_string();
        assert!(error.contains("not a file"), "{error}");
    }
}

/// Every damaged file gives an error or fewer messages.
#[test]
fn damaged_files_never_panic() {
    for options in layouts() {
        let whole = episode(options);
        for at in (0..whole.len()).step_by(11 * every(9)) {
            let mut bytes = whole.clone();
            bytes[at] ^= 1 << (at % 8);
            if at % 7 == 0 {
                bytes.truncate(bytes.len() - at / 2);
            }
            let file = file(&bytes);
            if let Ok(mut messages) = play(file.path(), "/rapid/tof", 0) {
                let mut count = 0;
                while let Ok(true) = messages.advance() {
                    let _ = messages.sample();
                    count += 1;
                    assert!(count <= 100);
                }
            }
            let _ = scenario(file.path());
        }
        for cut in (0..whole.len()).step_by(every(13)) {
            read_bytes(&whole[..cut]);
        }
        let config = ProptestConfig { cases: cases(300), failure_persistence: None, ..ProptestConfig::default() };
        proptest!(config, |(mutations in mutations())| read_bytes(&mutated(&whole, &mutations)));
    }
}
