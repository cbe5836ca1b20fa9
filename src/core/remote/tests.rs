use proptest::prelude::*;

use super::*;

/// Kind and payload of the frames in these pieces, and the error that ends them.
fn read<'p>(most: usize, pieces: impl IntoIterator<Item = &'p [u8]>) -> (Vec<(Head, Vec<u8>)>, Option<FrameError>) {
    let (mut frames, mut found) = (Frames::new(most), Vec::new());
    for mut piece in pieces {
        while !piece.is_empty() {
            let room = frames.room();
            let count = room.len().min(piece.len());
            room[..count].copy_from_slice(&piece[..count]);
            piece = &piece[count..];
            match frames.filled(count) {
                Ok(Some(head)) => found.push((head, frames.payload().to_vec())),
                Ok(None) => {}
                Err(error) => return (found, Some(error)),
            }
        }
    }
    (found, None)
}

fn sample(payload: &[u8]) -> Head {
    Head {
        kind: Kind::Sample,
        length: u32::try_from(payload.len()).unwrap(),
        encoding: Some(Encoding::Yuyv),
        seq: 7,
        capture_ns: 1 << 40,
        offset_ns: -(1 << 41),
        uncertainty_ns: 250_000,
        flags: FLAG_ERROR,
        width: 4,
        height: 2,
    }
}

#[test]
fn the_format_is_as_documented() {
    let bytes = sample(b"abc").bytes();
    assert_eq!(bytes[..16], *b"rrm1\x02\0\0\0\x03\0\0\0\x02\0\0\0");
    assert_eq!(bytes[16..24], 7_u64.to_le_bytes());
    assert_eq!(bytes[32..40], (-(1_i64 << 41)).to_le_bytes());
    assert_eq!(bytes[48..], *b"\x01\0\0\0\x04\0\0\0\x02\0\0\0\0\0\0\0");
}

#[test]
fn a_request_is_read_as_written() {
    let line = request("robot-b", "cam_wrist");
    assert_eq!(line, "rapid-remote-1 robot-b cam_wrist\n");
    assert_eq!(requested(line.trim_end().as_bytes()), Some(("robot-b", "cam_wrist")));
    let longest = "x".repeat(LONGEST_NAME);
    assert!(request(&longest, &longest).len() <= LONGEST_REQUEST);
    for wrong in
        ["", "GET / HTTP/1.1", "rapid-remote-1 a", "rapid-remote-1 a b c", "rapid-remote-1 ** b", "rapid-remote-2 a b"]
    {
        assert_eq!(requested(wrong.as_bytes()), None, "{wrong:?}");
    }
    assert_eq!(requested(b"rapid-remote-1 a \xff"), None);
    assert!(!is_name(&"x".repeat(LONGEST_NAME + 1)));
}

#[test]
fn what_is_no_frame_is_refused_with_the_reason() {
    let with = |at: usize, word: u32| {
        let mut bytes = sample(b"").bytes();
        bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
        read(100, [&bytes[..]]).1
    };
    assert_eq!(with(0, 0), Some(FrameError::Foreign));
    assert_eq!(with(4, 4), Some(FrameError::Field("kind", 4)));
    assert_eq!(with(12, 7), Some(FrameError::Field("encoding", 7)));
    // A mask is not a sample of a device.
    assert_eq!(with(12, 5), Some(FrameError::Field("encoding", 5)));
    assert_eq!(with(48, 8), Some(FrameError::Field("flags", 8)));
    assert_eq!(with(8, 101), Some(FrameError::TooLong { length: 101, most: 100 }));
    assert_eq!(with(8, u32::MAX), Some(FrameError::TooLong { length: u32::MAX, most: 100 }));
    assert_eq!(with(4, 1), Some(FrameError::Field("encoding", 2)));
    let long = Head { kind: Kind::Refused, length: 401, ..Head::default() };
    assert_eq!(read(1000, [&long.bytes()[..]]).1, Some(FrameError::Field("length", 401)));
    let alive = Head { length: 1, ..Head::default() };
    assert_eq!(read(1000, [&alive.bytes()[..]]).1, Some(FrameError::Field("length", 1)));
}

#[test]
fn a_refusal_fits_whatever_the_entry_permits() {
    let reason = [b'x'; LONGEST_REASON];
    let head = Head { kind: Kind::Refused, length: 400, ..Head::default() };
    let (found, error) = read(8, [&head.bytes()[..], &reason]);
    assert_eq!((found, error), (vec![(head, reason.to_vec())], None));
}

proptest! {
    #[test]
    fn frames_do_not_depend_on_how_their_bytes_are_cut(
        payloads in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..50), 0..8),
        size in 1_usize..200,
    ) {
        let mut stream = Vec::new();
        for payload in &payloads {
            stream.extend_from_slice(&sample(payload).bytes());
            stream.extend_from_slice(payload);
            stream.extend_from_slice(&Head::default().bytes());
        }
        let (found, error) = read(50, stream.chunks(size));
        prop_assert_eq!(error, None);
        let samples: Vec<&Vec<u8>> =
            found.iter().filter(|(head, _)| head.kind == Kind::Sample).map(|(_, payload)| payload).collect();
        prop_assert_eq!(samples, payloads.iter().collect::<Vec<_>>());
        prop_assert_eq!(found.len(), 2 * payloads.len());
    }

    #[test]
    fn a_head_is_read_as_written(
        seq: u64, capture_ns: u64, offset_ns: i64, uncertainty_ns: u64, flags in 0_u32..8, size: (u32, u32),
    ) {
        let head = Head { seq, capture_ns, offset_ns, uncertainty_ns, flags, width: size.0, height: size.1, ..sample(b"") };
        prop_assert_eq!(Head::read(&head.bytes(), 0), Ok(head));
    }

    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..300), size in 1_usize..100) {
        let stream = [&MAGIC[..], &bytes].concat();
        let _ = read(64, stream.chunks(size));
        let _ = requested(&bytes);
    }
}
