//! A CP2104: a serial adapter with four GPIO lines, which the kernel's `cp210x` exposes as a chip without interrupts.
//!
//! Lines 0 and 1 are outputs (push-pull), 2 and 3 inputs (open drain, pulled up): this is stored in the chip's memory.
//! Vendor requests are those of Silicon Labs' AN571, as used by `drivers/usb/serial/cp210x.c`.

use serde_json::json;

use super::descriptor::{Answer, Configuration, DeviceClass, Setup};
use super::function::DATA_IN;
use super::order::Order;
use super::reported::Reported;
use super::talker::Talker;

const DATA_OUT: u8 = 0x02;
/// Requests of one kind, distinguished by wValue.
const VENDOR_SPECIFIC: u8 = 0xff;
const GET_PARTNUM: u16 = 0x370b;
const GET_PORTCONFIG: u16 = 0x370c;
const READ_LATCH: u16 = 0x00c2;
const WRITE_LATCH: u16 = 0x37e1;
const CP2104: u8 = 0x04;
/// Number of lines.
const LINES: u8 = 4;
/// Bits of the lines that are outputs.
const OUTPUTS: u8 = 0b0011;

/// The chip.
#[derive(Debug)]
pub struct Gpio {
    /// The values written by the host, one bit per line.
    latch: u8,
    /// The external level of each line; high if nothing pulls it low.
    outside: u8,
    /// What is written is refused.
    is_mute: bool,
    reported: Vec<Reported>,
}

impl Default for Gpio {
    fn default() -> Self {
        Self { latch: 0x0f, outside: 0x0f, is_mute: false, reported: Vec::new() }
    }
}

impl Gpio {
    /// A driven line has the level of its driver, any other line its external level.
    fn levels(&self) -> u8 {
        (self.latch & OUTPUTS) | (self.latch & self.outside & !OUTPUTS)
    }

    fn write(&mut self, mask: u8, bits: u8) {
        let before = self.latch;
        self.latch = (self.latch & !mask | bits & mask) & 0x0f;
        for line in 0..LINES {
            let (was, is) = (before >> line & 1, self.latch >> line & 1);
            if OUTPUTS >> line & 1 == 1 && was != is {
                self.reported.push(Reported::new("gpio", json!({"line": line, "level": is})));
            }
        }
    }
}

impl Talker for Gpio {
    fn class(&self) -> DeviceClass {
        DeviceClass { class: [0, 0, 0], release: 0x0100 }
    }

    fn configuration(&self) -> Vec<u8> {
        Configuration::default().interface(0, 2, [255, 0, 0]).bulk(DATA_IN).bulk(DATA_OUT).finish()
    }

    fn string(&self, _: u8) -> Option<&str> {
        None
    }

    fn control(&mut self, setup: Setup, _: &[u8], _: u64) -> Answer {
        if setup.request != VENDOR_SPECIFIC {
            // Requests of the serial line, which is never opened.
            return if setup.is_in() { Answer::Data(vec![0; setup.length.into()]) } else { Answer::Done };
        }
        match (setup.value, setup.is_in()) {
            (GET_PARTNUM, true) => Answer::Data(vec![CP2104]),
            (GET_PORTCONFIG, true) => {
                let mut config = vec![0; setup.length.into()];
                // gpio_mode and reset_state, one bit per line from bit 8 on: push-pull, and high.
                config.iter_mut().zip([0, OUTPUTS, 0, 0, 0, 0x0f]).for_each(|(place, byte)| *place = byte);
                Answer::Data(config)
            }
            (READ_LATCH, true) => Answer::Data(vec![self.levels()]),
            (WRITE_LATCH, false) if self.is_mute => Answer::Stall,
            (WRITE_LATCH, false) => {
                let [mask, bits] = setup.index.to_le_bytes();
                self.write(mask, bits);
                Answer::Done
            }
            (_, true) => Answer::Stall,
            (_, false) => Answer::Done,
        }
    }

    fn receive(&mut self, _: &[u8], _: u64) {}

    fn tend(&mut self, _: u64) -> Option<u64> {
        None
    }

    fn take(&mut self, _: u8, _: usize, _: u64, _: &mut Vec<u8>) -> bool {
        false
    }

    fn discard(&mut self) {}

    /// A chip without power drives nothing: its lines go low.
    fn reset(&mut self) {
        self.write(OUTPUTS, 0);
        self.latch = 0x0f & !OUTPUTS;
    }

    fn apply(&mut self, line: Option<u16>, order: Order, _: u64) -> bool {
        match (order, line.filter(|line| *line < LINES.into())) {
            (Order::Level(is_high), Some(line)) => {
                self.outside = self.outside & !(1 << line) | u8::from(is_high) << line;
            }
            (Order::Mute(is_mute), None) => self.is_mute = is_mute,
            _ => return false,
        }
        true
    }

    fn reported(&mut self, reported: &mut Vec<Reported>) {
        reported.append(&mut self.reported);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn latch(gpio: &mut Gpio) -> u8 {
        let setup = Setup { kind: 0xc0, request: VENDOR_SPECIFIC, value: READ_LATCH, index: 0, length: 1 };
        let Answer::Data(bytes) = gpio.control(setup, &[], 0) else { panic!("no latch") };
        bytes[0]
    }

    #[test]
    fn outputs_have_the_written_level_and_inputs_that_of_their_pull() {
        let mut gpio = Gpio::default();
        gpio.reset();
        assert_eq!(latch(&mut gpio), 0b1100);
        let write = Setup { kind: 0x40, request: VENDOR_SPECIFIC, value: WRITE_LATCH, index: 0x0101, length: 0 };
        assert_eq!(gpio.control(write, &[], 0), Answer::Done);
        assert!(gpio.apply(None, Order::Mute(true), 0));
        assert_eq!(gpio.control(write, &[], 0), Answer::Stall);
        assert!(gpio.apply(None, Order::Mute(false), 0) && gpio.apply(Some(2), Order::Level(false), 0));
        assert!(!gpio.apply(Some(4), Order::Level(false), 0) && !gpio.apply(Some(1), Order::Ask, 0));
        assert_eq!(latch(&mut gpio), 0b1001);
        let mut reported = Vec::new();
        gpio.reported(&mut reported);
        assert_eq!(reported.last(), Some(&Reported::new("gpio", json!({"line": 0, "level": 1}))));
    }
}
