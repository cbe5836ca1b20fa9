use proptest::prelude::*;

use super::*;

fn decode(pieces: &[&[u8]]) -> Vec<Message> {
    let mut decoder = Decoder::default();
    let mut messages = Vec::new();
    for mut piece in pieces.iter().copied() {
        while !piece.is_empty() {
            let (taken, message) = decoder.feed(piece);
            piece = &piece[taken..];
            messages.extend(message);
        }
    }
    messages
}

fn frame(id: u32, data: &[u8]) -> CanFrame {
    let mut frame = CanFrame { id, len: u8::try_from(data.len()).unwrap(), ..CanFrame::default() };
    frame.data[..data.len()].copy_from_slice(data);
    frame
}

/// What the adapter would send.
fn received(frame: &CanFrame) -> Vec<u8> {
    let format = frame.len | u8::from(frame.extended) << 6 | u8::from(frame.remote) << 7;
    let mut bytes = vec![HEAD, 0x11, format];
    bytes.extend(frame.id.to_le_bytes());
    bytes.extend(frame.data);
    bytes.push(TAIL);
    bytes
}

fn hex(text: &str) -> Vec<u8> {
    text.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

/// As the public host library of the adapter writes them, for a motor with identifier 5.
#[test]
fn sent_bytes_match_the_host_library() {
    let head = "55 aa 1e 03 01 00 00 00 0a 00 00 00 00";
    for (id, id_bytes, data) in [
        (5, "05 00 00 00", "7f ff 7f f0 00 00 07 ff"),
        (5, "05 00 00 00", "ff ff ff ff ff ff ff fc"),
        (0x7ff, "ff 07 00 00", "05 00 55 0a 01 00 00 00"),
        (0x7ff, "ff 07 00 00", "05 00 cc 00 00 00 00 00"),
    ] {
        let sent = encode(&frame(id, &hex(data))).unwrap();
        assert_eq!(sent.to_vec(), hex(&format!("{head} {id_bytes} 00 08 00 00 {data} 00")));
    }
    assert_eq!(encode(&CanFrame { error: true, ..CanFrame::default() }), None);
}

#[test]
fn each_kind_of_message_is_decoded() {
    let bytes = hex("aa 11 08 15 00 00 00 15 7f ff 7f f7 ff 1c 1a 55");
    let found = decode(&[&bytes]);
    let data = hex("15 7f ff 7f f7 ff 1c 1a");
    assert_eq!(found, [Message { kind: Kind::Received, frame: frame(0x15, &data) }]);
    for kind in Kind::ALL {
        let mut bytes = bytes.clone();
        bytes[1] = kind as u8;
        assert_eq!(decode(&[&bytes]).iter().map(|message| message.kind).collect::<Vec<_>>(), [kind]);
    }
    // Neither of these is a message: kind, length, identifier.
    for (at, byte) in [(1, 0x21), (2, 0x09), (4, 0x08), (6, 0x01), (15, 0x54), (0, 0xab)] {
        let mut bytes = bytes.clone();
        bytes[at] = byte;
        assert_eq!(decode(&[&bytes]), [], "byte {at}");
    }
}

#[test]
fn a_message_with_a_missing_byte_loses_only_itself() {
    let whole = received(&frame(0x15, &[1, 2, 3, 4, 5, 6, 7, 8]));
    for missing in 0..RECEIVED {
        let mut bytes = whole.clone();
        bytes.remove(missing);
        bytes.extend(&whole);
        bytes.extend(&whole);
        assert_eq!(decode(&[&bytes]).len(), 2, "without byte {missing}");
    }
}

fn any_frame() -> impl Strategy<Value = CanFrame> {
    (any::<u32>(), any::<bool>(), any::<bool>(), prop::collection::vec(any::<u8>(), 0..=8)).prop_map(
        |(id, extended, remote, bytes)| {
            let data: &[u8] = if remote { &[] } else { &bytes };
            let len = u8::try_from(bytes.len()).unwrap();
            let id = id & if extended { 0x1fff_ffff } else { 0x7ff };
            CanFrame { extended, remote, len, ..frame(id, data) }
        },
    )
}

proptest! {
    #[test]
    fn frames_round_trip(frame in any_frame()) {
        let found = decode(&[&received(&frame)]);
        prop_assert_eq!(found, [Message { kind: Kind::Received, frame }]);
    }

    #[test]
    fn any_split_of_any_bytes_decodes_equally(
        bytes in prop::collection::vec(
            prop_oneof![Just(HEAD), Just(TAIL), Just(0x11), Just(0), Just(8), any::<u8>()], 0..200),
        cut in 0_usize..200,
    ) {
        let (first, second) = bytes.split_at(cut.min(bytes.len()));
        prop_assert_eq!(decode(&[first, second]), decode(&[&bytes]));
        prop_assert_eq!(decode(&bytes.chunks(1).collect::<Vec<_>>()), decode(&[&bytes]));
    }

    /// Garbage with a head in it may look like the beginning of a message that ends within the next one.
    #[test]
    fn garbage_without_a_head_loses_no_message(
        parts in prop::collection::vec(
            (prop::collection::vec(any::<u8>().prop_map(|byte| if byte == HEAD { 0 } else { byte }), 0..40), any_frame()),
            1..8),
    ) {
        let bytes: Vec<u8> = parts.iter().flat_map(|(garbage, frame)| [garbage.clone(), received(frame)].concat()).collect();
        let frames: Vec<CanFrame> = decode(&[&bytes]).iter().map(|message| message.frame).collect();
        prop_assert_eq!(frames, parts.iter().map(|(_, frame)| *frame).collect::<Vec<_>>());
    }

    /// Of garbage of any kind, as much is overlapped as a message is long.
    #[test]
    fn garbage_loses_at_most_the_messages_it_overlaps(
        garbage in prop::collection::vec(any::<u8>(), 0..60),
        count in 2_usize..6,
    ) {
        // Data that holds no head, so that only the garbage can mislead.
        let frame = frame(0x15, &[1, 2, 3, 4, 5, 6, 7, 8]);
        let bytes = [garbage, received(&frame).repeat(count)].concat();
        let found = decode(&[&bytes]).iter().filter(|message| message.frame == frame).count();
        prop_assert!(found >= count - 1, "{found} of {count}");
    }
}
