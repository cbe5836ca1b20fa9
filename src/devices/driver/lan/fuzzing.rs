//! The parsers of foreign bytes, for the fuzzer.

use super::iphone::packet::{self, Packets};
use super::multipart::{self, Multipart, boundary};
use super::{gopro, jpeg};

/// Bodies of a multipart stream that arrives in these pieces, and the number of discarded parts.
pub fn multipart<'p>(
    content_type: &str,
    largest: usize,
    pieces: impl IntoIterator<Item = &'p [u8]>,
) -> (Vec<Vec<u8>>, u64) {
    let (mut parts, mut malformed) = (Vec::new(), 0);
    let Some(mut parser) = boundary(content_type).and_then(|boundary| Multipart::new(boundary, largest)) else {
        return (parts, malformed);
    };
    for mut piece in pieces {
        while !piece.is_empty() {
            let (taken, cut) = parser.feed(piece);
            piece = piece.get(taken..).unwrap_or_default();
            match cut {
                multipart::Cut::Open | multipart::Cut::Head => {}
                multipart::Cut::Part => parts.push(parser.part().to_vec()),
                multipart::Cut::Malformed => malformed += 1,
                multipart::Cut::End => return (parts, malformed),
            }
        }
    }
    (parts, malformed)
}

/// Messages of a phone.
#[derive(Debug, PartialEq)]
pub enum Sent {
    /// A picture.
    Picture(Vec<u8>),
    /// A session, in JSON.
    Session(Vec<u8>),
}

/// The phone's messages in these pieces, and the number of discarded ones.
pub fn phone<'p>(largest: usize, pieces: impl IntoIterator<Item = &'p [u8]>) -> (Vec<Sent>, u64) {
    let mut packets = Packets::new(largest);
    let (mut sent, mut malformed) = (Vec::new(), 0);
    for mut piece in pieces {
        while !piece.is_empty() {
            let (taken, cut) = packets.feed(piece);
            piece = piece.get(taken..).unwrap_or_default();
            match cut {
                packet::Cut::Open => {}
                packet::Cut::Frame(_) => sent.push(Sent::Picture(packets.payload().to_vec())),
                packet::Cut::Session => sent.push(Sent::Session(packets.payload().to_vec())),
                packet::Cut::Malformed => malformed += 1,
            }
        }
    }
    (sent, malformed)
}

/// Parses a GoPro's answers and a picture's header.
pub fn answer(bytes: &[u8]) {
    gopro::fuzz(bytes);
    let _ = jpeg::size(bytes);
}
