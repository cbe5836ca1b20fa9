use std::collections::BTreeMap;
use std::io::{Cursor, Write as _};

use super::*;
use crate::mask::PhysicalMask;
use crate::registry::scenario::ScenarioAction;

const BEGIN: u64 = 1_700_000_000_000_000_000;
const REGISTRY: &str = r#"
[device.tof]
vid = "0x10c4"
pid = 0xea60
serial_number = "T1"
node = "serial"
bit = 0
topic = "/rapid/tof"
[device.tof.serial]
channels = 1
[device.cam]
vid = "046d"
pid = "0825"
port = "1-2.3"
node = "camera"
bit = 3
topic = "/rapid/cam"
"#;

/// A `rapid.Scalars` of one value, by hand: field 2, length-delimited, eight bytes.
fn scalars(value: f64) -> Vec<u8> {
    [&[0x12, 8][..], &value.to_le_bytes()].concat()
}

/// A `rapid.Mask`, by hand: field 2, fixed64.
fn mask(bits: u64) -> Vec<u8> {
    [&[0x11][..], &bits.to_le_bytes()].concat()
}

fn options() -> mcap::WriteOptions {
    mcap::WriteOptions::new().chunk_size(Some(512)).compression(Some(mcap::Compression::Zstd))
}

/// 100 samples, 10 ms apart, and a mask that shows `tof` (bit 0) from the beginning, gone at 400 ms,
/// back at 700 ms; `cam` (bit 3) comes at 500 ms.
fn episode(options: mcap::WriteOptions) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut writer = options.create(Cursor::new(&mut bytes)).unwrap();
    let channel = |writer: &mut mcap::Writer<_>, topic: &str, schema: &str| {
        let schema = writer.add_schema(schema, "protobuf", b"").unwrap();
        writer.add_channel(schema, topic, "protobuf", &BTreeMap::new()).unwrap()
    };
    let tof = channel(&mut writer, "/rapid/tof", "rapid.Scalars");
    let masks = channel(&mut writer, "/rapid/mask", "rapid.Mask");
    let mut write = |channel_id, at_ms: u64, data: &[u8]| {
        let log_time = BEGIN + at_ms * 1_000_000;
        let header = mcap::records::MessageHeader { channel_id, sequence: 0, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, data).unwrap();
    };
    for i in 0..100_u32 {
        let at = u64::from(i) * 10;
        let bits = u64::from(!(400..700).contains(&at)) | u64::from(at >= 500) << 3;
        write(masks, at, &mask(bits));
        write(tof, at, &scalars(f64::from(i)));
    }
    let entries = [("layout", r#"{"tof":0,"cam":3}"#), ("registry", REGISTRY), ("task", "x")];
    let metadata = entries.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
    writer.write_metadata(&mcap::records::Metadata { name: "rapid".into(), metadata }).unwrap();
    writer.finish().unwrap();
    drop(writer);
    bytes
}

fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(bytes).unwrap();
    file
}

fn device(file: &Path, topic: &str) -> Arc<SimDevice> {
    let source = SimSource::Replay { file: file.to_owned(), topic: topic.to_owned(), begin_ns: BEGIN };
    Arc::new(SimDevice::new("tof", source, stamp_of(Instant::now())))
}

fn value(reading: &Reading<'_>) -> f64 {
    f64::from_le_bytes(reading.bytes.try_into().unwrap())
}

#[tokio::test(start_paused = true)]
async fn samples_come_in_order_at_their_recorded_distances_then_silence() {
    for options in [options(), options().use_chunks(false), options().compression(None)] {
        let file = file(&episode(options));
        let device = device(file.path(), "/rapid/tof");
        let mut replay = Replay::open(Arc::clone(&device)).await.unwrap();
        for i in 0..100_u32 {
            let reading = replay.read().await.unwrap();
            assert_eq!(value(&reading).to_bits(), f64::from(i).to_bits());
            assert_eq!((reading.encoding, reading.width), (crate::sample::Encoding::F64, 1));
            assert_eq!(reading.captured.since(device.begun), Duration::from_millis(u64::from(i) * 10));
            assert!(stamp_of(Instant::now()) >= reading.captured, "a sample is not given before its time");
        }
        assert!(tokio::time::timeout(Duration::from_millis(50), replay.read()).await.is_err());
        device.unplug();
        assert!(matches!(replay.read().await, Err(DriverError::Gone)));
    }
}

#[tokio::test(start_paused = true)]
async fn a_replugged_device_goes_on_at_the_present_moment() {
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
    assert_eq!(topics, [("/rapid/mask", "rapid.Mask", Some(100)), ("/rapid/tof", "rapid.Scalars", Some(100))]);
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
    assert_eq!(registry, crate::registry::Registry::parse(REGISTRY, None).unwrap().registry);
    let plugged: Vec<_> = scenario.devices.iter().map(|device| (device.name.as_str(), device.plugged)).collect();
    assert_eq!(plugged, [("tof", true), ("cam", false)]);
    let [tof, cam] = &scenario.devices[..] else { panic!("two devices") };
    assert_eq!((tof.usb.vid, tof.usb.pid, tof.usb.serial.as_deref()), (0x10c4, 0xea60, Some("T1")));
    assert_eq!((cam.usb.vid, cam.usb.pid, cam.usb.port.as_str()), (0x046d, 0x0825, "1-2.3"));
    let topic = SimSource::Replay { file: file.path().to_owned(), topic: "/rapid/cam".into(), begin_ns: BEGIN };
    assert_eq!(cam.source, topic);
    let events: Vec<_> =
        scenario.events.iter().map(|event| (event.at.as_millis(), event.device.as_str(), &event.action)).collect();
    let plug = ScenarioAction::Plug { port: None };
    // A device is attached 100 ms before the first sample that sets its bit.
    assert_eq!(events, [(400, "tof", &ScenarioAction::Unplug), (400, "cam", &plug), (600, "tof", &plug)]);
}

#[tokio::test]
async fn what_cannot_be_played_is_said() {
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
    assert!(unclosed.contains("rapid inspect"), "{unclosed}");
    assert!(refused(Path::new("/no/such.mcap"), "/rapid/tof").await.contains("/no/such.mcap"));
    assert!(describe(file(b"").path()).is_err());
}

/// Every damaged file gives an error or fewer messages.
#[test]
fn damaged_files_never_panic() {
    for options in [options(), options().compression(None), options().use_chunks(false)] {
        let whole = episode(options);
        for at in (0..whole.len()).step_by(11) {
            let mut bytes = whole.clone();
            bytes[at] ^= 1 << (at % 8);
            if at % 7 == 0 {
                bytes.truncate(bytes.len() - at / 2);
            }
            let file = file(&bytes);
            let Ok(episode) = Episode::open(file.path()) else { continue };
            if let Ok((mut messages, _)) = episode.play("/rapid/tof", 0) {
                let mut count = 0;
                while let Ok(Some(_)) = messages.next() {
                    count += 1;
                    assert!(count <= 100);
                }
            }
            let _ = scenario(file.path());
        }
    }
}
