//! The stream of a sensor on another computer: its request, its frames and their reader, the only ones of this format.
//!
//! `rapid-remote` on this computer offers every sensor of the other computers on one port of 127.0.0.1 ([`PORT`]). A
//! reader sends a line, [`request`]. The answer is a sequence of frames: a [`Head`] of [`HEAD`] bytes, all numbers
//! little endian, then `length` bytes.
//!
//! | bytes  | field            |                                                                                     |
//! |--------|------------------|-------------------------------------------------------------------------------------|
//! | 0..4   |                  | `rrm1`                                                                              |
//! | 4..8   | `kind`           | 1 alive, 2 sample, 3 refused: the payload is the reason, and the last               |
//! | 8..12  | `length`         | of the payload                                                                      |
//! | 12..16 | `encoding`       | an [`Encoding`]                                                                     |
//! | 16..24 | `seq`            | of [`crate::sample::SampleHeader`] there: a gap is a sample that did not arrive     |
//! | 24..32 | `capture_ns`     | on `CLOCK_MONOTONIC` of the computer that receives the frame                        |
//! | 32..40 | `offset_ns`      | the clock there minus the clock here                                                |
//! | 40..48 | `uncertainty_ns` | how far `offset_ns` and so `capture_ns` may be wrong, either way                    |
//! | 48..52 | `flags`          | `FLAG_*` of [`crate::sample`]                                                       |
//! | 52..56 | `width`          | pixels                                                                              |
//! | 56..60 | `height`         | pixels                                                                              |
//! | 60..64 |                  | 0                                                                                   |
//!
//! On the way between two computers a sample has the same form, with the sender's capture time, and zero for the clocks.
//!
//! Invariant: no bytes make the reader panic, or keep more than the largest permitted payload.
//! Invariant: a reader that is interrupted between two reads continues with the same frame.

use crate::sample::{Encoding, FLAG_DEVICE_TIME, FLAG_ERROR, FLAG_SAME_NUMBER};

/// Port of `rapid-remote` on this computer.
pub const PORT: u16 = 7448;
/// Bytes of a [`Head`].
pub const HEAD: usize = 64;
/// Longest name of a computer or of a device.
pub const LONGEST_NAME: usize = 64;
/// Longest reason of a refusal, bytes.
pub const LONGEST_REASON: usize = 400;
/// Longest request, with its newline.
pub const LONGEST_REQUEST: usize = 2 * LONGEST_NAME + 20;

const MAGIC: [u8; 4] = *b"rrm1";
const WORD: &str = "rapid-remote-1";

/// What a frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u32)]
pub enum Kind {
    /// The sensor is present.
    #[default]
    Alive = 1,
    /// A sample.
    Sample = 2,
    /// The sensor is absent; nothing follows.
    Refused = 3,
}

/// The head of a frame; see the module's comment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Head {
    /// What it is.
    pub kind: Kind,
    /// Bytes that follow.
    pub length: u32,
    /// How a sample is encoded.
    pub encoding: Option<Encoding>,
    /// The number of the sample there.
    pub seq: u64,
    /// When it was captured, on the clock of the receiver, ns.
    pub capture_ns: u64,
    /// The clock there minus the clock here, ns.
    pub offset_ns: i64,
    /// Half the width of what `offset_ns` may be, ns.
    pub uncertainty_ns: u64,
    /// `FLAG_*`.
    pub flags: u32,
    /// Of a picture, pixels.
    pub width: u32,
    /// Of a picture, pixels.
    pub height: u32,
}

/// Why bytes are not a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// They do not begin as a frame does.
    #[error("what came is not a frame of rapid-remote, or of another version of it")]
    Foreign,
    /// A field has a value that it cannot have.
    #[error("a frame has the {0} {1}")]
    Field(&'static str, u64),
    /// The sample is larger than permitted.
    #[error("a sample has {length} bytes, more than the {most} of max_bytes")]
    TooLong {
        /// Its bytes.
        length: u32,
        /// The permitted ones.
        most: usize,
    },
}

/// The request for a device of the rig `host`.
pub fn request(host: &str, device: &str) -> String {
    format!("{WORD} {host} {device}\n")
}

/// Host and device of a request without its newline.
pub fn requested(line: &[u8]) -> Option<(&str, &str)> {
    let mut words = std::str::from_utf8(line).ok()?.split(' ');
    let (word, host, device) = (words.next()?, words.next()?, words.next()?);
    (word == WORD && words.next().is_none() && is_name(host) && is_name(device)).then_some((host, device))
}

/// Whether a computer or a device may have this name: it is part of a key on the network.
pub fn is_name(name: &str) -> bool {
    (1..=LONGEST_NAME).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-'))
}

