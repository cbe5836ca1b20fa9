//! slcan: CAN frames as lines of text, as adapters on serial lines use them.
//!
//! Source: Lawicel, "CANUSB User manual" 1.5, section "ASCII commands": `S0`-`S8` bit rate, `O` open, `C` close,
//! `Z0`/`Z1` time stamps, `t`/`T`/`r`/`R` frames; each line ends with CR. The adapter answers CR for done, BEL for
//! refused, `z` or `Z` and CR for a frame that was taken.
//!
//! A frame begins with a letter that is not a hexadecimal digit. Such a letter always begins a new line, so that
//! garbage before it loses no other frame.
//!
//! Invariant: no bytes make the decoder panic, and it holds at most [`LONGEST`] of them.

use rapid_motors::control::can::CanFrame;
use rapid_registry::SLCAN_BITRATES;

/// The longest line: `T`, 8 digits of identifier, the length, 16 digits of data, 4 of a time stamp, and CR.
pub const LONGEST: usize = 31;

const CR: u8 = b'\r';
const BEL: u8 = 0x07;

/// Commands of the host to the adapter besides frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Leave the bus.
    Close,
    /// Bit rate by its digit, an index into [`SLCAN_BITRATES`].
    Bitrate(u8),
    /// Join the bus.
    Open,
}

impl Command {
    /// The command that sets `bitrate`; `None` if slcan has no name for it.
    pub fn bitrate(bitrate: u32) -> Option<Self> {
        let digit = SLCAN_BITRATES.iter().position(|known| *known == bitrate)?;
        u8::try_from(digit).ok().map(Self::Bitrate)
    }

    /// The command as a line.
    pub const fn encode(self) -> Text {
        let mut text = Text::new();
        match self {
            Self::Close => text.push(b'C'),
            Self::Bitrate(digit) => {
                text.push(b'S');
                text.push(b'0' + digit % 10);
            }
            Self::Open => text.push(b'O'),
        }
        text.push(CR);
        text
    }
}

/// A line to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Text {
    bytes: [u8; LONGEST],
    len: usize,
}

impl Text {
    const fn new() -> Self {
        Self { bytes: [0; LONGEST], len: 0 }
    }

    const fn push(&mut self, byte: u8) {
        if self.len < LONGEST {
            self.bytes[self.len] = byte;
            self.len += 1;
        }
    }

    fn hex(&mut self, value: u32, digits: u32) {
        for digit in (0..digits).rev() {
            let nibble = value >> (4 * digit) & 0xf;
            self.push(char::from_digit(nibble, 16).map_or(b'0', |digit| digit.to_ascii_uppercase() as u8));
        }
    }

    /// Its bytes, CR included.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..self.len).unwrap_or(&self.bytes)
    }
}

/// `frame` as a line; empty for an error frame.
pub fn encode(frame: &CanFrame) -> Text {
    let mut text = Text::new();
    if frame.error {
        return text;
    }
    let (letter, digits) = if frame.extended { (b'T', 8) } else { (b't', 3) };
    // `r` and `R` are the letters of remote frames.
    text.push(if frame.remote { letter - 2 } else { letter });
    text.hex(frame.id & if frame.extended { 0x1fff_ffff } else { 0x7ff }, digits);
    text.hex(u32::from(frame.len.min(8)), 1);
    if !frame.remote {
        for byte in frame.data() {
            text.hex(u32::from(*byte), 2);
        }
    }
    text.push(CR);
    text
}

/// What an adapter sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A frame, and its time stamp in ms, `0..=59999`, where the adapter gives one.
    Frame(CanFrame, Option<u16>),
    /// A command or frame was taken.
    Done,
    /// A command or frame was refused.
    Refused,
}

/// Decodes frames from bytes that arrive in pieces.
#[derive(Debug, Clone)]
pub struct Decoder {
    line: [u8; LONGEST],
    len: usize,
    /// The line is too long for a frame: nothing more of it is kept.
    overlong: bool,
}

impl Default for Decoder {
    fn default() -> Self {
        Self { line: [0; LONGEST], len: 0, overlong: false }
    }
}

impl Decoder {
    /// Consumes bytes up to the end of at most one event; returns how many.
    pub fn feed(&mut self, bytes: &[u8]) -> (usize, Option<Event>) {
        for (at, byte) in bytes.iter().enumerate() {
            if let Some(event) = self.push(*byte) {
                return (at + 1, Some(event));
            }
        }
        (bytes.len(), None)
    }

    fn push(&mut self, byte: u8) -> Option<Event> {
        match byte {
            CR => {
                let event = self.event();
                self.clear();
                event
            }
            BEL => {
                self.clear();
                Some(Event::Refused)
            }
            b't' | b'T' | b'r' | b'R' => {
                self.clear();
                self.keep(byte);
                None
            }
            _ => {
                self.keep(byte);
                None
            }
        }
    }

    fn clear(&mut self) {
        self.len = 0;
        self.overlong = false;
    }

    fn keep(&mut self, byte: u8) {
        match self.line.get_mut(self.len) {
            Some(place) => {
                *place = byte;
                self.len += 1;
            }
            None => self.overlong = true,
        }
    }

    /// The meaning of the complete line.
    fn event(&self) -> Option<Event> {
        if self.overlong {
            return None;
        }
        match self.line.get(..self.len)? {
            [] | b"z" | b"Z" => Some(Event::Done),
            [letter, rest @ ..] => parse(*letter, rest),
        }
    }
}

fn parse(letter: u8, rest: &[u8]) -> Option<Event> {
    let (digits, extended, remote) = match letter {
        b't' => (3, false, false),
        b'T' => (8, true, false),
        b'r' => (3, false, true),
        b'R' => (8, true, true),
        _ => return None,
    };
    let (id, rest) = rest.split_at_checked(digits)?;
    let (length, rest) = rest.split_first()?;
    let id = number(id).filter(|id| *id <= if extended { 0x1fff_ffff } else { 0x7ff })?;
    let len = number(&[*length]).and_then(|len| u8::try_from(len).ok()).filter(|len| *len <= 8)?;
    let (digits, stamp) = rest.split_at_checked(if remote { 0 } else { 2 * usize::from(len) })?;
    let mut data = [0; 8];
    for (byte, digits) in data.iter_mut().zip(digits.chunks_exact(2)) {
        *byte = u8::try_from(number(digits)?).ok()?;
    }
    let stamp = match stamp.len() {
        0 => None,
        4 => Some(u16::try_from(number(stamp)?).ok()?),
        _ => return None,
    };
    Some(Event::Frame(CanFrame { id, extended, remote, error: false, len, data }, stamp))
}

/// At most 8 hexadecimal digits.
fn number(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |value: u32, digit| Some(value << 4 | char::from(*digit).to_digit(16)?))
}

#[cfg(test)]
mod tests;
