//! Devices on the network: what their servers, packets and announcements hold.

use rapid_core::points::{self, PacketFormat};
use rapid_core::remote::{Frames, Head, Kind, request, requested};
use rapid_core::sample::Encoding;
use rapid_devices::driver::lan::fuzzing;
use rapid_devices::hotplug::lan::fuzz_label;

/// Of the smallest entry.
const LARGEST: usize = 1024;
/// A session has a bound of its own, whatever the entry.
const LARGEST_SESSION: usize = 64 << 10;

/// The stream in pieces whose lengths the first byte gives.
fn pieces(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    let (size, stream) = bytes.split_first().map_or((0, bytes), |(size, stream)| (*size, stream));
    stream.chunks(usize::from(size) + 1)
}

/// Pictures over HTTP: none is larger than permitted, and how the bytes come in pieces does not matter.
pub fn multipart(bytes: &[u8]) {
    let Some((line, stream)) = bytes.iter().position(|byte| *byte == b'\n').map(|at| bytes.split_at(at)) else {
        return;
    };
    let Ok(content_type) = std::str::from_utf8(line) else { return };
    let (parts, malformed) = fuzzing::multipart(content_type, LARGEST, pieces(stream));
    assert!(parts.iter().all(|part| part.len() <= LARGEST));
    let whole = stream.get(1..).unwrap_or_default();
    assert_eq!((parts, malformed), fuzzing::multipart(content_type, LARGEST, [whole]));
}

/// A phone's messages, likewise.
pub fn phone(bytes: &[u8]) {
    let (sent, malformed) = fuzzing::phone(LARGEST, pieces(bytes));
    assert!(sent.iter().all(|sent| match sent {
        fuzzing::Sent::Picture(picture) => picture.len() <= LARGEST,
        fuzzing::Sent::Session(session) => session.len() <= LARGEST_SESSION,
    }));
    assert_eq!((sent, malformed), fuzzing::phone(LARGEST, [bytes.get(1..).unwrap_or_default()]));
}

/// A stream of another computer: no sample is larger than permitted, a head that is read can be written again, and how
/// the bytes come in pieces does not matter.
pub fn remote(bytes: &[u8]) {
    let frames = |pieces: &mut dyn Iterator<Item = &[u8]>| {
        let (mut reader, mut found) = (Frames::new(LARGEST), Vec::new());
        for mut piece in pieces {
            while !piece.is_empty() {
                let room = reader.room();
                let count = room.len().min(piece.len());
                let (now, rest) = piece.split_at(count);
                room[..count].copy_from_slice(now);
                piece = rest;
                match reader.filled(count) {
                    Ok(Some(head)) => found.push((head, reader.payload().to_vec())),
                    Ok(None) => {}
                    Err(error) => return (found, Some(error)),
                }
            }
        }
        (found, None)
    };
    let (found, error) = frames(&mut pieces(bytes));
    for (head, payload) in &found {
        assert!(payload.len() <= LARGEST && usize::try_from(head.length) == Ok(payload.len()));
        assert_eq!(Head::read(&head.bytes(), LARGEST), Ok(*head));
    }
    let whole = bytes.get(1..).unwrap_or_default();
    assert_eq!((found, error), frames(&mut std::iter::once(whole)));
    if let Some((host, device)) = requested(bytes) {
        assert_eq!(request(host, device).trim_end().as_bytes(), bytes);
    }
}

/// What is looked at in the answers of a server: no path leaves its folder.
pub fn answer(bytes: &[u8]) {
    fuzzing::answer(bytes);
}

/// The name of an announced instance.
pub fn label(bytes: &[u8]) {
    if let Ok(label) = std::str::from_utf8(bytes) {
        fuzz_label(label);
    }
}

/// Packets of LiDARs: what is not a packet gives no point, and every point lies where its numbers can be.
pub fn points(bytes: &[u8]) {
    for (_, format) in PacketFormat::WORDS {
        let mut count = 0;
        let is_packet = points::read(format, bytes, |point| {
            count += 1;
            assert!(point.position.iter().all(|part| part.abs() <= 5.0e6), "{point:?}");
        });
        assert!(is_packet || count == 0);
        assert!(count <= bytes.len() / 3);
    }
}

/// Packets as they are.
pub fn packets() -> Vec<Vec<u8>> {
    let mut velodyne = [&[0xff, 0xee, 0, 0][..], &[0x88, 0x13, 9].repeat(32)].concat().repeat(12);
    velodyne.extend([1, 2, 3, 4, 0x37, 0x22]);
    let livox = |kind: u8, size: u8, count: u8| {
        let mut packet = vec![0; 36];
        (packet[1], packet[5], packet[10]) = (36 + size * count, count, kind);
        packet.extend((0..size * count).map(|byte| byte.wrapping_mul(37)));
        packet
    };
    vec![velodyne, livox(1, 14, 10), livox(2, 8, 20), livox(3, 10, 12), livox(0, 24, 1)]
}

