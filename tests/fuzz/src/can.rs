//! CAN adapters on a serial line: their output depends on the bytes alone, not on how they were cut into reads.

use rapid_devices::driver::can::{damiao_serial, slcan};
use rapid_motors::control::can::CanFrame;

use crate::targets::short;

/// A CAN adapter that uses slcan: a frame that is sent again comes back as it was.
pub fn slcan(bytes: &[u8]) {
    use slcan::{Decoder, Event, encode};
    let Some((cut, stream)) = short(bytes).and_then(<[u8]>::split_first) else { return };
    let decode = |pieces: &mut dyn Iterator<Item = &[u8]>| {
        let mut decoder = Decoder::default();
        taken_from(pieces, |piece| decoder.feed(piece))
    };
    let whole = decode(&mut std::iter::once(stream));
    assert_eq!(whole, decode(&mut cut_up(stream, *cut)), "how the bytes were cut");
    for event in &whole {
        let Event::Frame(frame, _) = event else { continue };
        legal_frame(frame);
        assert_eq!(decode(&mut std::iter::once(encode(frame).bytes())), [Event::Frame(*frame, None)]);
    }
}

/// Damiao's CAN adapter: every byte of it is of a message or was passed over.
pub fn damiao_serial(bytes: &[u8]) {
    use damiao_serial::{Decoder, Kind, RECEIVED, encode};
    let Some((cut, stream)) = short(bytes).and_then(<[u8]>::split_first) else { return };
    let decode = |pieces: &mut dyn Iterator<Item = &[u8]>| {
        let mut decoder = Decoder::default();
        let messages = taken_from(pieces, |piece| decoder.feed(piece));
        (messages, decoder.skipped())
    };
    let whole = decode(&mut std::iter::once(stream));
    assert_eq!(whole, decode(&mut cut_up(stream, *cut)), "how the bytes were cut");
    let used = whole.0.len() * RECEIVED + usize::try_from(whole.1).expect("a count of bytes");
    assert!((stream.len().saturating_sub(RECEIVED)..=stream.len()).contains(&used), "{used} of {}", stream.len());
    for message in whole.0.iter().filter(|message| message.kind == Kind::Received) {
        legal_frame(&message.frame);
        assert!(encode(&message.frame).is_some());
    }
}

/// A stream in pieces of one to seven bytes.
fn cut_up(stream: &[u8], cut: u8) -> impl Iterator<Item = &[u8]> {
    stream.chunks(usize::from(cut) % 7 + 1)
}

/// What a decoder makes of these pieces. `feed` returns how many bytes it took, and what they gave.
fn taken_from<T>(pieces: &mut dyn Iterator<Item = &[u8]>, mut feed: impl FnMut(&[u8]) -> (usize, Option<T>)) -> Vec<T> {
    let mut all = Vec::new();
    for mut piece in pieces {
        while !piece.is_empty() {
            let (taken, one) = feed(piece);
            piece = &piece[taken..];
            all.extend(one);
        }
    }
    all
}

fn legal_frame(frame: &CanFrame) {
    assert!(frame.len <= 8 && frame.id <= if frame.extended { 0x1fff_ffff } else { 0x7ff }, "{frame:?}");
    assert!(!frame.error && frame.data[usize::from(frame.len)..].iter().all(|byte| *byte == 0), "{frame:?}");
}
