use std::net::{Ipv4Addr, SocketAddr};

use rapid_core::remote::{LONGEST_REASON, requested};
use rapid_registry::LanPicture;
use rapid_registry::device::{DeviceNode, LastReceived};
use tokio::net::TcpListener;

use super::super::address::DeviceAddress;
use super::*;

const PICTURES: RemoteSamples = RemoteSamples::Pictures(LanPicture { width: 4, height: 2, fps: 30 }, PixelFormat::Grey);
const LEASE: Duration = Duration::from_secs(30);

fn alive() -> Vec<u8> {
    Head::default().bytes().to_vec()
}

fn sample(seq: u64, encoding: Encoding, payload: &[u8]) -> Vec<u8> {
    let head = Head {
        kind: Kind::Sample,
        length: u32::try_from(payload.len()).unwrap(),
        encoding: Some(encoding),
        seq,
        capture_ns: Stamp::now().0,
        offset_ns: -5,
        uncertainty_ns: 7,
        width: 4,
        height: 2,
        ..Head::default()
    };
    [&head.bytes()[..], payload].concat()
}

/// The driver of a device whose `rapid-remote` sends this and then ends the connection, or stays silent.
async fn open(samples: RemoteSamples, sent: Vec<Vec<u8>>, lease: Duration, stays: bool) -> Result<Remote, DriverError> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("a port");
    let address = listener.local_addr().expect("an address");
    tokio::spawn(async move {
        let (mut stream, _) = listener.accept().await.expect("a connection");
        let mut line = vec![0; request("robot-b", "cam").len()];
        stream.read_exact(&mut line).await.expect("a request");
        assert_eq!(requested(line.trim_ascii_end()), Some(("robot-b", "cam")));
        stream.write_all(&sent.concat()).await.expect("a reader");
        if stays {
            std::future::pending::<()>().await;
        }
    });
    let node = DeviceNode::Lan { address, last_received: LastReceived::default() };
    let server = DeviceAddress::new(&node, None)?.server(address.port())?;
    let wanted = Wanted { host: "robot-b", device: "cam", samples, lease };
    Remote::open("x", server, wanted, 8).await
}

/// What reading ends with after these frames.
async fn ends(samples: RemoteSamples, sent: Vec<Vec<u8>>) -> String {
    let mut remote = match open(samples, [vec![alive()], sent].concat(), LEASE, false).await {
        Ok(remote) => remote,
        Err(error) => return error.to_string(),
    };
    loop {
        if let Err(error) = remote.read().await {
            return error.to_string();
        }
    }
}

#[tokio::test]
async fn samples_come_with_their_clock_and_what_is_missing_is_counted() {
    let sent = [5, 6, 9].map(|seq| sample(seq, Encoding::Grey, &[7; 8])).to_vec();
    let restarted = vec![alive(), sample(0, Encoding::Grey, b"12345678"), sample(u64::MAX, Encoding::Grey, &[1; 8])];
    let mut remote = open(PICTURES, [vec![alive()], sent, restarted].concat(), LEASE, false).await.expect("present");
    assert_eq!(remote.clock(), None);
    let mut lost = Vec::new();
    let error = loop {
        match remote.read().await {
            Ok(reading) => {
                assert_eq!((reading.encoding, reading.width, reading.bytes.len()), (Encoding::Grey, 4, 8));
                assert_eq!(reading.flags, 0);
                lost.push(reading.lost);
            }
            Err(error) => break error,
        }
    };
    assert_eq!(lost, [0, 0, 2, 0, 0]);
    assert!(matches!(error, DriverError::Gone), "{error:?}");
    assert_eq!(remote.clock(), Some(ClockOffset { offset_ns: -5, uncertainty_ns: 7 }));
}

