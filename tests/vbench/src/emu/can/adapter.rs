//! A USB adapter for a CAN bus: gs_usb, or a serial line that uses slcan or Damiao's framing.
//!
//! Invariant: the host's frames reach the bus only while the adapter is on it, at the bus's own rate, and not bus-off.

use std::collections::VecDeque;

use serde_json::json;

use super::Frame;
use super::bus::{Bus, MotorSpec};
use super::damiao::{self, Damiao};
use super::gsusb::{self, FROM_THE_BUS, HOST_FRAME, Request};
use super::slcan::{Received, Slcan};
use crate::emu::descriptor::{Answer, BULK_PACKET, Configuration, DeviceClass, Setup};
use crate::emu::function::DATA_IN;
use crate::emu::order::Order;
use crate::emu::reported::Reported;
use crate::emu::serial::{Flavour, Serial};
use crate::emu::talker::Talker;

/// The rate of every simulated bus, bits a second.
const BUS_RATE: u32 = 1_000_000;
const DATA_OUT: u8 = 0x02;
/// Output buffer of an adapter for a host that does not fetch; further data is lost, and reported.
const OUTBOX: usize = 64 * 1024;

/// The adapter's protocol with the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Protocol {
    /// gs_usb: a network interface `can0`.
    GsUsb,
    /// slcan on a CDC-ACM line.
    Slcan,
    /// Damiao's frames on a CDC-ACM line.
    Damiao,
}

/// An adapter with its bus.
#[derive(Debug)]
pub struct Adapter {
    codec: Codec,
    bus: Bus,
    /// The bit rate that was set; `None`: it is not on the bus.
    on_bus: Option<u32>,
    rate: u32,
    is_off: bool,
    /// Frames that wait for the bus to recover, with their echo ids.
    held: VecDeque<(u32, Frame)>,
    outbox: VecDeque<u8>,
    lost: u64,
    reported: Vec<Reported>,
}

#[derive(Debug)]
enum Codec {
    GsUsb,
    Slcan(Serial, Slcan),
    Damiao(Serial, Damiao),
}

impl Codec {
    fn new(protocol: Protocol) -> Self {
        // Only the descriptors and settings of the serial line are used, none of its own text lines.
        let line = || Serial::new(Flavour::Acm, 1.0, 0, None);
        match protocol {
            Protocol::GsUsb => Self::GsUsb,
            Protocol::Slcan => Self::Slcan(line(), Slcan::default()),
            Protocol::Damiao => Self::Damiao(line(), Damiao::default()),
        }
    }

    fn protocol(&self) -> Protocol {
        match self {
            Self::GsUsb => Protocol::GsUsb,
            Self::Slcan(..) => Protocol::Slcan,
            Self::Damiao(..) => Protocol::Damiao,
        }
    }
}

impl Adapter {
    /// An adapter on a bus with these motors.
    pub fn new(protocol: Protocol, motors: &[MotorSpec]) -> Self {
        let mut adapter = Self {
            codec: Codec::new(protocol),
            bus: Bus::new(motors),
            on_bus: None,
            rate: BUS_RATE,
            is_off: false,
            held: VecDeque::new(),
            outbox: VecDeque::new(),
            lost: 0,
            reported: Vec::new(),
        };
        adapter.reset();
        adapter
    }

    fn join(&mut self, rate: Option<u32>) {
        if self.on_bus == rate {
            return;
        }
        self.on_bus = rate;
        match rate {
            Some(rate) => self.report("can_up", json!({"bitrate": rate, "fits": rate == BUS_RATE})),
            None => {
                let lost = std::mem::take(&mut self.lost);
                self.report("can_down", json!({"lost": lost}));
            }
        }
        self.is_off = false;
        self.held.clear();
        // Answers on a serial line are already in transit.
        if matches!(self.codec, Codec::GsUsb) {
            self.outbox.clear();
        }
    }

    fn is_connected(&self) -> bool {
        self.on_bus == Some(BUS_RATE) && !self.is_off
    }

    /// Byte by byte: the effects of one command come before the answer to the next.
    fn receive_text(&mut self, text: &[u8], now_ns: u64) {
        for byte in text {
            let Codec::Slcan(_, slcan) = &mut self.codec else { return };
            let (mut answer, mut what) = (Vec::new(), None);
            slcan.receive(&[*byte], &mut answer, |received| what = Some(received));
            self.outbox.extend(answer);
            match what {
                Some(Received::Open(rate)) => self.join(rate),
                Some(Received::Frame(frame)) => self.send(FROM_THE_BUS, frame, now_ns),
                None => {}
            }
        }
    }

    /// A frame from the host; a gs_usb host expects an echo once it is on the bus.
    fn send(&mut self, echo: u32, frame: Frame, now_ns: u64) {
        if !self.is_connected() {
            if self.on_bus == Some(BUS_RATE) {
                self.held.push_back((echo, frame));
            }
            return;
        }
        if matches!(self.codec, Codec::GsUsb) {
            self.outbox.extend(gsusb::encode(&frame, echo));
        }
        let Self { bus, codec, outbox, lost, .. } = self;
        bus.send(&frame, now_ns, |answer| put(codec, &answer, outbox, lost));
    }

