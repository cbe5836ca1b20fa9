use proptest::prelude::*;

use super::*;

fn decode(pieces: &[&[u8]]) -> Vec<Event> {
    let mut decoder = Decoder::default();
    let mut events = Vec::new();
    for mut piece in pieces.iter().copied() {
        while !piece.is_empty() {
            let (taken, event) = decoder.feed(piece);
            piece = &piece[taken..];
            events.extend(event);
        }
    }
    events
}

fn frame(id: u32, extended: bool, remote: bool, len: u8, data: [u8; 8]) -> CanFrame {
    CanFrame { id, extended, remote, error: false, len, data }
}

#[test]
fn frames_match_the_manual() {
    for (line, expected, stamp) in [
        (&b"t10021133\r"[..], frame(0x100, false, false, 2, [0x11, 0x33, 0, 0, 0, 0, 0, 0]), None),
        (b"T00000100411223344\r", frame(0x100, true, false, 4, [0x11, 0x22, 0x33, 0x44, 0, 0, 0, 0]), None),
        (b"r1002\r", frame(0x100, false, true, 2, [0; 8]), None),
        (b"R1FFFFFFF8\r", frame(0x1fff_ffff, true, true, 8, [0; 8]), None),
        (b"t7ff0\r", frame(0x7ff, false, false, 0, [0; 8]), None),
        (b"t0051aBea5f\r", frame(5, false, false, 1, [0xab, 0, 0, 0, 0, 0, 0, 0]), Some(0xea5f)),
        (b"R0000000521234\r", frame(5, true, true, 2, [0; 8]), Some(0x1234)),
        (
            b"T1ABCDEF980123456789ABCDEFFFFF\r",
            frame(0x1abc_def9, true, false, 8, [1, 0x23, 0x45, 0x67, 0x89, 0xab, 0xcd, 0xef]),
            Some(0xffff),
        ),
    ] {
        assert_eq!(decode(&[line]), [Event::Frame(expected, stamp)], "{}", line.escape_ascii());
    }
}

#[test]
fn invalid_lines_are_not_frames() {
    for line in [
        &b"t8000\r"[..],
        b"T200000000\r",
        b"t1009112233445566778899\r",
        b"t100\r",
        b"t10\r",
        b"t10021\r",
        b"t1002113\r",
        b"t1001xx\r",
        b"t1001112\r",
        b"t100111234\r"[..9].as_ref(),
        b"V1013\r",
        b"zz\r",
        b"T1ABCDEF980123456789ABCDEFFFFFF\r",
        b"T1ABCDEF980123456789ABCDEFFFFF0000\r",
        b"+1001\r",
    ] {
        assert_eq!(decode(&[line]), [], "{}", line.escape_ascii());
    }
    assert_eq!(decode(&[b"\r\x07z\rZ\r"]), [Event::Done, Event::Refused, Event::Done, Event::Done]);
}

#[test]
fn commands_match_the_manual() {
    let text = |command: Command| String::from_utf8(command.encode().bytes().to_vec()).unwrap();
    assert_eq!(text(Command::bitrate(1_000_000).unwrap()), "S8\r");
    assert_eq!(text(Command::bitrate(10_000).unwrap()), "S0\r");
    assert_eq!(Command::bitrate(123_456), None);
    let rest = [Command::Close, Command::Open].map(text);
    assert_eq!(rest, ["C\r", "O\r"]);
    assert_eq!(encode(&CanFrame { error: true, ..CanFrame::default() }).bytes(), b"");
}

fn any_frame() -> impl Strategy<Value = CanFrame> {
    (any::<u32>(), any::<bool>(), any::<bool>(), prop::collection::vec(any::<u8>(), 0..=8)).prop_map(
        |(id, extended, remote, bytes)| {
            let mut data = [0; 8];
            if !remote {
                data[..bytes.len()].copy_from_slice(&bytes);
            }
            let id = id & if extended { 0x1fff_ffff } else { 0x7ff };
            frame(id, extended, remote, u8::try_from(bytes.len()).unwrap(), data)
        },
    )
}

proptest! {
    #[test]
    fn frames_round_trip(frame in any_frame()) {
        prop_assert_eq!(decode(&[encode(&frame).bytes()]), [Event::Frame(frame, None)]);
    }

    #[test]
    fn any_split_of_any_bytes_decodes_equally(
        bytes in prop::collection::vec(
            prop_oneof![Just(b'\r'), Just(b't'), Just(b'R'), Just(7), b'0'..=b'9', any::<u8>()], 0..200),
        cut in 0_usize..200,
    ) {
        let (first, second) = bytes.split_at(cut.min(bytes.len()));
        prop_assert_eq!(decode(&[first, second]), decode(&[&bytes]));
        prop_assert_eq!(decode(&bytes.chunks(1).collect::<Vec<_>>()), decode(&[&bytes]));
    }

    #[test]
    fn garbage_between_frames_loses_no_frame(
        parts in prop::collection::vec((prop::collection::vec(any::<u8>(), 0..40), any_frame()), 1..8),
    ) {
        let bytes: Vec<u8> =
            parts.iter().flat_map(|(garbage, frame)| [garbage, encode(frame).bytes()].concat()).collect();
        let mut found = decode(&[&bytes]).into_iter();
        for (_, frame) in &parts {
            prop_assert!(found.any(|event| event == Event::Frame(*frame, None)), "{frame:?} was lost");
        }
    }
}