/// Streams of cameras as they are.
pub fn multiparts() -> Vec<Vec<u8>> {
    let stream = |head: &str, size: u8, body: &[u8]| [head.as_bytes(), &[b'\n', size], body].concat();
    let kind = "multipart/x-mixed-replace; boundary=--f";
    vec![
        stream(kind, 9, b"--f\r\nContent-Length: 3\r\n\r\nabc\r\n--f\r\nContent-Length: 2\r\n\r\nde\r\n--f--\r\n"),
        stream(kind, 3, b"----f\n\nabc\n--f\n\n\r\n--g\r\nd\n--f\nContent-Length: 4000000000\n\nx\n--f\n\ne\n--f\n"),
        stream("multipart/mixed;boundary=\"a b\"", 200, b"--a b\r\nX: y\r\n\r\n\r\n--a b--\r\n"),
        stream(kind, 50, &[b"--f\r\n\r\n", &[b'x'; 2000][..], b"\r\n--f\r\nContent-Length: 1\r\n\r\na"].concat()),
    ]
}

/// Connections of phones.
pub fn phones() -> Vec<Vec<u8>> {
    let message = |kind: u8, payload: &[u8]| {
        let length = u32::try_from(payload.len()).unwrap_or(0).to_le_bytes();
        [&length[..], &[kind, 0, 0, 0], payload].concat()
    };
    let frame = |picture: &[u8]| {
        let length = u32::try_from(picture.len()).unwrap_or(0).to_le_bytes();
        message(1, &[&length[..], &[0; 80], picture].concat())
    };
    vec![
        [&[7][..], &message(0, b"{\"sessionId\":\"a\"}"), &frame(b"one"), &message(3, b"{}"), &frame(b"")].concat(),
        [&[200][..], &message(0, &[b' '; 2000]), &frame(b"one"), &message(0, &[b' '; 70_000]), &frame(b"two")].concat(),
        [&[255][..], &frame(&[9; 1024]), &frame(&[9; 1025]), &message(1, b"short"), &frame(b"two")].concat(),
    ]
}

/// Streams of another computer, and a request.
pub fn remotes() -> Vec<Vec<u8>> {
    let sample = |payload: &[u8], encoding| {
        let length = u32::try_from(payload.len()).unwrap_or(0);
        let head = Head { kind: Kind::Sample, length, encoding: Some(encoding), seq: 9, ..Head::default() };
        [&head.bytes()[..], payload].concat()
    };
    let alive = Head { offset_ns: -5, uncertainty_ns: 7, ..Head::default() }.bytes();
    let refused = Head { kind: Kind::Refused, length: 6, ..Head::default() }.bytes();
    vec![
        [&[70][..], &alive, &sample(b"\xff\xd8\xff\xd9", Encoding::Mjpeg), &alive].concat(),
        [&[9][..], &sample(&[0; 24], Encoding::F64), &sample(b"", Encoding::Bytes), &refused, b"absent"].concat(),
        [&[255][..], &sample(&[1; 1024], Encoding::Grey), &sample(&[1; 1025], Encoding::Yuyv)].concat(),
        b"rapid-remote-1 robot-b cam_wrist".to_vec(),
    ]
}

/// Answers of a GoPro, and a picture's beginning.
pub fn answers() -> Vec<Vec<u8>> {
    vec![
        br#"{"status":{"8":0,"10":1,"35":3600,"54":1000,"70":87},"settings":{}}"#.to_vec(),
        br#"{"folder":"100GOPRO","file":"GX010001.MP4"}"#.to_vec(),
        br#"{"folder":"..","file":"../../etc/passwd"}"#.to_vec(),
        br#"{"info":{"model_name":"HERO11 Black","firmware_version":"H22.01"},"s":"1234"}"#.to_vec(),
        vec![0xff, 0xd8, 0xff, 0xfe, 0, 4, 1, 2, 0xff, 0xff, 0xc0, 0, 11, 8, 0, 120, 0, 160, 1, 1, 0x11, 0],
    ]
}

/// Names of instances as DNS writes them.
pub fn labels() -> Vec<Vec<u8>> {
    [r"iPhone-iPhoneVIO", r"one\. two", r"tab\009end", r"\195\164", r"odd\"].map(|text| text.as_bytes().to_vec()).into()
}
