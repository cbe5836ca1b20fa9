//! The framing of Damiao's serial CAN adapter, as in the vendor's `DM_CAN.py` and `damiao.h`: 30 bytes per frame from
//! the host, 16 bytes to it.
//!
//! Invariant: bytes that do not start a frame are skipped one by one, as in the vendor's own reader.

use super::Frame;

const FROM_HOST: usize = 30;
/// Bytes of a frame to the host.
pub const TO_HOST: usize = 16;
const HEAD: [u8; 3] = [0x55, 0xaa, 0x1e];
/// Send, and confirm it to the host.
const FORWARD_ACKNOWLEDGED: u8 = 1;
/// Send.
const FORWARD: u8 = 3;
const RECEIVED: u8 = 0x11;
const SENT: u8 = 0x12;

/// The adapter's side of the line.
#[derive(Debug, Default)]
pub struct Damiao {
    inbox: Vec<u8>,
}

impl Damiao {
    /// Processes data from the host; acknowledgements go to `out`, frames to `send`.
    pub fn receive(&mut self, bytes: &[u8], out: &mut Vec<u8>, mut send: impl FnMut(Frame)) {
        self.inbox.extend_from_slice(bytes);
        let mut at = 0;
        while let Some(record) = self.inbox[at..].first_chunk::<FROM_HOST>() {
            if record[..3] != HEAD {
                at += 1;
                continue;
            }
            at += FROM_HOST;
            let Some(frame) = decode(record) else { continue };
            if record[3] == FORWARD_ACKNOWLEDGED {
                encode(&frame, SENT, out);
            }
            send(frame);
        }
        self.inbox.drain(..at);
    }
}

/// Appends a frame of the bus for the host.
pub fn send_to_host(frame: &Frame, out: &mut Vec<u8>) {
    encode(frame, RECEIVED, out);
}

fn decode(record: &[u8; FROM_HOST]) -> Option<Frame> {
    if !matches!(record[3], FORWARD | FORWARD_ACKNOWLEDGED) {
        return None;
    }
    let id = u32::from_le_bytes([record[13], record[14], record[15], record[16]]);
    let (extended, remote, len) = (record[12] != 0, record[17] != 0, usize::from(record[18]));
    Frame::new(id, extended, remote, len, record.get(21..21 + len).filter(|_| len <= 8)?)
}

fn encode(frame: &Frame, command: u8, out: &mut Vec<u8>) {
    let format = frame.len() | if frame.extended { 0x40 } else { 0 } | if frame.remote { 0x80 } else { 0 };
    out.extend_from_slice(&[0xaa, command, format]);
    out.extend_from_slice(&frame.id.to_le_bytes());
    out.extend_from_slice(&frame.padded());
    out.push(0x55);
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Enable, to the motor with slave id 5.
    const ENABLE: [u8; FROM_HOST] = [
        0x55, 0xaa, 0x1e, 0x03, 0x01, 0, 0, 0, 0x0a, 0, 0, 0, 0, 0x05, 0, 0, 0, 0, 0x08, 0, 0, 0xff, 0xff, 0xff, 0xff,
        0xff, 0xff, 0xff, 0xfc, 0,
    ];

    fn decoded(damiao: &mut Damiao, bytes: &[u8]) -> (Vec<u8>, Vec<Frame>) {
        let (mut out, mut frames) = (Vec::new(), Vec::new());
        damiao.receive(bytes, &mut out, |frame| frames.push(frame));
        (out, frames)
    }

    #[test]
    fn the_vendors_frames_are_read() {
        let frame = Frame::data(5, [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfc]);
        assert_eq!(decoded(&mut Damiao::default(), &ENABLE), (vec![], vec![frame]));
        let mut acknowledged = ENABLE;
        acknowledged[3] = 1;
        let (out, frames) = decoded(&mut Damiao::default(), &acknowledged);
        assert_eq!((out.len(), out[1], frames), (TO_HOST, 0x12, vec![frame]));
        let mut handshake = ENABLE;
        handshake[3] = 2;
        assert_eq!(decoded(&mut Damiao::default(), &handshake), (vec![], vec![]));
        let mut long = ENABLE;
        long[18] = 9;
        assert_eq!(decoded(&mut Damiao::default(), &long), (vec![], vec![]));
    }

    #[test]
    fn a_frame_of_the_bus_is_sixteen_bytes() {
        let mut out = Vec::new();
        send_to_host(&Frame::data(0x15, [0x15, 0x7f, 0xff, 0x7f, 0xf7, 0xff, 30, 31]), &mut out);
        let expected = [0xaa, 0x11, 8, 0x15, 0, 0, 0, 0x15, 0x7f, 0xff, 0x7f, 0xf7, 0xff, 30, 31, 0x55];
        assert_eq!(out, expected);
    }

    proptest! {
        #[test]
        fn frames_are_found_after_any_noise(
            noise in proptest::collection::vec(any::<u8>().prop_filter("no head", |byte| *byte != 0x55), 0..60),
            cut in 1_usize..30,
        ) {
            let mut damiao = Damiao::default();
            let bytes = [&noise[..], &ENABLE, &ENABLE].concat();
            let frames: usize = bytes.chunks(cut).map(|part| decoded(&mut damiao, part).1.len()).sum();
            prop_assert_eq!(frames, 2);
        }
    }
}
