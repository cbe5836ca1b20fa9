use proptest::prelude::*;

use super::*;

/// A message as the phone sends it.
fn message(kind: u8, payload: &[u8]) -> Vec<u8> {
    let mut bytes = u32::try_from(payload.len()).expect("short").to_le_bytes().to_vec();
    bytes.extend([kind, 0, 0, 0]);
    bytes.extend(payload);
    bytes
}

fn frame_payload(picture: &[u8], claimed: u32, time: f64) -> Vec<u8> {
    let mut payload = claimed.to_le_bytes().to_vec();
    payload.extend((0_u8..16).flat_map(|index| f32::from(index).to_le_bytes()));
    payload.extend(time.to_le_bytes());
    payload.extend(1_700_000_000.5_f64.to_le_bytes());
    payload.extend(picture);
    payload
}

fn picture(bytes: &[u8], time: f64) -> Vec<u8> {
    message(1, &frame_payload(bytes, u32::try_from(bytes.len()).expect("short"), time))
}

#[derive(Debug, PartialEq)]
enum Parsed {
    Picture(Vec<u8>, f64),
    Session(Vec<u8>),
    Malformed,
}

fn parsed(stream: &[u8], size: usize) -> Vec<Parsed> {
    let mut packets = Packets::new(100);
    let mut parsed = Vec::new();
    for mut piece in stream.chunks(size.max(1)) {
        while !piece.is_empty() {
            let (taken, cut) = packets.feed(piece);
            piece = &piece[taken..];
            match cut {
                Cut::Open => assert!(piece.is_empty(), "stopped early"),
                Cut::Frame(frame) => parsed.push(Parsed::Picture(packets.payload().to_vec(), frame.device_time)),
                Cut::Session => parsed.push(Parsed::Session(packets.payload().to_vec())),
                Cut::Malformed => parsed.push(Parsed::Malformed),
            }
        }
    }
    assert!(packets.payload.capacity() <= LARGEST_SESSION.max(4 * (FRAME_HEAD + 100)), "memory is bounded");
    parsed
}

#[track_caller]
fn check(stream: &[u8], expected: &[Parsed]) {
    for size in [1, 3, 8, 85, stream.len()] {
        assert_eq!(parsed(stream, size), expected, "pieces of {size}");
    }
}

#[test]
fn sessions_and_frames_are_parsed_and_other_messages_skipped() {
    let stream = [
        message(0, br#"{"sessionId":"a"}"#),
        picture(b"one", 12.5),
        message(2, b"{}"),
        message(3, b""),
        message(200, &[7; 300]),
        picture(b"", 12.6),
        message(0, b""),
        picture(&[9; 100], 12.7),
    ]
    .concat();
    check(
        &stream,
        &[
            Parsed::Session(br#"{"sessionId":"a"}"#.to_vec()),
            Parsed::Picture(b"one".to_vec(), 12.5),
            Parsed::Picture(Vec::new(), 12.6),
            Parsed::Session(Vec::new()),
            Parsed::Picture(vec![9; 100], 12.7),
        ],
    );
}

#[test]
fn a_malformed_message_loses_only_itself() {
    let stream = [
        picture(&[9; 101], 1.0),
        message(1, b"short"),
        message(1, &[]),
        message(1, &frame_payload(b"abc", 2, 1.0)),
        message(1, &frame_payload(b"abc", u32::MAX, 1.0)),
        message(0, &vec![b' '; LARGEST_SESSION + 1]),
        picture(b"two", 2.0),
    ]
    .concat();
    let bad = || Parsed::Malformed;
    check(&stream, &[bad(), bad(), bad(), bad(), bad(), Parsed::Picture(b"two".to_vec(), 2.0)]);
}

#[test]
fn a_frame_carries_the_camera_pose() {
    let mut packets = Packets::new(100);
    let bytes = picture(b"x", 3.25);
    let (taken, Cut::Frame(frame)) = packets.feed(&bytes) else { panic!("a frame") };
    assert_eq!(taken, bytes.len());
    assert_eq!(frame.pose[1].to_bits(), 1.0_f32.to_bits());
    assert_eq!(frame.pose[15].to_bits(), 15.0_f32.to_bits());
    assert_eq!((frame.device_time, frame.wall_clock), (3.25, 1_700_000_000.5));
}

proptest! {
    #[test]
    fn any_bytes_are_survived_and_chunking_does_not_matter(
        messages in prop::collection::vec((0_u8..5, prop::collection::vec(any::<u8>(), 0..200), any::<bool>()), 0..8),
        tail in prop::collection::vec(any::<u8>(), 0..20), size in 1_usize..50,
    ) {
        let mut stream = Vec::new();
        for (kind, payload, whole) in messages {
            stream.extend(if whole { picture(&payload, 1.0) } else { message(kind, &payload) });
        }
        stream.extend(tail);
        // Poses and times of random bytes may be NaN, which equals nothing.
        prop_assert_eq!(format!("{:?}", parsed(&stream, size)), format!("{:?}", parsed(&stream, stream.len())));
    }
}