#[tokio::test]
async fn what_does_not_fit_the_entry_is_named_with_its_fix() {
    use Encoding::{Bytes, F64, Grey, Mjpeg};
    let numbers = RemoteSamples::Numbers(1);
    for (samples, encoding, payload, expected) in [
        (
            PICTURES,
            Mjpeg,
            &b"x"[..],
            "its pictures are MJPG: write kind = \"image\" and format = \"MJPG\" in [device.x.lan]",
        ),
        (PICTURES, F64, &[0; 8], "its samples are of another kind: write kind = \"scalars\" in [device.x.lan]"),
        (PICTURES, Bytes, b"x", "its samples are of another kind: write kind = \"bytes\" in [device.x.lan]"),
        (numbers, Grey, &[0; 8], "its samples are of another kind: write kind = \"image\" in [device.x.lan]"),
        (numbers, F64, &[0; 0], "its samples have 0 values: write channels = 0 in [device.x.lan]"),
        (
            RemoteSamples::Bytes,
            F64,
            &[0; 8],
            "its samples are of another kind: write kind = \"scalars\" in [device.x.lan]",
        ),
        (
            PICTURES,
            Grey,
            &[0; 9],
            "a sample has 9 bytes, more than the 8 of max_bytes: write a larger max_bytes in [device.x]",
        ),
    ] {
        assert_eq!(ends(samples, vec![sample(0, encoding, payload)]).await, expected);
    }
    let sized = RemoteSamples::Pictures(LanPicture { width: 8, height: 1, fps: 30 }, PixelFormat::Grey);
    let expected = "its pictures are 4x2: write width = 4 and height = 2 in [device.x.lan]";
    assert_eq!(ends(sized, vec![sample(0, Grey, &[0; 8])]).await, expected);
    let foreign =
        ends(PICTURES, vec![b"HTTP/1.1 400 Bad Request\r\n\r\n and what a server may send then".to_vec(); 2]).await;
    assert!(foreign.contains("not a frame of rapid-remote"), "{foreign}");
}

#[tokio::test]
async fn an_impossible_capture_time_decides_for_one_sample() {
    const S: i64 = 1_000_000_000;
    // How long ago each was captured, and whether that is believed.
    let table = [
        (S, true),
        (S, true),
        (3600 * S, false),
        (11 * S, false),
        (-2 * S, false),
        (i64::MIN, false),
        (5 * S, false),
        (S, true),
        (S / 2, true),
    ];
    let sent = table.iter().zip(0..).map(|((age, _), seq)| {
        let capture_ns = Stamp::now().0.saturating_sub_signed(*age);
        let head = Head {
            kind: Kind::Sample,
            encoding: Some(Encoding::Grey),
            length: 8,
            seq,
            capture_ns,
            width: 4,
            height: 2,
            ..Head::default()
        };
        [&head.bytes()[..], &[0; 8]].concat()
    });
    let mut remote = open(PICTURES, [vec![alive()], sent.collect()].concat(), LEASE, false).await.expect("present");
    let mut newest = Stamp::default();
    for (age, is_believed) in table {
        let Reading { captured, flags, .. } = remote.read().await.expect("a sample");
        assert_eq!(flags == 0, is_believed, "{age}");
        assert!(captured >= newest && captured <= Stamp::now(), "{age}");
        newest = captured;
    }
    let ended = remote.read().await.map(|_| ());
    assert!(matches!(ended, Err(DriverError::Gone)), "{ended:?}");
}

#[tokio::test]
async fn a_refusal_the_end_and_silence_mean_that_it_is_gone() {
    let reason = [b'x'; LONGEST_REASON];
    let head = Head { kind: Kind::Refused, length: 400, ..Head::default() }.bytes().to_vec();
    let refused = open(PICTURES, vec![head, reason.to_vec()], LEASE, false).await;
    assert!(matches!(refused, Err(DriverError::Gone)), "{refused:?}");
    let ended = open(PICTURES, Vec::new(), LEASE, false).await;
    assert!(matches!(ended, Err(DriverError::Gone)), "{ended:?}");
    let mut silent = open(PICTURES, vec![alive()], Duration::from_millis(50), true).await.expect("present");
    let read = silent.read().await.map(|_| ());
    assert!(matches!(read, Err(DriverError::Gone)), "{read:?}");
    let closed: SocketAddr = {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("a port");
        listener.local_addr().expect("an address")
    };
    let node = DeviceNode::Lan { address: closed, last_received: LastReceived::default() };
    let server = DeviceAddress::new(&node, None).and_then(|place| place.server(closed.port())).expect("a server");
    let wanted = Wanted { host: "robot-b", device: "cam", samples: PICTURES, lease: LEASE };
    assert!(matches!(Remote::open("x", server, wanted, 8).await, Err(DriverError::Retry(_))));
}
