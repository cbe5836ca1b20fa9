//! What every driver promises, tried on those that run without hardware: simulated camera, simulated
//! serial line, a serial line over a pseudo terminal, and a recorded episode.

#![expect(clippy::unwrap_used, clippy::expect_used, reason = "a test ends where what it needs is missing")]

use std::collections::BTreeMap;
use std::future::Future;
use std::io::Cursor;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use rapid_core::modality::ModalityId;
use rapid_core::sample::Encoding;
use rapid_core::sync::WhenStale;
use rapid_core::time::Stamp;
use rapid_devices::driver::{Driver, DriverError, sim};
use rapid_registry::device::{DeviceNode, LastReceived};
use rapid_registry::simulation::{SimDevice, SimSource};
use rapid_registry::{
    CameraSpec, DeviceSpec, Framing, IdentitySpec, LanFind, LanProtocol, LanSpec, NodeSpec, Parse, PixelFormat, Probe,
    SerialSpec, UsbSpec,
};
use tokio::io::AsyncWriteExt as _;
use tokio_serial::{SerialPort as _, SerialStream};

use crate::support::allocations::of_this_thread;
use crate::support::motors::PATIENCE;

const CAMERA: SimSource = SimSource::Camera { width: 64, height: 48, fps: 200, seed: 3, bytes: 0 };
const SERIAL: SimSource = SimSource::Serial { channels: 4, hz: 500, seed: 3 };

fn spec(node: NodeSpec) -> DeviceSpec {
    DeviceSpec {
        name: "device".into(),
        id: ModalityId::new(0).unwrap(),
        identity: IdentitySpec::Usb(UsbSpec { vid: 1, pid: 2, serial: None, port: None }),
        node,
        topic: "/rapid/device".into(),
        mount: None,
        stall_after: Duration::from_millis(500),
        max_bytes: 1 << 20,
        depth: 4,
        when_stale: WhenStale::Hold,
        latency: Duration::ZERO,
        form: None,
        action: None,
        hooks: rapid_registry::Hooks::default(),
        verdict: rapid_registry::VerdictSpec::defaults(
            rapid_core::modality::ModalityKind::Image,
            Duration::from_millis(500),
            Some(30.0),
        ),
    }
}

fn camera_spec() -> DeviceSpec {
    let format = PixelFormat::Mjpg;
    spec(NodeSpec::Camera(CameraSpec {
        width: 64,
        height: 48,
        fps: 200,
        format,
        depth_unit_um: 1000,
        controls: Vec::new(),
    }))
}

fn serial_spec(framing: Framing, parse: Parse, channels: usize) -> DeviceSpec {
    spec(NodeSpec::Serial(SerialSpec { baud: 115_200, framing, parse, channels }))
}

fn sim_device(source: SimSource) -> Arc<SimDevice> {
    Arc::new(SimDevice::new("device", source, Stamp::now()))
}

async fn open_sim(source: SimSource) -> (Driver, Arc<SimDevice>) {
    let spec = match source {
        SimSource::Camera { .. } | SimSource::Depth { .. } => camera_spec(),
        SimSource::Serial { channels, .. } => serial_spec(Framing::Line, Parse::Csv, channels),
        SimSource::Task { .. } | SimSource::Process | SimSource::Replay { .. } => {
            serial_spec(Framing::Line, Parse::Csv, 1)
        }
    };
    let device = sim_device(source);
    let driver = Driver::open(&spec, &DeviceNode::Sim(Arc::clone(&device))).await.unwrap();
    (driver, device)
}

/// A serial line whose other end is ours.
async fn open_pty(spec: &DeviceSpec) -> (Driver, SerialStream) {
    let (mut far, near) = SerialStream::pair().unwrap();
    let path = PathBuf::from(near.name().unwrap());
    drop(near);
    let driver = Driver::open(spec, &DeviceNode::Tty(path)).await.unwrap();
    // The end of what could be the tail of a message.
    far.write_all(b"\n").await.unwrap();
    (driver, far)
}

fn numbers(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|eight| f64::from_le_bytes(*eight)).collect()
}

/// Reads `count` samples, dropping read futures at all kinds of moments; returns the payloads.
async fn read_interrupted(driver: &mut Driver, count: usize) -> Vec<Vec<u8>> {
    let mut found = Vec::new();
    let mut last = Stamp::default();
    let mut random = 0x2545_f491_u32;
    while found.len() < count {
        // xorshift: waits from nothing to 4 ms, so that futures end before, while and after they wait.
        random ^= random << 13;
        random ^= random >> 17;
        random ^= random << 5;
        let patience = Duration::from_micros(u64::from(random % 5) * 1_000);
        let Ok(reading) = tokio::time::timeout(patience, driver.read()).await else { continue };
        let reading = reading.unwrap();
        assert_eq!(reading.lost, 0);
        assert!(reading.captured >= last, "stamps never go back");
        last = reading.captured;
        found.push(reading.bytes.to_vec());
    }
    found
}

