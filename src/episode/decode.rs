//! The content of recorded messages, which are protobuf: the inverse of [`encode`](super::encode).
//!
//! Every message is read once, by hand, only the fields in use; messages of other programs with the same schemas are
//! read too.
//!
//! Invariant: any bytes are accepted; a message that is not whole, or not of its schema, is `None`, never a panic.
//! Invariant: memory does not grow with what a message claims.

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::{MAX_MODALITIES, ModalityId};
use rapid_core::sample::Encoding;

use super::encode::EventText;
use super::schema::SampleSchema;
use super::wire::{Proto, whole_protobuf};

/// What the messages of a channel hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A message with a sample.
    Sample(SampleSchema),
    /// `rapid.Mask`.
    Mask,
    /// `rapid.Frame`.
    Frame,
    /// `rapid.Event`.
    Event,
    /// Not read by this program.
    Other,
}

/// The content of a message.
#[derive(Debug, Clone, Copy)]
pub enum Content<'a> {
    /// A sample.
    Sample(Sample<'a>),
    /// A publication of the mask.
    Mask(PhysicalMask),
    /// A tick of the frame index: one entry for each modality.
    Frame(&'a [FrameSlot]),
    /// Something that happened.
    Event(EventText<'a>),
    /// A whole message of a channel of [`Kind::Other`].
    Other,
}

/// A sample, as sent by its device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample<'a> {
    /// How `payload` is encoded.
    pub encoding: Encoding,
    /// Pixels of a picture, or the count of numbers; 0 if unknown.
    pub width: u32,
    /// Pixels of a picture, else 0.
    pub height: u32,
    /// As the device sent it.
    pub payload: &'a [u8],
}

/// One modality in a tick of the frame index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(clippy::struct_excessive_bools, reason = "they are the message's")]
pub struct FrameSlot {
    /// Which modality.
    pub id: ModalityId,
    /// Its bit in the mask.
    pub present: bool,
    /// Its device is plugged in, whether it runs or not: set wherever `present` is, also in files of versions that did not
    /// record it.
    pub plugged: bool,
    /// A sample lies within the window.
    pub valid: bool,
    /// Present without such a sample.
    pub stale: bool,
    /// Age of the sample at the tick, ns; negative if it was captured after it.
    pub age_ns: i64,
    /// Number of the sample that belongs to the tick, if one does; its message has the lower 32 bits.
    pub seq: Option<u64>,
}

/// Memory for content that must be converted; reused for every message.
#[derive(Debug, Default)]
pub struct Scratch {
    payload: Vec<u8>,
    slots: Vec<FrameSlot>,
}

/// Reads a message of a channel of `kind`.
pub fn content<'a>(kind: Kind, message: &'a [u8], scratch: &'a mut Scratch) -> Option<Content<'a>> {
    Some(match kind {
        Kind::Sample(schema) => Content::Sample(sample(schema, message, &mut scratch.payload)?),
        Kind::Mask => Content::Mask(mask(message)?),
        Kind::Frame => Content::Frame(frame(message, &mut scratch.slots)?),
        Kind::Event => Content::Event(event(message)?),
        Kind::Other => whole_protobuf(message).all(|field| field.is_some()).then_some(Content::Other)?,
    })
}

/// The payload of one message of the schema named so, with its width and height.
#[doc(hidden)]
pub fn decode(schema: &str, message: &[u8]) -> Option<(Vec<u8>, u32, u32)> {
    let mut scratch = Vec::new();
    let sample = sample(SampleSchema::named(schema)?, message, &mut scratch)?;
    Some((sample.payload.to_owned(), sample.width, sample.height))
}

fn sample<'a>(schema: SampleSchema, message: &'a [u8], scratch: &'a mut Vec<u8>) -> Option<Sample<'a>> {
    match schema {
        SampleSchema::CompressedImage => compressed(message),
        SampleSchema::RawImage => raw(message, scratch),
        SampleSchema::Scalars => scalars(message, scratch),
        SampleSchema::Bytes => {
            Some(Sample { encoding: Encoding::Bytes, width: 0, height: 0, payload: last_bytes(message, 2)? })
        }
    }
}

fn mask(message: &[u8]) -> Option<PhysicalMask> {
    let mut mask = 0;
    for field in whole_protobuf(message) {
        if let (2, Proto::Fixed64(bits)) = field? {
            mask = bits;
        }
    }
    Some(PhysicalMask(mask))
}

fn frame<'a>(message: &[u8], slots: &'a mut Vec<FrameSlot>) -> Option<&'a [FrameSlot]> {
    slots.clear();
    for field in whole_protobuf(message) {
        let (4, slot) = field? else { continue };
        if slots.len() == MAX_MODALITIES {
            return None;
        }
        slots.push(frame_slot(slot.bytes())?);
    }
    Some(slots)
}