impl Head {
    /// Its bytes.
    pub fn bytes(&self) -> [u8; HEAD] {
        let mut bytes = [0; HEAD];
        let words = [
            (4, self.kind as u32),
            (8, self.length),
            (12, self.encoding.map_or(0, |encoding| encoding as u32)),
            (48, self.flags),
            (52, self.width),
            (56, self.height),
        ];
        let longs =
            [(16, self.seq), (24, self.capture_ns), (32, self.offset_ns.cast_unsigned()), (40, self.uncertainty_ns)];
        put(&mut bytes, 0, &MAGIC);
        for (at, word) in words {
            put(&mut bytes, at, &word.to_le_bytes());
        }
        for (at, long) in longs {
            put(&mut bytes, at, &long.to_le_bytes());
        }
        bytes
    }

    /// The head of a frame whose payload is at most `most` bytes.
    ///
    /// # Errors
    /// When these bytes are not the head of a frame, or its payload is larger.
    pub fn read(bytes: &[u8; HEAD], most: usize) -> Result<Self, FrameError> {
        if bytes[..MAGIC.len()] != MAGIC {
            return Err(FrameError::Foreign);
        }
        let word = |at: usize| u32::from_le_bytes(array(bytes, at));
        let long = |at: usize| u64::from_le_bytes(array(bytes, at));
        let kind = match word(4) {
            1 => Kind::Alive,
            2 => Kind::Sample,
            3 => Kind::Refused,
            other => return Err(FrameError::Field("kind", other.into())),
        };
        let encoding = match (kind, word(12)) {
            (Kind::Sample, raw) => match Encoding::from_raw(raw) {
                Some(Encoding::Mask) | None => return Err(FrameError::Field("encoding", raw.into())),
                known => known,
            },
            (_, 0) => None,
            (_, raw) => return Err(FrameError::Field("encoding", raw.into())),
        };
        let (length, flags) = (word(8), word(48));
        let bytes_long = usize::try_from(length).unwrap_or(usize::MAX);
        match kind {
            Kind::Alive if length > 0 => return Err(FrameError::Field("length", length.into())),
            Kind::Refused if bytes_long > LONGEST_REASON => return Err(FrameError::Field("length", length.into())),
            Kind::Sample if bytes_long > most => return Err(FrameError::TooLong { length, most }),
            _ => {}
        }
        if flags & !(FLAG_ERROR | FLAG_DEVICE_TIME | FLAG_SAME_NUMBER) != 0 {
            return Err(FrameError::Field("flags", flags.into()));
        }
        Ok(Self {
            kind,
            length,
            encoding,
            seq: long(16),
            capture_ns: long(24),
            offset_ns: long(32).cast_signed(),
            uncertainty_ns: long(40),
            flags,
            width: word(52),
            height: word(56),
        })
    }
}

fn put(bytes: &mut [u8; HEAD], at: usize, field: &[u8]) {
    if let Some(place) = bytes.get_mut(at..at + field.len()) {
        place.copy_from_slice(field);
    }
}

fn array<const N: usize>(bytes: &[u8; HEAD], at: usize) -> [u8; N] {
    bytes.get(at..).and_then(|rest| rest.first_chunk()).copied().unwrap_or([0; N])
}

/// Reads frames, of which it keeps one: bytes go into [`Self::room`], and [`Self::filled`] takes them.
#[derive(Debug)]
pub struct Frames {
    buffer: Box<[u8]>,
    most: usize,
    have: usize,
    need: usize,
    head: Option<Head>,
}

impl Frames {
    /// For samples of at most `most` bytes.
    pub fn new(most: usize) -> Self {
        let buffer = vec![0; HEAD + most.max(LONGEST_REASON)].into_boxed_slice();
        Self { buffer, most, have: 0, need: HEAD, head: None }
    }

    /// Where the next bytes of the frame go; never empty.
    pub fn room(&mut self) -> &mut [u8] {
        if self.have >= self.need {
            (self.have, self.need, self.head) = (0, HEAD, None);
        }
        self.buffer.get_mut(self.have..self.need).unwrap_or_default()
    }

    /// So many bytes were put into the room. Returns the head of a frame that is complete.
    ///
    /// # Errors
    /// When they are not a frame. What comes next cannot be one either.
    pub fn filled(&mut self, count: usize) -> Result<Option<Head>, FrameError> {
        self.have = self.have.saturating_add(count).min(self.need);
        if self.head.is_none()
            && let Some(bytes) = self.buffer.first_chunk().filter(|_| self.have == HEAD)
        {
            let head = Head::read(bytes, self.most)?;
            self.need = HEAD + usize::try_from(head.length).unwrap_or(0);
            self.head = Some(head);
        }
        Ok(self.head.filter(|_| self.have == self.need))
    }

    /// The payload of the frame that is complete.
    pub fn payload(&self) -> &[u8] {
        self.buffer.get(HEAD..self.have).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
