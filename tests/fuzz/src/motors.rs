//! Motors: foreign frames on their bus, and actions of arbitrary numbers.

#[path = "../../support/motor_spec.rs"]
mod motor_spec;

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::damiao::codec::{Feedback, MotorStatus, Ranges, StateCommand};
use rapid_motors::control::damiao::parameter::{Parameter, Reply, Value};
use rapid_motors::control::motors::{BusState, MotorBus, SAMPLE_VALUES};
use rapid_registry::{DamiaoSpec, MotorMode, MotorSpec};

/// Bytes of one thing that happens: what, a number, and eight more.
const RECORD: usize = 10;
/// Things that may happen in one input.
const LONGEST: usize = 2000;
const FEED: u8 = 0;
const STEP: u8 = 1;
const TARGET: u8 = 2;
const ARM: u8 = 3;
const DISARM: u8 = 4;
const KINDS: u8 = 5;

/// A bus of two motors: whatever comes, what is measured is a number within the motor's ranges, what is
/// commanded lies within the limits or where the joint is, and nothing moves before an arm, nor after what
/// ended it.
pub fn motors(bytes: &[u8]) {
    let spec = spec();
    let mut now = Stamp(1_000_000_000_000);
    let mut bus = MotorBus::new(&spec, now);
    let mut axes: Vec<Axis> = spec.motors.iter().map(Axis::new).collect();
    let mut sample = [0.0; 2 * SAMPLE_VALUES];
    let mut may_move = false;
    for record in bytes.chunks_exact(RECORD).take(LONGEST) {
        let [what, number, data @ ..] = record else { return };
        let data: [u8; 8] = data.try_into().unwrap_or_default();
        let ms = u64::from(*number);
        match what % KINDS {
            FEED => {
                let frame = CanFrame { id: u32::from(*number), len: 8, data, ..CanFrame::default() };
                if let Some(reply) = Reply::decode(&frame) {
                    assert_eq!(reply.encode(u16::from(*number)), frame, "a reply is what was sent");
                }
                bus.feed(&frame, now);
                axes.iter_mut().for_each(|axis| axis.receive(&frame));
            }
            STEP => {
                now = now.after(Duration::from_millis(ms));
                let mut sent = 0;
                bus.step(now, |frame| {
                    assert!(may_move || is_harmless(&frame), "{frame:x?} while nothing may move");
                    axes.iter().for_each(|axis| axis.judge_frame(&frame));
                    sent += 1;
                });
                assert!(sent <= 4);
                if bus.is_armed() {
                    axes.iter().zip(bus.commands()).for_each(|(axis, command)| axis.judge(command));
                }
            }
            TARGET => {
                let [a, b, c, d, e, f, g, h] = data;
                let first = f64::from(f32::from_le_bytes([a, b, c, d]));
                let second = f64::from(f32::from_le_bytes([e, f, g, h]));
                let taken = bus.target(&[first, second], now.before(Duration::from_millis(ms)), now);
                assert!(!taken || first.is_finite() && second.is_finite() && bus.is_armed());
            }
            ARM => {
                let was_off = !is_on(bus.state());
                bus.arm(now);
                if was_off && is_on(bus.state()) {
                    axes.iter_mut().for_each(Axis::arm);
                }
                may_move = true;
            }
            _ => {
                bus.disarm(now);
                may_move = false;
            }
        }
        // A fault and the deadman end an arm as an order does.
        may_move &= is_on(bus.state());
        if bus.sample(&mut sample).is_some() {
            axes.iter().zip(sample.as_chunks().0).for_each(|(axis, values)| axis.judge_sample(values));
        }
        while let Some(notice) = bus.take_notice() {
            assert!(!notice.words(bus.names()).to_string().is_empty());
        }
    }
    let stops: Vec<CanFrame> = bus.stop_frames().collect();
    assert!(stops.len() == 2 && stops.iter().all(is_harmless));
    assert_eq!(bus.state(), BusState::Stopped);
    bus.step(now, |frame| panic!("{frame:x?} after a stop"));
}

/// An arm was asked for, and nothing has ended it.
fn is_on(state: BusState) -> bool {
    matches!(state, BusState::Arming | BusState::Following | BusState::Holding)
}

/// Requests for parameters and feedback, and orders to turn off.
fn is_harmless(frame: &CanFrame) -> bool {
    frame.id == 0x7ff || *frame == StateCommand::Disable.frame(u16::try_from(frame.id).unwrap_or_default())
}

/// What is known of a motor from the frames alone.
struct Axis {
    spec: MotorSpec,
    /// The ends of position, velocity and torque that it reported: the smallest and the largest of each. Which of
    /// them counts is decided by the bus, so what is judged by them is judged by the largest.
    reported: [[f64; 2]; 3],
    /// The newest positions it reported, rad, the newest last. Two that are impossible may be passed over, not a third.
    measured: Vec<f64>,
    /// What a position may be commanded: within the limits, or where the joint was since the arm.
    span: [f64; 2],
}