async fn assert_gone(driver: &mut Driver) {
    // Samples that had arrived before may still come.
    let gone = tokio::time::timeout(PATIENCE, async {
        loop {
            match driver.read().await {
                Ok(_) => {}
                Err(error) => return error,
            }
        }
    });
    let error = gone.await.expect("an unplugged device ends its stream");
    assert!(matches!(error, DriverError::Gone), "{error:?}");
}

#[tokio::test(start_paused = true)]
async fn simulated_devices_lose_nothing_when_reads_are_dropped() {
    for source in [CAMERA, SERIAL] {
        let (mut driver, device) = open_sim(source.clone()).await;
        for (sequence, bytes) in read_interrupted(&mut driver, 300).await.into_iter().enumerate() {
            assert_eq!(Some(bytes), sim::frame(&source, u32::try_from(sequence).unwrap()));
        }
        assert_eq!(device.sequence.load(Ordering::Acquire), 300);
        device.unplug();
        assert_gone(&mut driver).await;
    }
}

#[tokio::test(start_paused = true)]
async fn a_pulled_cable_ends_a_read_that_waits() {
    for source in [CAMERA, SimSource::Serial { channels: 4, hz: 1, seed: 1 }] {
        let (mut driver, device) = open_sim(source).await;
        device.set_silent(true);
        let (ended, ()) = tokio::join!(driver.read(), async {
            tokio::time::sleep(Duration::from_millis(500)).await;
            device.unplug();
        });
        assert!(matches!(ended, Err(DriverError::Gone)));
    }
}

#[tokio::test]
async fn a_serial_line_loses_nothing_when_reads_are_dropped() {
    let (mut driver, mut far) = open_pty(&serial_spec(Framing::Line, Parse::Csv, 2)).await;
    let writer = tokio::spawn(async move {
        for i in 0..500_u32 {
            let line = format!("{i},{}\r\n", f64::from(i) / 8.0);
            let (head, tail) = line.as_bytes().split_at(i as usize % line.len());
            far.write_all(head).await.unwrap();
            tokio::task::yield_now().await;
            far.write_all(tail).await.unwrap();
        }
        far
    });
    let found = read_interrupted(&mut driver, 500).await;
    for (i, bytes) in found.iter().enumerate() {
        assert_eq!(numbers(bytes), [i as f64, i as f64 / 8.0]);
    }
    drop(writer.await.unwrap());
    assert_gone(&mut driver).await;
}

#[tokio::test]
async fn a_serial_line_counts_unreadable_messages() {
    let (mut driver, mut far) = open_pty(&serial_spec(Framing::Line, Parse::Json, 2)).await;
    far.write_all(b"{\"a\":1,\"b\":2}\nnoise\n[3]\n[3,4]\n").await.unwrap();
    let reading = driver.read().await.unwrap();
    assert_eq!((numbers(reading.bytes), reading.lost, reading.width), (vec![1.0, 2.0], 0, 2));
    assert_eq!(reading.encoding, Encoding::F64);
    let reading = driver.read().await.unwrap();
    assert_eq!((numbers(reading.bytes), reading.lost), (vec![3.0, 4.0], 2));
    assert!(driver.description().contains("2 values in JSON in lines"), "{}", driver.description());
}

#[tokio::test]
async fn a_recording_loses_nothing_when_reads_are_dropped() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut writer = mcap::WriteOptions::new().chunk_size(Some(256)).create(Cursor::new(Vec::new())).unwrap();
    let schema = writer.add_schema("rapid.Scalars", "protobuf", b"").unwrap();
    let channel_id = writer.add_channel(schema, "/t", "protobuf", &BTreeMap::new()).unwrap();
    for i in 0..200_u32 {
        let log_time = 1_000_000_000 + u64::from(i) * 2_000_000;
        let header = mcap::records::MessageHeader { channel_id, sequence: i, log_time, publish_time: log_time };
        let message = [&[0x12, 8][..], &f64::from(i).to_le_bytes()].concat();
        writer.write_to_known_channel(&header, &message).unwrap();
    }
    writer.finish().unwrap();
    std::fs::write(file.path(), writer.into_inner().into_inner()).unwrap();
    let source = SimSource::Replay {
        file: file.path().to_owned(),
        topic: "/t".into(),
        begin_ns: 1_000_000_000,
        of: Arc::default(),
    };
    let (mut driver, device) = open_sim(source).await;
    let found = read_interrupted(&mut driver, 200).await;
    for (i, bytes) in found.iter().enumerate() {
        assert_eq!(numbers(bytes), [i as f64]);
    }
    device.unplug();
    assert_gone(&mut driver).await;
}

