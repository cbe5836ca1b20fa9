//! Serial devices that send lines of text: CDC-ACM and FTDI.
//!
//! A line is `SEQ,MONO_NS,sin,cos\n`: a counter, the send time, and two changing values; or a line of its feed. Data
//! from the host is ignored.

use std::fmt::Write;
use std::time::Duration;

use super::descriptor::{Answer, BULK_PACKET, CS_INTERFACE, Configuration, DeviceClass, Setup};
use super::feed::Records;
use super::function::DATA_IN;
use super::source::{Live, Source};

const DATA_OUT: u8 = 0x02;
const NOTIFY_IN: u8 = 0x83;
/// Modem and line status that open every FTDI packet: nothing asserted, transmitter empty.
const FTDI_STATUS: [u8; 2] = [0x01, 0x60];

/// Which protocol carries the lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flavour {
    /// CDC abstract control model.
    Acm,
    /// FT232R.
    Ftdi,
}

/// A serial device.
#[derive(Debug)]
pub struct Serial {
    flavour: Flavour,
    period: Duration,
    first_line: u64,
    next_line: u64,
    feed: Option<Records>,
    line_coding: [u8; 7],
}

impl Serial {
    /// A device that sends `hz` lines per second, numbered from `first`: those of `feed`, if given.
    pub fn new(flavour: Flavour, hz: f64, first: u32, feed: Option<Records>) -> Self {
        // 115200 8N1, the value a host reads before it sets its own.
        let line_coding = [0x00, 0xc2, 0x01, 0x00, 0, 0, 8];
        let first = first.into();
        let period = Duration::from_secs_f64(1.0 / hz);
        Self { flavour, period, first_line: first, next_line: first, feed, line_coding }
    }

    /// Class codes of the device.
    pub fn class(&self) -> DeviceClass {
        match self.flavour {
            Flavour::Acm => DeviceClass { class: [2, 0, 0], release: 0x0100 },
            // ftdi_sio distinguishes the chips by this release: 6.00 is an FT232R.
            Flavour::Ftdi => DeviceClass { class: [0, 0, 0], release: 0x0600 },
        }
    }

    /// The configuration descriptor.
    pub fn configuration(&self) -> Vec<u8> {
        let mut configuration = Configuration::default();
        match self.flavour {
            Flavour::Acm => configuration
                .interface(0, 1, [2, 2, 1])
                .push(&[CS_INTERFACE, 0, 0x10, 0x01])
                .push(&[CS_INTERFACE, 1, 0, 1])
                .push(&[CS_INTERFACE, 2, 2])
                .push(&[CS_INTERFACE, 6, 0, 1])
                .push(&[5, NOTIFY_IN, 3, 16, 0, 9])
                .interface(1, 2, [10, 0, 0]),
            Flavour::Ftdi => configuration.interface(0, 2, [255, 255, 255]),
        };
        configuration.bulk(DATA_IN).bulk(DATA_OUT).finish()
    }

    /// Line settings are stored and returned; none of them changes the stream.
    pub fn control(&mut self, setup: Setup, data: &[u8]) -> Answer {
        match (self.flavour, setup.request, setup.is_in()) {
            (Flavour::Acm, 0x20, false) => {
                if let Ok(coding) = data.try_into() {
                    self.line_coding = coding;
                }
                Answer::Done
            }
            (Flavour::Acm, 0x21, true) => Answer::Data(self.line_coding.to_vec()),
            (Flavour::Ftdi, 0x05, true) => Answer::Data(FTDI_STATUS.to_vec()),
            // Latency timer, in ms: the chip's default.
            (Flavour::Ftdi, 0x0a, true) => Answer::Data(vec![16]),
            // EEPROM words: erased.
            (Flavour::Ftdi, _, true) => Answer::Data(vec![0xff; usize::from(setup.length.min(2))]),
            (_, _, false) => Answer::Done,
            (Flavour::Acm, _, true) => Answer::Stall,
        }
    }
}

impl Source for Serial {
    /// Always sending; whether anybody reads depends on the host.
    fn live(&self) -> Option<Live> {
        Some(Live { stream: 0, period: self.period })
    }

    fn produce(&self, sent_ns: u64, out: &mut Vec<u8>) {
        out.clear();
        if let Some(feed) = &self.feed {
            let place = (self.next_line - self.first_line) as usize % feed.len();
            out.extend_from_slice(&feed[place]);
            return;
        }
        let phase = self.next_line as f64 / 100.0;
        let mut text = String::with_capacity(64);
        let infallible = writeln!(text, "{},{sent_ns},{:.6},{:.6}", self.next_line, phase.sin(), phase.cos());
        infallible.expect("writing to a string cannot fail");
        out.extend_from_slice(text.as_bytes());
    }

    fn sent(&mut self) {
        self.next_line += 1;
    }

    fn packet(&self, line: &[u8], at: usize, room: usize, out: &mut Vec<u8>) -> usize {
        let status: &[u8] = if self.flavour == Flavour::Ftdi { &FTDI_STATUS } else { &[] };
        let room = room.min(usize::from(BULK_PACKET)).saturating_sub(status.len()).max(1);
        let end = line.len().min(at + room);
        out.extend_from_slice(status);
        out.extend_from_slice(&line[at..end]);
        end
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emu::descriptor::check_configuration;

    #[test]
    fn configuration_lengths_add_up() {
        for flavour in [Flavour::Acm, Flavour::Ftdi] {
            check_configuration(&Serial::new(flavour, 100.0, 0, None).configuration());
        }
    }

    #[test]
    fn lines_count_only_when_sent() {
        let mut serial = Serial::new(Flavour::Acm, 100.0, 0, None);
        let mut line = Vec::new();
        serial.produce(5, &mut line);
        serial.produce(6, &mut line);
        assert_eq!(line, b"0,6,0.000000,1.000000\n");
        serial.sent();
        serial.produce(7, &mut line);
        assert!(line.starts_with(b"1,7,"));
    }

    #[test]
    fn given_lines_repeat() {
        let feed = Records::new(vec![b"1,2\n".to_vec(), b"3,4\n".to_vec()]);
        let mut serial = Serial::new(Flavour::Acm, 10.0, 2_000_001, Some(feed));
        let mut line = Vec::new();
        let mut lines = String::new();
        for _ in 0..3 {
            serial.produce(5, &mut line);
            lines.push_str(std::str::from_utf8(&line).unwrap());
            serial.sent();
        }
        assert_eq!(lines, "1,2\n3,4\n1,2\n");
    }

    #[test]
    fn ftdi_packets_start_with_status() {
        let mut packet = Vec::new();
        let serial = Serial::new(Flavour::Ftdi, 100.0, 0, None);
        assert_eq!(serial.packet(b"abc", 0, 512, &mut packet), 3);
        assert_eq!(packet, [FTDI_STATUS[0], FTDI_STATUS[1], b'a', b'b', b'c']);
        packet.clear();
        assert_eq!(serial.packet(b"abc", 1, 3, &mut packet), 2);
        assert_eq!(packet[2..], *b"b");
    }
}
