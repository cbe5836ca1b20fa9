//! slcan, the ASCII protocol of serial CAN adapters (LAWICEL CAN232; used by the kernel's `slcan` and by `slcand`).
//!
//! Invariant: a command is answered by a carriage return, or by a bell if it is invalid or comes at the wrong time.

use super::Frame;

const OK: u8 = b'\r';
const BELL: u8 = 0x07;
/// Longer than any command: `T`, eight digits, a length, sixteen digits.
const LONGEST: usize = 32;
/// Bits a second of `S0` to `S8`.
const RATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// The adapter's side of the line.
#[derive(Debug, Default)]
pub struct Slcan {
    open: bool,
    rate: Option<u32>,
    line: Vec<u8>,
}

/// The effect of a byte from the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Received {
    /// The channel was opened at this many bits a second, or closed.
    Open(Option<u32>),
    /// A frame for the bus.
    Frame(Frame),
}

impl Slcan {
    /// Processes data from the host; answers go to `out`, effects to `received`.
    pub fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>, mut received: impl FnMut(Received)) {
        for byte in bytes {
            match byte {
                b'\r' => {
                    let line = std::mem::take(&mut self.line);
                    pass_on(self.command(&line, out), &mut received);
                }
                // Hosts send line ends of all kinds before a command, to end any previous one.
                b'\n' if self.line.is_empty() => {}
                _ if self.line.len() < LONGEST => self.line.push(*byte),
                _ => {}
            }
        }
    }

    /// Writes a frame of the bus to the host.
    pub fn send_to_host(&self, frame: &Frame, out: &mut Vec<u8>) {
        if self.open {
            encode(frame, out);
        }
    }

    fn command(&mut self, line: &[u8], out: &mut Vec<u8>) -> Option<Received> {
        let Some((word, rest)) = line.split_first() else {
            out.push(OK);
            return None;
        };
        let (answer, received): (&[u8], _) = match (word, rest, self.open) {
            (b'S', [digit @ b'0'..=b'8'], false) => {
                self.rate = Some(RATES[usize::from(digit - b'0')]);
                (&[OK], None)
            }
            (b'O', [], false) if self.rate.is_some() => {
                self.open = true;
                (&[OK], Some(Received::Open(self.rate)))
            }
            (b'C', [], _) => {
                let was_open = std::mem::take(&mut self.open);
                (&[OK], was_open.then_some(Received::Open(None)))
            }
            (b't' | b'T' | b'r' | b'R', _, true) => match decode(line) {
                Some(frame) => (if frame.extended { b"Z\r" } else { b"z\r" }, Some(Received::Frame(frame))),
                None => (&[BELL], None),
            },
            (b'V', [], _) => (b"V1013\r", None),
            (b'N', [], _) => (b"NVB01\r", None),
            (b'F', [], true) => (b"F00\r", None),
            // Time stamps are off anyway.
            (b'Z', [b'0'], false) => (&[OK], None),
            _ => (&[BELL], None),
        };
        out.extend_from_slice(answer);
        received
    }
}

fn pass_on(what: Option<Received>, received: &mut impl FnMut(Received)) {
    if let Some(what) = what {
        received(what);
    }
}

/// Appends a frame as a line.
pub fn encode(frame: &Frame, out: &mut Vec<u8>) {
    let word = match (frame.extended, frame.remote) {
        (false, false) => 't',
        (true, false) => 'T',
        (false, true) => 'r',
        (true, true) => 'R',
    };
    let digits = if frame.extended { 8 } else { 3 };
    out.extend(format!("{word}{:0digits$X}{}", frame.id, frame.len()).bytes());
    frame.bytes().iter().for_each(|byte| out.extend(format!("{byte:02X}").bytes()));
    out.push(b'\r');
}

/// Parses a line without its end.
pub fn decode(line: &[u8]) -> Option<Frame> {
    let (word, rest) = line.split_first()?;
    let (extended, remote) = match word {
        b't' => (false, false),
        b'T' => (true, false),
        b'r' => (false, true),
        b'R' => (true, true),
        _ => return None,
    };
    let (id, rest) = rest.split_at_checked(if extended { 8 } else { 3 })?;
    let (len, digits) = rest.split_first()?;
    let len = char::from(*len).to_digit(9)?;
    let (pairs, odd) = digits.as_chunks::<2>();
    if !odd.is_empty() || (remote && !pairs.is_empty()) {
        return None;
    }
    let bytes: Vec<u8> =
        pairs.iter().map(|pair| hex(pair).and_then(|byte| byte.try_into().ok())).collect::<Option<_>>()?;
    Frame::new(hex(id)?, extended, remote, len as usize, &bytes)
}

fn hex(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |value, digit| Some(value << 4 | char::from(*digit).to_digit(16)?))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::emu::can::strategies;

    fn talk(slcan: &mut Slcan, bytes: &[u8]) -> (Vec<u8>, Vec<Received>) {
        let (mut out, mut received) = (Vec::new(), Vec::new());
        slcan.receive(bytes, &mut out, |what| received.push(what));
        (out, received)
    }

    #[test]
    fn a_session() {
        let mut slcan = Slcan::default();
        let frame = Frame::new(5, false, false, 2, &[0xab, 0xcd]).unwrap();
        let mut nothing = Vec::new();
        slcan.send_to_host(&frame, &mut nothing);
        assert_eq!(nothing, b"", "a closed channel is silent");
        let cases: [(&[u8], &[u8], &[Received]); 12] = [
            (b"\r\r", b"\r\r", &[]),
            (b"O\r", b"\x07", &[]),
            (b"C\r", b"\r", &[]),
            (b"S6", b"", &[]),
            (b"\r", b"\r", &[]),
            (b"t0052ABCD\r", b"\x07", &[]),
            (b"O\r", b"\r", &[Received::Open(Some(500_000))]),
            (b"t0052ABcd\r", b"z\r", &[Received::Frame(frame)]),
            (b"S8\r", b"\x07", &[]),
            (b"t0052AB\rx\rt8000\r", b"\x07\x07\x07", &[]),
            (b"R1234567Q4\r", b"\x07", &[]),
            (b"C\rC\r", b"\r\r", &[Received::Open(None)]),
        ];
        for (bytes, out, received) in cases {
            let found = talk(&mut slcan, bytes);
            assert_eq!(found, (out.to_vec(), received.to_vec()), "{:?}", String::from_utf8_lossy(bytes));
        }
    }

    #[test]
    fn frames_are_lines() {
        let mut line = Vec::new();
        encode(&Frame::new(0x1f, true, true, 8, &[]).unwrap(), &mut line);
        encode(&Frame::data(0x15, [0x15, 0x7f, 0xff, 0x7f, 0xf7, 0xff, 30, 31]), &mut line);
        assert_eq!(line, b"R0000001F8\rt0158157FFF7FF7FF1E1F\r");
    }

    proptest! {
        #[test]
        fn frames_round_trip(frame in strategies::frame()) {
            let mut line = Vec::new();
            encode(&frame, &mut line);
            prop_assert!(line.len() <= LONGEST);
            prop_assert_eq!(decode(&line[..line.len() - 1]), Some(frame));
        }

        #[test]
        fn every_line_is_answered(text in "[tTrROCSVNFZ0-9A-Fa-fx\r]{0,80}") {
            let (out, _) = talk(&mut Slcan::default(), text.as_bytes());
            let answers = out.iter().filter(|byte| matches!(byte, b'\r' | 0x07)).count();
            prop_assert_eq!(answers, text.matches('\r').count());
        }
    }
}