    fn set_off(&mut self, is_off: bool, now_ns: u64) {
        self.is_off = is_off;
        self.report("bus_off", json!({"off": is_off}));
        if matches!(self.codec, Codec::GsUsb) && self.on_bus.is_some() {
            self.outbox.extend(gsusb::bus_off(is_off));
        }
        if !is_off {
            for (echo, frame) in std::mem::take(&mut self.held) {
                self.send(echo, frame, now_ns);
            }
        }
    }

    fn report(&mut self, action: &'static str, fields: serde_json::Value) {
        self.reported.push(Reported::new(action, fields));
    }
}

/// Writes a frame of the bus for the host.
fn put(codec: &Codec, frame: &Frame, outbox: &mut VecDeque<u8>, lost: &mut u64) {
    if outbox.len() > OUTBOX {
        *lost += 1;
        return;
    }
    let mut text = Vec::with_capacity(32);
    match codec {
        Codec::GsUsb => text.extend(gsusb::encode(frame, FROM_THE_BUS)),
        Codec::Slcan(_, slcan) => slcan.send_to_host(frame, &mut text),
        Codec::Damiao(..) => damiao::send_to_host(frame, &mut text),
    }
    outbox.extend(text);
}

impl Talker for Adapter {
    fn class(&self) -> DeviceClass {
        match &self.codec {
            Codec::GsUsb => DeviceClass { class: [0, 0, 0], release: 0x0100 },
            Codec::Slcan(line, _) | Codec::Damiao(line, _) => line.class(),
        }
    }

    fn configuration(&self) -> Vec<u8> {
        match &self.codec {
            Codec::GsUsb => {
                Configuration::default().interface(0, 2, [255, 255, 255]).bulk(DATA_IN).bulk(DATA_OUT).finish()
            }
            Codec::Slcan(line, _) | Codec::Damiao(line, _) => line.configuration(),
        }
    }

    fn string(&self, _index: u8) -> Option<&str> {
        None
    }

    fn control(&mut self, setup: Setup, data: &[u8], _now_ns: u64) -> Answer {
        match &mut self.codec {
            Codec::GsUsb => {
                let (answer, request) = gsusb::control(setup, data);
                match request {
                    Some(Request::Bitrate(rate)) => self.rate = rate,
                    Some(Request::Start(start)) => self.join(start.then_some(self.rate)),
                    None => {}
                }
                answer
            }
            Codec::Slcan(line, _) | Codec::Damiao(line, _) => line.control(setup, data),
        }
    }

    fn receive(&mut self, data: &[u8], now_ns: u64) {
        let mut frames = Vec::new();
        let mut answers = Vec::new();
        match &mut self.codec {
            Codec::GsUsb => frames.extend(gsusb::decode(data)),
            Codec::Slcan(..) => return self.receive_text(data, now_ns),
            Codec::Damiao(_, damiao) => {
                damiao.receive(data, &mut answers, |frame| frames.push((FROM_THE_BUS, frame)));
            }
        }
        self.outbox.extend(answers);
        for (echo, frame) in frames {
            self.send(echo, frame, now_ns);
        }
    }

    fn tend(&mut self, now_ns: u64) -> Option<u64> {
        self.bus.tend(now_ns)
    }

    fn take(&mut self, endpoint: u8, room: usize, now_ns: u64, out: &mut Vec<u8>) -> bool {
        if endpoint != DATA_IN & 0x0f {
            return false;
        }
        let most = match self.codec {
            Codec::GsUsb => HOST_FRAME,
            Codec::Slcan(..) | Codec::Damiao(..) => room.min(usize::from(BULK_PACKET)),
        };
        // Generated frames come last: they fill the rest of a transfer.
        while self.is_connected() && self.outbox.len() < most {
            let Some(frame) = self.bus.generated(now_ns) else { break };
            put(&self.codec, &frame, &mut self.outbox, &mut self.lost);
        }
        let taken = self.outbox.len().min(most);
        out.extend(self.outbox.drain(..taken));
        taken != 0
    }

    fn discard(&mut self) {
        self.outbox.clear();
    }

    fn reset(&mut self) {
        self.join(None);
        self.outbox.clear();
        self.codec = Codec::new(self.codec.protocol());
        // It has no command to join the bus: it is on it whenever it has power.
        if self.codec.protocol() == Protocol::Damiao {
            self.on_bus = Some(BUS_RATE);
        }
    }

    fn apply(&mut self, motor: Option<u16>, order: Order, now_ns: u64) -> bool {
        match order {
            Order::Link(_) | Order::Level(_) => false,
            Order::BusOff(is_off) => {
                self.set_off(is_off, now_ns);
                true
            }
            _ => self.bus.apply(motor, order, now_ns),
        }
    }

    fn reported(&mut self, reported: &mut Vec<Reported>) {
        reported.append(&mut self.reported);
        reported.extend(self.bus.reported());
    }
}

#[cfg(test)]
#[path = "adapter_tests.rs"]
mod tests;
