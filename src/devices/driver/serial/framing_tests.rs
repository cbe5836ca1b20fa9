use proptest::prelude::*;

use super::*;

/// Messages as text, `!` for a malformed one.
fn cut(framing: Framing, limit: usize, chunks: &[&[u8]]) -> Vec<Vec<u8>> {
    let mut framer = Framer::new(framing, limit);
    let mut found = Vec::new();
    for chunk in chunks {
        let mut rest = *chunk;
        while !rest.is_empty() {
            let (taken, cut) = framer.feed(rest);
            assert!(taken > 0, "a feed takes at least one byte");
            rest = &rest[taken..];
            match cut {
                Cut::Open => {}
                Cut::Message => found.push(framer.message().to_vec()),
                Cut::Malformed => found.push(b"!".to_vec()),
            }
            assert!(framer.message.len() <= framer.limit);
        }
    }
    found
}

/// Encodes consistent overhead byte stuffing as its paper describes it.
fn stuff(message: &[u8]) -> Vec<u8> {
    let mut stuffed = Vec::new();
    for block in message.split(|&byte| byte == 0) {
        let mut rest = block;
        while rest.len() >= 254 {
            stuffed.push(255);
            stuffed.extend_from_slice(&rest[..254]);
            rest = &rest[254..];
        }
        stuffed.push(u8::try_from(rest.len() + 1).unwrap());
        stuffed.extend_from_slice(rest);
    }
    stuffed.push(0);
    stuffed
}

#[test]
fn lines_end_in_newlines_with_or_without_carriage_return() {
    let found = cut(Framing::Line, 16, &[b"tail\n1,2\r\n\n3,4\n5"]);
    assert_eq!(found, [b"1,2".to_vec(), b"3,4".to_vec()]);
}

#[test]
fn an_overlong_line_is_one_malformed_message_and_the_next_is_whole() {
    let found = cut(Framing::Line, 4, &[b"\n", &[b'x'; 1000], b"y\nab\n"]);
    assert_eq!(found, [b"!".to_vec(), b"ab".to_vec()]);
    assert_eq!(cut(Framing::Line, 4, &[b"\nabcd\r\nabcdef\n"]), [b"abcd".to_vec(), b"!".to_vec()]);
}

#[test]
fn cobs_examples_by_hand() {
    for (stuffed, plain) in [
        (&[0x01, 0x01, 0x00][..], &[0x00][..]),
        (&[0x03, 0x11, 0x22, 0x02, 0x33, 0x00], &[0x11, 0x22, 0x00, 0x33]),
        (&[0x02, 0x11, 0x01, 0x01, 0x01, 0x00], &[0x11, 0x00, 0x00, 0x00]),
    ] {
        assert_eq!(cut(Framing::Cobs, 300, &[&[0], stuffed]), [plain.to_vec()]);
        assert_eq!(stuff(plain), stuffed);
    }
    assert_eq!(cut(Framing::Cobs, 300, &[&[0, 9, 1, 2, 0, 2, 7, 0]]), [b"!".to_vec(), vec![7]], "code beyond the end");
}

#[test]
fn fixed_messages_need_no_boundary() {
    assert_eq!(cut(Framing::Fixed(3), 3, &[b"ab", b"cdefg"]), [b"abc".to_vec(), b"def".to_vec()]);
}

proptest! {
    #[test]
    fn chunking_does_not_matter(
        bytes in prop::collection::vec(prop_oneof![Just(b'\n'), Just(0), Just(b'\r'), any::<u8>()], 0..400),
        cuts in prop::collection::vec(0_usize..400, 0..20),
        framing in prop_oneof![Just(Framing::Line), Just(Framing::Cobs), (1_usize..9).prop_map(Framing::Fixed)],
    ) {
        let mut cuts: Vec<usize> = cuts.into_iter().map(|at| at.min(bytes.len())).collect();
        cuts.extend([0, bytes.len()]);
        cuts.sort_unstable();
        let chunks: Vec<&[u8]> = cuts.windows(2).map(|pair| &bytes[pair[0]..pair[1]]).collect();
        prop_assert_eq!(cut(framing, 12, &chunks), cut(framing, 12, &[&bytes]));
    }

    #[test]
    fn stuffed_bytes_round_trip(message in prop::collection::vec(prop_oneof![Just(0_u8), any::<u8>()], 1..700)) {
        prop_assert_eq!(cut(Framing::Cobs, 700, &[&[0], &stuff(&message)]), [message]);
    }
}