/// Allocations of this thread while `future` runs.
async fn allocations<T>(future: impl Future<Output = T>) -> (u64, T) {
    let before = of_this_thread();
    let result = future.await;
    (of_this_thread() - before, result)
}

#[tokio::test(start_paused = true)]
async fn a_simulated_reading_allocates_nothing() {
    for source in [CAMERA, SERIAL] {
        let (mut driver, _device) = open_sim(source).await;
        for _ in 0..200 {
            driver.read().await.unwrap();
        }
        for _ in 0..1_000 {
            let (count, reading) = allocations(driver.read()).await;
            reading.unwrap();
            assert_eq!(count, 0);
        }
    }
}

#[tokio::test]
async fn a_serial_reading_allocates_nothing() {
    for (parse, message) in [(Parse::Csv, &b"1.5,-2,3e4\n"[..]), (Parse::Json, b"{\"x\":1,\"y\":2.5,\"z\":-3}\n")] {
        let (mut driver, mut far) = open_pty(&serial_spec(Framing::Line, parse, 3)).await;
        for round in 0..1_200 {
            far.write_all(message).await.unwrap();
            let (count, reading) = allocations(driver.read()).await;
            assert_eq!(reading.unwrap().bytes.len(), 24);
            // Warm once tokio's cooperative budget of 128 operations has run out: its list of tasks to
            // wake after that grows then, once in a runtime's life.
            assert!(count == 0 || round < 200, "{count} allocations in round {round}");
        }
    }
}

/// A driver that receives packets, and a sender.
async fn open_udp() -> (Driver, std::net::UdpSocket) {
    let free = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let find = LanFind::Host { host: free.ip(), probe: Probe::Udp, port: free.port() };
    let protocol = LanProtocol::Udp { port: free.port() };
    let lan = spec(NodeSpec::Lan(LanSpec { protocol, find, lease: Duration::from_secs(3) }));
    let driver =
        Driver::open(&lan, &DeviceNode::Lan { address: free, last_received: LastReceived::default() }).await.unwrap();
    let sender = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    sender.connect(free).unwrap();
    (driver, sender)
}

#[tokio::test]
async fn a_packet_allocates_nothing_and_has_the_kernels_time() {
    let (mut driver, sender) = open_udp().await;
    for round in 0..1_200_u32 {
        let sent = Stamp::now();
        sender.send(&round.to_le_bytes()).unwrap();
        let (count, reading) = allocations(driver.read()).await;
        let reading = reading.unwrap();
        assert_eq!((reading.bytes, reading.encoding), (&round.to_le_bytes()[..], Encoding::Bytes));
        assert_eq!(reading.flags, rapid_core::sample::FLAG_DEVICE_TIME);
        // The wall clock is read a moment apart from ours, and may be slewed.
        assert!(reading.captured.after(Duration::from_millis(1)) >= sent && reading.captured <= Stamp::now());
        // As of a serial line.
        assert!(count == 0 || round < 200, "{count} allocations in round {round}");
    }
}

#[tokio::test]
async fn no_packet_is_lost_when_reads_are_dropped_and_kernel_drops_are_counted() {
    let (mut driver, sender) = open_udp().await;
    for number in 0..200_u32 {
        sender.send(&number.to_le_bytes()).unwrap();
    }
    let read = read_interrupted(&mut driver, 200).await;
    assert!(read.iter().zip(0_u32..).all(|(packet, number)| *packet == number.to_le_bytes()));
    // More than the kernel keeps: what is dropped is counted with the packets after it.
    let large = [7; 1024];
    for _ in 0..40_000 {
        sender.send(&large).unwrap();
    }
    let (mut read, mut lost) = (0, 0);
    while let Ok(reading) = tokio::time::timeout(Duration::from_millis(200), driver.read()).await {
        lost += reading.unwrap().lost;
        read += 1;
    }
    sender.send(&large).unwrap();
    lost += driver.read().await.unwrap().lost;
    assert_eq!(read + lost, 40_000, "{read} read, {lost} lost");
    assert!(lost > 0, "the kernel keeps 40 MB");
}

#[tokio::test]
async fn a_node_of_the_wrong_kind_is_refused_by_name() {
    let error = Driver::open(&camera_spec(), &DeviceNode::Tty("/dev/ttyACM0".into())).await.unwrap_err();
    assert!(matches!(&error, DriverError::Fatal(text) if text.contains("[device.device]")), "{error:?}");
    let wrong = sim_device(SERIAL);
    let error = Driver::open(&camera_spec(), &DeviceNode::Sim(wrong)).await.unwrap_err();
    assert!(matches!(&error, DriverError::Fatal(text) if text.contains("sends numbers")), "{error:?}");
    let gone = Driver::open(&camera_spec(), &DeviceNode::Video("/dev/no-such-video".into())).await.unwrap_err();
    assert!(matches!(gone, DriverError::Gone), "{gone:?}");
}