fn frame_slot(message: &[u8]) -> Option<FrameSlot> {
    let (mut bit, mut present, mut plugged, mut valid, mut stale) = (0, false, false, false, false);
    let (mut age_ns, mut seq) = (0, None);
    for field in whole_protobuf(message) {
        match field? {
            (1, value) => bit = value.number(),
            (2, value) => valid = value.number() != 0,
            (3, value) => stale = value.number() != 0,
            (4, value) => age_ns = value.zigzag(),
            (5, value) => seq = Some(value.number()),
            (6, value) => present = value.number() != 0,
            (7, value) => plugged = value.number() != 0,
            _ => {}
        }
    }
    let id = ModalityId::new(u8::try_from(bit).ok()?)?;
    Some(FrameSlot { id, present, plugged: plugged || present, valid, stale, age_ns, seq })
}

fn event(message: &[u8]) -> Option<EventText<'_>> {
    let mut event = EventText::default();
    for field in whole_protobuf(message) {
        let (number, value) = field?;
        let place = match number {
            2 => &mut event.kind,
            3 => &mut event.device,
            4 => &mut event.text,
            5 => &mut event.json,
            _ => continue,
        };
        *place = str::from_utf8(value.bytes()).ok()?;
    }
    Some(event)
}

fn compressed(message: &[u8]) -> Option<Sample<'_>> {
    if last_bytes(message, 3)? != b"jpeg" {
        return None;
    }
    let payload = last_bytes(message, 2)?;
    // A picture without a readable header is played as it was recorded.
    let (width, height, _) = jpeg_frame(payload).unwrap_or_default();
    Some(Sample { encoding: Encoding::Mjpeg, width, height, payload })
}

fn raw<'a>(message: &'a [u8], scratch: &'a mut Vec<u8>) -> Option<Sample<'a>> {
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
        b"16UC1" | b"mono16" => (Encoding::Depth, (width as usize).checked_mul(2)?),
        _ => return None,
    };
    let payload = if step as usize > row { without_padding(data, step as usize, row, height, scratch) } else { data };
    Some(Sample { encoding, width, height, payload })
}

/// The first `row` bytes of each line of `step` bytes.
fn without_padding<'a>(data: &[u8], step: usize, row: usize, height: u32, into: &'a mut Vec<u8>) -> &'a [u8] {
    into.clear();
    for line in data.chunks(step).take(height as usize) {
        into.extend_from_slice(line.get(..row).unwrap_or(line));
    }
    into
}

/// The doubles of a message: little endian and packed, as the driver sent them. Only those in several pieces are
/// copied.
fn scalars<'a>(message: &'a [u8], into: &'a mut Vec<u8>) -> Option<Sample<'a>> {
    into.clear();
    let mut last: &[u8] = &[];
    for field in whole_protobuf(message) {
        match field? {
            (2, Proto::Bytes(packed)) if packed.len() % 8 == 0 => {
                into.extend_from_slice(std::mem::replace(&mut last, packed));
            }
            (2, Proto::Fixed64(one)) => {
                into.extend_from_slice(std::mem::take(&mut last));
                into.extend_from_slice(&one.to_le_bytes());
            }
            (2, _) => return None,
            _ => {}
        }
    }
    let payload = if into.is_empty() {
        last
    } else {
        into.extend_from_slice(last);
        into
    };
    Some(Sample { encoding: Encoding::F64, width: u32::try_from(payload.len() / 8).ok()?, height: 0, payload })
}

/// The bytes of field `wanted`; the last one counts, a missing one is empty.
fn last_bytes(message: &[u8], requested: u64) -> Option<&[u8]> {
    let mut found = &[][..];
    for field in whole_protobuf(message) {
        if let (number, Proto::Bytes(bytes)) = field?
            && number == requested
        {
            found = bytes;
        }
    }
    Some(found)
}

/// Width, height and the number of components in a JPEG's frame header (ITU-T T.81, B.2.2): any SOF marker except DHT,
/// JPG, DAC.
pub fn jpeg_frame(bytes: &[u8]) -> Option<(u32, u32, u8)> {
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
            let components = segment.get(5).copied().unwrap_or(0);
            return Some((u16::from_be_bytes([w1, w0]).into(), u16::from_be_bytes([h1, h0]).into(), components));
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