impl Axis {
    fn new(spec: &MotorSpec) -> Self {
        Self { spec: spec.clone(), reported: [[f64::INFINITY, 0.0]; 3], measured: Vec::new(), span: spec.position }
    }

    fn receive(&mut self, frame: &CanFrame) {
        if frame.id != u32::from(self.spec.master) {
            return;
        }
        let Some(reply) = Reply::decode(frame) else { return self.measure(frame) };
        let value = reply.value.number();
        let which = match reply.parameter {
            Parameter::PMax => 0,
            Parameter::VMax => 1,
            Parameter::TMax => 2,
            _ => return,
        };
        if reply.slave == self.spec.slave && value.is_finite() && value > 0.0 {
            let [smallest, largest] = &mut self.reported[which];
            (*smallest, *largest) = (smallest.min(value), largest.max(value));
        }
    }

    fn measure(&mut self, frame: &CanFrame) {
        let ranges = Ranges::new(self.reported[0][1], 1.0, 1.0);
        let Some(feedback) = ranges.and_then(|ranges| Feedback::decode(frame, &ranges)) else { return };
        if u16::from(feedback.id) == self.spec.slave {
            if self.measured.len() > 2 {
                self.measured.remove(0);
            }
            self.measured.push(feedback.q);
            self.span = [self.span[0].min(feedback.q), self.span[1].max(feedback.q)];
        }
    }

    /// What was before is of the past, but for where the joint is.
    fn arm(&mut self) {
        let [low, high] = self.spec.position;
        let measured = self.measured.iter().copied();
        self.span = [measured.clone().fold(low, f64::min), measured.fold(high, f64::max)];
    }

    /// What a position is counted in, rad, if it has reported one range alone.
    fn quantum(&self) -> Option<f64> {
        let [smallest, largest] = self.reported[0];
        (smallest.to_bits() == largest.to_bits()).then_some(2.0 * largest / 65_535.0)
    }

    /// A command, after a step.
    fn judge(&self, command: f64) {
        let [low, high] = self.spec.position;
        let slack = self.quantum().unwrap_or(2.0 * self.reported[0][1] / 65_535.0);
        assert!(!self.measured.is_empty(), "a command before any answer");
        match self.spec.mode {
            MotorMode::Velocity => {
                assert!(command.abs() <= self.spec.velocity, "{command} rad/s");
                let back = |measured: &f64| {
                    (*measured <= high + slack || command <= 0.0) && (*measured >= low - slack || command >= 0.0)
                };
                let is_back = self.measured.iter().any(back);
                assert!(is_back || self.quantum().is_none(), "{command} rad/s at {:?}", self.measured);
            }
            _ => {
                let [low, high] = self.span;
                assert!((low - slack..=high + slack).contains(&command), "{command} is beyond {low}..{high}");
            }
        }
    }

    /// The stiffness in a frame asks for no more than the torque limit.
    fn judge_torque(&self, command: f64, [high, low]: [u8; 2], quantum: f64) {
        let kp = f64::from(u16::from_be_bytes([high & 0xf, low])) / 4095.0 * 500.0;
        let least = self.measured.iter().map(|measured| (command - measured).abs()).fold(f64::INFINITY, f64::min);
        let most = self.spec.torque + 2.0 * quantum * kp;
        assert!(kp * least <= most, "{kp} Nm/rad to {command} at {:?}", self.measured);
    }

    /// A frame: what it commands of this motor is judged as it is written there.
    fn judge_frame(&self, frame: &CanFrame) {
        let [a, b, c, d, e, ..] = frame.data;
        match self.spec.mode {
            MotorMode::Velocity if frame.id == u32::from(self.spec.slave) + 0x200 => {
                self.judge(f64::from(f32::from_le_bytes([a, b, c, d])));
            }
            // Seven such bytes begin a state command.
            MotorMode::Mit { .. } if frame.id == u32::from(self.spec.slave) && !frame.data.starts_with(&[0xff; 7]) => {
                let Some(quantum) = self.quantum() else { return };
                let command = f64::from(u16::from_be_bytes([a, b])) * quantum - self.reported[0][1];
                self.judge(command);
                self.judge_torque(command, [d, e], quantum);
            }
            _ => {}
        }
    }

    /// Its alleged answer.
    fn judge_sample(&self, values: &[f64; SAMPLE_VALUES]) {
        let [q, dq, tau, rest @ ..] = values;
        for (value, [_, end]) in [q, dq, tau].into_iter().zip(self.reported) {
            assert!(value.abs() <= end, "{value} of {end}");
        }
        let [mos, rotor, status] = rest.map(|value| (0_u8..=255).find(|byte| f64::from(*byte) == value));
        assert!(mos.is_some() && rotor.is_some() && status.is_some_and(|status| status <= 15), "{values:?}");
    }
}

fn spec() -> DamiaoSpec {
    // Slow, so that it gets there before it has to brake.
    let wheel = MotorSpec { mode: MotorMode::Velocity, velocity: 2.0, ..motor_spec::motor(2) };
    motor_spec::bus(vec![motor_spec::motor(1), wheel])
}

