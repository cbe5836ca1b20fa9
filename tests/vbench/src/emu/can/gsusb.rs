//! The gs_usb protocol, as in the kernel's `drivers/net/can/usb/gs_usb.c`: control requests and host frames of a classic adapter.
//!
//! Invariant: pure; one host frame is one transfer, 20 bytes, whatever its length.

use super::Frame;
use crate::emu::descriptor::{Answer, Setup};

/// Bytes of a host frame without a time stamp.
pub const HOST_FRAME: usize = 20;
/// Echo id of a frame that did not come from the host.
pub const FROM_THE_BUS: u32 = u32::MAX;

const CLOCK_HZ: u32 = 48_000_000;
const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;
const ERROR: u32 = 1 << 29;
/// Classes of error frames (`linux/can/error.h`).
const CLASS_BUS_OFF: u32 = 0x40;
const CLASS_RESTARTED: u32 = 0x100;

/// A control request's effect on the adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Bits a second on the bus.
    Bitrate(u32),
    /// Join the bus, or leave it.
    Start(bool),
}

/// The answer to a control request, and its effect.
pub fn control(setup: Setup, data: &[u8]) -> (Answer, Option<Request>) {
    const BITTIMING: u8 = 1;
    const MODE: u8 = 2;
    const BT_CONST: u8 = 4;
    const DEVICE_CONFIG: u8 = 5;
    let word = |place: usize| {
        let bytes = data.get(place * 4..place * 4 + 4).and_then(|bytes| bytes.try_into().ok());
        u32::from_le_bytes(bytes.unwrap_or_default())
    };
    let words = |words: &[u32]| Answer::Data(words.iter().flat_map(|word| word.to_le_bytes()).collect());
    match (setup.request, setup.is_in()) {
        // Three reserved bytes and the number of channels minus one; software and hardware version.
        (DEVICE_CONFIG, true) => (words(&[0, 2, 1]), None),
        // No features; clock; limits of tseg1, tseg2, sjw and brp.
        (BT_CONST, true) => (words(&[0, CLOCK_HZ, 1, 16, 1, 8, 4, 1, 1024, 1]), None),
        (BITTIMING, false) => {
            let quanta = [0, 1, 2].into_iter().try_fold(1_u32, |sum, part| sum.checked_add(word(part)));
            let divisor = quanta.and_then(|quanta| quanta.checked_mul(word(4)));
            let rate = divisor.and_then(|divisor| CLOCK_HZ.checked_div(divisor));
            (Answer::Done, rate.map(Request::Bitrate))
        }
        (MODE, false) => (Answer::Done, Some(Request::Start(word(0) == 1))),
        (_, true) => (Answer::Stall, None),
        (_, false) => (Answer::Done, None),
    }
}

/// A frame as the host sees it.
pub fn encode(frame: &Frame, echo: u32) -> [u8; HOST_FRAME] {
    let flags = if frame.extended { EXTENDED } else { 0 } | if frame.remote { REMOTE } else { 0 };
    host_frame(echo, frame.id | flags, frame.len(), frame.padded())
}

/// A frame from the host and its echo id.
pub fn decode(bytes: &[u8]) -> Option<(u32, Frame)> {
    let bytes: &[u8; HOST_FRAME] = bytes.get(..HOST_FRAME)?.try_into().ok()?;
    let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    let (echo, id, len) = (word(0), word(4), usize::from(bytes[8]));
    let extended = id & EXTENDED != 0;
    let mask = if extended { 0x1fff_ffff } else { 0x7ff };
    Some((echo, Frame::new(id & mask, extended, id & REMOTE != 0, len, bytes.get(12..12 + len)?)?))
}

/// The error frame that reports bus-off, or recovery.
pub fn bus_off(is_off: bool) -> [u8; HOST_FRAME] {
    host_frame(FROM_THE_BUS, ERROR | if is_off { CLASS_BUS_OFF } else { CLASS_RESTARTED }, 8, [0; 8])
}

fn host_frame(echo: u32, id: u32, len: u8, data: [u8; 8]) -> [u8; HOST_FRAME] {
    let mut bytes = [0; HOST_FRAME];
    bytes[0..4].copy_from_slice(&echo.to_le_bytes());
    bytes[4..8].copy_from_slice(&id.to_le_bytes());
    bytes[8] = len;
    bytes[12..20].copy_from_slice(&data);
    bytes
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::emu::can::strategies;

    fn setup(request: u8, to_host: bool) -> Setup {
        Setup { kind: if to_host { 0xc1 } else { 0x41 }, request, value: 1, index: 0, length: 64 }
    }

    #[test]
    fn a_frame_of_the_host_is_read() {
        let bytes = [7, 0, 0, 0, 0x05, 0, 0, 0, 2, 0, 0, 0, 0xab, 0xcd, 0, 0, 0, 0, 0, 0];
        let frame = Frame::new(5, false, false, 2, &[0xab, 0xcd]).unwrap();
        assert_eq!(decode(&bytes), Some((7, frame)));
        assert_eq!(decode(&bytes[..19]), None);
        let mut long = bytes;
        long[8] = 9;
        assert_eq!(decode(&long), None);
    }

    #[test]
    fn the_bit_rate_is_counted_from_its_parts() {
        // prop 5, phase 6 and 4, jump 1, brp 3: 16 quanta of 1/16 MHz.
        let data: Vec<u8> = [5_u32, 6, 4, 1, 3].iter().flat_map(|word| word.to_le_bytes()).collect();
        assert_eq!(control(setup(1, false), &data), (Answer::Done, Some(Request::Bitrate(1_000_000))));
        assert_eq!(control(setup(1, false), &[0; 20]), (Answer::Done, None), "no quanta");
        assert_eq!(control(setup(2, false), &[1, 0, 0, 0, 0, 0, 0, 0]).1, Some(Request::Start(true)));
        assert_eq!(control(setup(2, false), &[0; 8]).1, Some(Request::Start(false)));
    }

    #[test]
    fn the_kernel_learns_one_channel() {
        let (Answer::Data(config), None) = control(setup(5, true), &[]) else { panic!("no answer") };
        assert_eq!((config.len(), config[3]), (12, 0));
        let (Answer::Data(limits), None) = control(setup(4, true), &[]) else { panic!("no answer") };
        assert_eq!(limits.len(), 40);
    }

    proptest! {
        #[test]
        fn frames_round_trip(frame in strategies::frame(), echo in any::<u32>()) {
            prop_assert_eq!(decode(&encode(&frame, echo)), Some((echo, frame)));
        }

        #[test]
        fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..40), request in 0_u8..20) {
            decode(&bytes);
            control(setup(request, false), &bytes);
        }
    }
}
