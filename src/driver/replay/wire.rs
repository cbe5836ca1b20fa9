//! Payloads out of recorded messages, which are protobuf.
//!
//! Reads just the fields a driver needs:
//! `foxglove.CompressedImage` { data = 2, format = 3 }, `foxglove.RawImage` { width = 2, height = 3,
//! encoding = 4, step = 5, data = 6 }, `rapid.Scalars` { values = 2 }, `rapid.Bytes` { data = 2 } and
//! `rapid.Mask` { mask = 2, sequence = 3 }.
//!
//! Invariant: any bytes may stand in a message; what cannot be read is `None`, never a panic.

use super::super::camera::compact_rows;
use crate::episode_format::wire::{Proto, whole_protobuf};
use crate::mask::PhysicalMask;
use crate::sample::Encoding;

/// What the messages of a topic are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Schema {
    CompressedImage,
    RawImage,
    Scalars,
    Bytes,
}

impl Schema {
    pub(super) fn named(name: &str) -> Option<Self> {
        Some(match name {
            "foxglove.CompressedImage" => Self::CompressedImage,
            "foxglove.RawImage" => Self::RawImage,
            "rapid.Scalars" => Self::Scalars,
            "rapid.Bytes" => Self::Bytes,
            _ => return None,
        })
    }
}

/// How the payload of a message is to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Shape {
    pub(super) encoding: Encoding,
    pub(super) width: u32,
    pub(super) height: u32,
}

/// Copies the payload of `message` into `payload` as the device once gave it.
pub(super) fn payload(schema: Schema, message: &[u8], payload: &mut Vec<u8>) -> Option<Shape> {
    payload.clear();
    match schema {
        Schema::CompressedImage => compressed(message, payload),
        Schema::RawImage => raw(message, payload),
        Schema::Scalars => scalars(message, payload),
        Schema::Bytes => {
            payload.extend_from_slice(last_bytes(message, 2)?);
            Some(Shape { encoding: Encoding::Bytes, width: 0, height: 0 })
        }
    }
}

/// The value of a `rapid.Mask`.
pub(super) fn mask(message: &[u8]) -> Option<PhysicalMask> {
    let mut mask = 0;
    for field in whole_protobuf(message) {
        if let (2, Proto::Fixed64(bits)) = field? {
            mask = bits;
        }
    }
    Some(PhysicalMask(mask))
}

fn compressed(message: &[u8], payload: &mut Vec<u8>) -> Option<Shape> {
    if last_bytes(message, 3)? != b"jpeg" {
        return None;
    }
    let data = last_bytes(message, 2)?;
    payload.extend_from_slice(data);
    // A picture without a readable header is played as it was recorded.
    let (width, height) = jpeg_size(data).unwrap_or((0, 0));
    Some(Shape { encoding: Encoding::Mjpeg, width, height })
}

fn raw(message: &[u8], payload: &mut Vec<u8>) -> Option<Shape> {
    let (mut width, mut height, mut step, mut encoding, mut data) = (0, 0, 0, &[][..], &[][..]);
    for field in whole_protobuf(message) {
        match field? {
            (2, Proto::Fixed32(number)) => width = number,
            (3, Proto::Fixed32(number)) => height = number,
            (4, Proto::Bytes(bytes)) => encoding = bytes,
            (5, Proto::Fixed32(number)) => step = number,
            (6, Proto::Bytes(bytes)) => data = bytes,
            _ => {}
        }
    }
    let (encoding, row) = match encoding {
        b"yuyv" | b"yuv422_yuy2" => (Encoding::Yuyv, (width as usize).checked_mul(2)?),
        b"mono8" | b"8UC1" => (Encoding::Grey, width as usize),
        _ => return None,
    };
    if step as usize > row {
        compact_rows(data, step as usize, row, height as usize, payload);
    } else {
        payload.extend_from_slice(data);
    }
    Some(Shape { encoding, width, height })
}

/// Doubles lie in the message as the driver once gave them: little endian, packed one after another.
fn scalars(message: &[u8], payload: &mut Vec<u8>) -> Option<Shape> {
    for field in whole_protobuf(message) {
        match field? {
            (2, Proto::Bytes(packed)) if packed.len() % 8 == 0 => payload.extend_from_slice(packed),
            (2, Proto::Fixed64(one)) => payload.extend_from_slice(&one.to_le_bytes()),
            (2, _) => return None,
            _ => {}
        }
    }
    Some(Shape { encoding: Encoding::F64, width: u32::try_from(payload.len() / 8).ok()?, height: 0 })
}

/// The bytes of field `wished`; the last one counts, a missing one is empty.
fn last_bytes(message: &[u8], wished: u64) -> Option<&[u8]> {
    let mut found = &[][..];
    for field in whole_protobuf(message) {
        if let (number, Proto::Bytes(bytes)) = field?
            && number == wished
        {
            found = bytes;
        }
    }
    Some(found)
}

/// Width and height in a JPEG's frame header (ITU-T T.81, B.2.2): any SOF marker but DHT, JPG, DAC.
fn jpeg_size(bytes: &[u8]) -> Option<(u32, u32)> {
    let mut rest = bytes.strip_prefix(&[0xff, 0xd8])?;
    loop {
        let (&[0xff, marker], after) = rest.split_first_chunk()? else { return None };
        // Fill bytes may stand before a marker.
        if marker == 0xff {
            rest = rest.get(1..)?;
            continue;
        }
        let (&length, _) = after.split_first_chunk()?;
        let segment = after.get(2..usize::from(u16::from_be_bytes(length)))?;
        if matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc) {
            let &[_, h1, h0, w1, w0] = segment.first_chunk()?;
            return Some((u16::from_be_bytes([w1, w0]).into(), u16::from_be_bytes([h1, h0]).into()));
        }
        // Start of scan: no frame header follows.
        if marker == 0xda {
            return None;
        }
        rest = after.get(2 + segment.len()..)?;
    }
}

#[cfg(test)]
mod tests;