/// From the first frame to motors that follow; and the same, stopped by each of what stops motors.
#[must_use]
pub fn sessions() -> Vec<Vec<u8>> {
    let good = session();
    let and = |more: &[Vec<u8>]| [good.clone(), more.concat()].concat();
    let step = || record(STEP, 5, [0; 8]);
    vec![
        good.clone(),
        and(&[
            record(DISARM, 0, [0; 8]),
            step(),
            feedback(1, MotorStatus::Disabled),
            feedback(2, MotorStatus::Disabled),
            step(),
        ]),
        and(&[feedback(1, MotorStatus::OverCurrent), step(), record(ARM, 0, [0; 8]), step()]),
        and(&[record(STEP, 60, [0; 8]), step()]),
        and(&(0..300)
            .flat_map(|_| [step(), feedback(1, MotorStatus::Enabled), feedback(2, MotorStatus::Enabled)])
            .collect::<Vec<_>>()),
        and(&[target(f32::NAN, 1.0), target(1e30, -1e30), step()]),
        and(&[beyond(1.9, -1.9).repeat(60), beyond(2.3, 2.3).repeat(5)]),
    ]
}

fn session() -> Vec<u8> {
    let both = |status| [feedback(1, status), feedback(2, status)].concat();
    let replies = |parameter, values: [Value; 2]| {
        [1_u16, 2]
            .iter()
            .zip(values)
            .map(|(&slave, value)| {
                let frame = Reply { slave, written: false, parameter, value }.encode(0x10 + slave);
                record(FEED, frame.id.to_le_bytes()[0], frame.data)
            })
            .collect::<Vec<_>>()
            .concat()
    };
    let step = record(STEP, 5, [0; 8]);
    let probe = [
        step.clone(),
        both(MotorStatus::Disabled),
        step.clone(),
        replies(Parameter::ControlMode, [Value::Whole(1), Value::Whole(3)]),
        replies(Parameter::PMax, [Value::Float(12.5); 2]),
        replies(Parameter::VMax, [Value::Float(30.0); 2]),
        replies(Parameter::TMax, [Value::Float(10.0); 2]),
        replies(Parameter::Timeout, [Value::Whole(8000); 2]),
        both(MotorStatus::Disabled),
        step.clone(),
    ]
    .concat();
    let enable = [step.clone(), both(MotorStatus::Enabled), step.clone(), both(MotorStatus::Enabled)].concat();
    let follow = [target(1.0, 0.5), step.clone(), both(MotorStatus::Enabled), step].concat();
    [probe.clone(), record(ARM, 0, [0; 8]), probe, enable, follow.repeat(3)].concat()
}

/// Motors that are here, and are wanted far beyond their limits.
fn beyond(first: f64, second: f64) -> Vec<u8> {
    let joints = [(1, first), (2, second)].map(|(slave, q)| feedback_at(slave, MotorStatus::Enabled, q));
    [target(9.0, 9.0), record(STEP, 10, [0; 8]), joints.concat()].concat()
}

fn feedback(slave: u16, status: MotorStatus) -> Vec<u8> {
    feedback_at(slave, status, 0.5)
}

fn feedback_at(slave: u16, status: MotorStatus, q: f64) -> Vec<u8> {
    let id = slave.to_le_bytes()[0];
    let feedback = Feedback { id, status, q, dq: 0.0, tau: 0.1, mos: 40, rotor: 41 };
    let frame = Ranges::new(12.5, 30.0, 10.0).and_then(|ranges| feedback.encode(0x10 + slave, &ranges));
    frame.map_or_else(Vec::new, |frame| record(FEED, frame.id.to_le_bytes()[0], frame.data))
}

fn target(first: f32, second: f32) -> Vec<u8> {
    let mut data = [0; 8];
    data[..4].copy_from_slice(&first.to_le_bytes());
    data[4..].copy_from_slice(&second.to_le_bytes());
    record(TARGET, 1, data)
}

fn record(what: u8, number: u8, data: [u8; 8]) -> Vec<u8> {
    [&[what, number][..], &data].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_session_reaches_motors_that_follow() {
        let mut now = Stamp(1_000_000_000_000);
        let mut bus = MotorBus::new(&spec(), now);
        let mut states = Vec::new();
        for record in session().chunks_exact(RECORD) {
            let data: [u8; 8] = record[2..].try_into().unwrap();
            match record[0] {
                FEED => bus.feed(&CanFrame::standard(u16::from(record[1]), data), now),
                STEP => {
                    now = now.after(Duration::from_millis(u64::from(record[1])));
                    bus.step(now, |_| {});
                }
                ARM => bus.arm(now),
                _ => {
                    bus.target(&[1.0, 0.5], now.before(Duration::from_millis(1)), now);
                }
            }
            states.push(bus.state());
        }
        assert!(states.contains(&BusState::Disarmed), "{states:?}");
        assert_eq!(states.last(), Some(&BusState::Following), "{states:?}");
    }
}
