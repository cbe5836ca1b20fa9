use std::io::Write as _;
use std::net::UdpSocket;

use rapid_motors::control::can::CanFrame;

use super::*;
use crate::driver::can::{link, socket};
use crate::patience::PATIENCE;

fn raw(link: Link) -> Raw {
    Raw::on(link, Format::Messages { baud: None, channels: 0, hz: None }).unwrap()
}

async fn read(raw: &mut Raw) -> Result<(Vec<u8>, Stamp, u64), DriverError> {
    let reading = tokio::time::timeout(PATIENCE, raw.read()).await.unwrap()?;
    assert_eq!((reading.encoding, reading.width, reading.height), (Encoding::Bytes, 0, 0));
    Ok((reading.bytes.to_vec(), reading.captured, reading.lost))
}

#[tokio::test]
async fn a_batch_holds_the_pending_frames_as_records() {
    let (link, mut adapter) = link::tests::damiao_link();
    let mut raw = raw(link);
    let frame = CanFrame { len: 3, ..CanFrame::standard(0x123, [1, 2, 3, 0, 0, 0, 0, 0]) };
    let other = CanFrame::standard(0x7ff, [9; 8]);
    adapter.write_all(&[link::tests::received(&frame), link::tests::received(&other)].concat()).unwrap();
    let (mut bytes, captured, _) = read(&mut raw).await.unwrap();
    // The line may hand over one after the other.
    while bytes.len() < 2 * CAN_RECORD {
        bytes.extend(read(&mut raw).await.unwrap().0);
    }
    assert_eq!(bytes.len(), 2 * CAN_RECORD);
    assert_eq!(bytes[..8], captured.0.to_le_bytes());
    assert_eq!(bytes[8..24], [0x23, 1, 0, 0, 3, 0, 0, 0, 1, 2, 3, 0, 0, 0, 0, 0]);
    assert_eq!(bytes[32..48], [0xff, 7, 0, 0, 8, 0, 0, 0, 9, 9, 9, 9, 9, 9, 9, 9]);
    drop(adapter);
    assert!(matches!(read(&mut raw).await, Err(DriverError::Gone)));
}

#[tokio::test]
async fn flags_match_linux_and_no_batch_is_larger_than_permitted() {
    let (link, bus) = socket::tests::bus();
    let mut raw = raw(link);
    let frame = CanFrame { id: 0x1abc_def0, extended: true, ..CanFrame::standard(0, [5; 8]) };
    let remote = CanFrame { remote: true, len: 8, ..CanFrame::standard(1, [0; 8]) };
    for _ in 0..CAN_BATCH {
        bus.send(&socket::tests::bytes(&frame)).unwrap();
        bus.send(&socket::tests::bytes(&remote)).unwrap();
    }
    let mut all = Vec::new();
    while all.len() < 2 * CAN_BATCH * CAN_RECORD {
        let (bytes, _, lost) = read(&mut raw).await.unwrap();
        assert!(bytes.len() <= CAN_BATCH * CAN_RECORD && lost == 0);
        all.extend(bytes);
    }
    let ids: Vec<u32> =
        all.chunks(CAN_RECORD).map(|record| u32::from_le_bytes(record[8..12].try_into().unwrap())).collect();
    assert_eq!(ids, [0x9abc_def0, 0x4000_0001].repeat(CAN_BATCH));
}

#[tokio::test]
async fn a_permanent_bus_off_is_delivered_before_the_end() {
    let (link, bus) = socket::tests::bus();
    let mut raw = raw(link);
    let off = CanFrame { id: 0x40, error: true, ..CanFrame::standard(0, [0; 8]) };
    bus.send(&socket::tests::bytes(&off)).unwrap();
    let (bytes, ..) = read(&mut raw).await.unwrap();
    assert_eq!(bytes[8..12], 0x2000_0040_u32.to_le_bytes());
    let Err(DriverError::Retry(text)) = read(&mut raw).await else { panic!("it ended") };
    assert!(text.contains("bus-off"), "{text}");
}

/// As many frames as a full bus has in two seconds, a thousand times a second eight at once.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_saturated_bus_is_received_without_loss() {
    const FRAMES: u32 = 16_000;
    let (link, bus) = socket::tests::bus();
    let mut raw = raw(link);
    let sender = std::thread::spawn(move || send_all(&bus, FRAMES));
    let mut expected = 0_u32;
    while expected < FRAMES {
        let (bytes, _, lost) = read(&mut raw).await.unwrap();
        assert_eq!(lost, 0, "after {expected} frames");
        for record in bytes.chunks(CAN_RECORD) {
            assert_eq!(record[16..20], expected.to_le_bytes());
            expected += 1;
        }
    }
    sender.join().unwrap();
}

fn send_all(bus: &UdpSocket, frames: u32) {
    for number in 0..frames {
        let [a, b, c, d] = number.to_le_bytes();
        bus.send(&socket::tests::bytes(&CanFrame::standard(0x123, [a, b, c, d, 0, 0, 0, 0]))).unwrap();
        if number % 8 == 7 {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
