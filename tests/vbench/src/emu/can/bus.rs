//! The bus behind the adapter: motors, and a generator of frames.
//!
//! A generated frame has `FLOOD_ID`, a counter of 32 bits and the low 32 bits of its send time in us, both little-endian.
//!
//! Invariant: a generated frame's number is used only if the adapter has space, so a gap is the reader's loss.

use super::Frame;
use super::motor::Motor;
use super::registers::Type;
use crate::emu::order::Order;
use crate::emu::pace::Pace;
use crate::emu::reported::Reported;

/// Identifier of generated frames: not used by any motor, and of lower priority than all of theirs.
pub const FLOOD_ID: u16 = 0x7f0;

/// A motor of a specification: `5/15/DMH3510`, slave and master id in hexadecimal and its type.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MotorSpec {
    /// Identifier of commands to it.
    pub slave: u16,
    /// Identifier of its answers.
    pub master: u16,
    /// Its type.
    pub kind: Type,
}

impl MotorSpec {
    /// Reads `SLAVE/MASTER/TYPE`.
    pub fn parse(text: &str) -> Option<Self> {
        let mut parts = text.split('/');
        let mut id = |limit| u16::from_str_radix(parts.next()?, 16).ok().filter(|id| *id < limit);
        let (slave, master) = (id(0x100)?, id(0x800)?);
        let kind = Type::named(parts.next()?)?;
        parts.next().is_none().then_some(Self { slave, master, kind })
    }
}

impl std::fmt::Display for MotorSpec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:x}/{:x}/{}", self.slave, self.master, self.kind.name())
    }
}

/// The bus.
#[derive(Debug)]
pub struct Bus {
    motors: Vec<Motor>,
    flood: Option<Pace>,
    reported: Vec<Reported>,
}

impl Bus {
    /// A bus with these motors.
    pub fn new(motors: &[MotorSpec]) -> Self {
        let motors = motors.iter().map(|spec| Motor::new(spec.kind, spec.slave, spec.master)).collect();
        Self { motors, flood: None, reported: Vec::new() }
    }

    /// Passes on a frame from the adapter; its answers go to `answers`.
    pub fn send(&mut self, frame: &Frame, now_ns: u64, mut answers: impl FnMut(Frame)) {
        for motor in &mut self.motors {
            motor.receive(frame, now_ns).into_iter().for_each(&mut answers);
        }
    }

    /// Advances time; returns when it must be called again at the latest.
    pub fn tend(&mut self, now_ns: u64) -> Option<u64> {
        let flood = self.flood.map(|flood| flood.next_ns(now_ns));
        self.motors.iter_mut().filter_map(|motor| motor.tend(now_ns)).chain(flood).min()
    }

    /// The next generated frame, if one is due.
    pub fn generated(&mut self, now_ns: u64) -> Option<Frame> {
        let number = self.flood.as_mut()?.beat(now_ns)?;
        let [a, b, c, d] = number.to_le_bytes();
        let [e, f, g, h, ..] = (now_ns / 1_000).to_le_bytes();
        Some(Frame::data(FLOOD_ID, [a, b, c, d, e, f, g, h]))
    }

    /// Applies an event to the bus or to one of its motors; false if there is no such motor.
    pub fn apply(&mut self, motor: Option<u16>, order: Order, now_ns: u64) -> bool {
        if let Order::Flood(hz) = order {
            if let Some(mut flood) = self.flood.take() {
                self.reported.push(Reported::new("flood_end", flood.summary(now_ns)));
            }
            self.flood = (hz > 0.0).then(|| Pace::new(hz, now_ns));
            return true;
        }
        let wanted = |slave| motor.is_none_or(|motor| u32::from(motor) == slave);
        let mut found = false;
        for motor in self.motors.iter_mut().filter(|motor| wanted(motor.slave())) {
            motor.apply(order, now_ns);
            found = true;
        }
        found
    }

    /// The events on the bus since the last call.
    pub fn reported(&mut self) -> impl Iterator<Item = Reported> + '_ {
        self.reported.drain(..).chain(self.motors.iter_mut().flat_map(Motor::reported))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const MS: u64 = 1_000_000;

    fn counters(bus: &mut Bus, now_ns: u64) -> Vec<u32> {
        let counter = |frame: Frame| u32::from_le_bytes(frame.padded()[..4].try_into().unwrap());
        std::iter::from_fn(|| bus.generated(now_ns)).map(counter).collect()
    }

    #[test]
    fn a_motor_specification_is_read_as_it_is_printed() {
        let spec = MotorSpec::parse("5/15/DMH3510").unwrap();
        assert_eq!((spec.slave, spec.master, spec.to_string().as_str()), (0x05, 0x15, "5/15/DMH3510"));
        for wrong in ["5", "5/15", "5/15/DM1", "100/15/DM4310", "5/800/DM4310", "5/15/DM4310/1"] {
            assert_eq!(MotorSpec::parse(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn each_motor_answers_for_itself() {
        let mut bus = Bus::new(&["5/15/DMH3510", "6/16/DM4310"].map(|text| MotorSpec::parse(text).unwrap()));
        let mut answers = Vec::new();
        bus.send(&Frame::data(0x06, [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfc]), 0, |frame| answers.push(frame));
        assert_eq!(answers.iter().map(|frame| (frame.id, frame.padded()[0])).collect::<Vec<_>>(), [(0x16, 0x16)]);
        assert!(bus.apply(Some(0x05), Order::Mute(true), 0));
        assert!(!bus.apply(Some(0x07), Order::Mute(true), 0), "no such motor");
        answers.clear();
        bus.send(&Frame::data(0x05, [0; 8]), 0, |frame| answers.push(frame));
        assert_eq!(answers, []);
        assert_eq!(bus.reported().map(|reported| reported.action).collect::<Vec<_>>(), ["motor_enabled"]);
    }

    #[test]
    fn the_generator_counts_its_output() {
        let mut bus = Bus::new(&[]);
        bus.apply(None, Order::Flood(1_000.0), 0);
        assert_eq!(counters(&mut bus, 0), [0_u32; 0]);
        assert_eq!(counters(&mut bus, 3 * MS), [0, 1, 2]);
        assert_eq!(bus.tend(3 * MS), Some(4 * MS));
        bus.apply(None, Order::Flood(0.0), 4 * MS);
        assert_eq!(counters(&mut bus, 9 * MS), [0_u32; 0]);
        let reported: Vec<Reported> = bus.reported().collect();
        assert_eq!(reported[0], Reported::new("flood_end", json!({"sent": 3, "skipped": 0})));
    }
}
