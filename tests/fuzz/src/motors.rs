//! Motors: frames that strangers send on their bus, and numbers that strangers want of them.

use std::time::Duration;

use rapid::control::can::CanFrame;
use rapid::control::damiao::codec::{Feedback, MotorStatus, Ranges};
use rapid::control::damiao::parameter::{Parameter, Reply, Value};
use rapid::control::motors::{BusState, MotorBus};
use rapid::registry::{DamiaoSpec, MotorKind, MotorMode, MotorSpec};
use rapid::time::Stamp;

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
/// commanded lies within the limits or where the joint is, and nothing moves before an arm.
pub fn motors(bytes: &[u8]) {
    let spec = spec();
    let mut now = Stamp(1_000_000_000_000);
    let mut bus = MotorBus::new(&spec, now);
    let mut sample = [0.0; 12];
    let mut was_armed = false;
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
            }
            STEP => {
                now = now.after(Duration::from_millis(ms));
                let mut sent = 0;
                bus.step(now, |frame| {
                    assert!(was_armed || is_harmless(&frame), "{frame:x?} before an arm");
                    sent += 1;
                });
                assert!(sent <= 4);
            }
            TARGET => {
                let [a, b, c, d, e, f, g, h] = data;
                let first = f64::from(f32::from_le_bytes([a, b, c, d]));
                let second = f64::from(f32::from_le_bytes([e, f, g, h]));
                let taken = bus.target(&[first, second], now.before(Duration::from_millis(ms)), now);
                assert!(!taken || first.is_finite() && second.is_finite() && bus.is_armed());
            }
            ARM => {
                was_armed = true;
                bus.arm(now);
            }
            _ => bus.disarm(now),
        }
        if bus.sample(&mut sample).is_some() {
            assert!(sample.iter().all(|value| value.is_finite()), "{sample:?}");
        }
        assert!(bus.commands().iter().all(|command| command.is_finite()), "{:?}", bus.commands());
        while let Some(notice) = bus.take_notice() {
            assert!(!notice.words(bus.names()).to_string().is_empty());
        }
    }
    let stops: Vec<CanFrame> = bus.stop_frames().collect();
    assert!(stops.len() == 2 && stops.iter().all(is_harmless));
    assert_eq!(bus.state(), BusState::Stopped);
    bus.step(now, |frame| panic!("{frame:x?} after a stop"));
}

/// Requests for parameters and feedback, and orders to turn off.
fn is_harmless(frame: &CanFrame) -> bool {
    frame.id == 0x7ff || frame.data == [0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xfd]
}

fn spec() -> DamiaoSpec {
    let motor = |slave: u16, mode| MotorSpec {
        name: format!("joint_{slave}"),
        slave,
        master: 0x10 + slave,
        kind: MotorKind::Dm4310,
        mode,
        position: [-2.0, 2.0],
        velocity: 20.0,
        torque: 5.0,
        slew: 5.0,
        max_mos: 80.0,
        max_rotor: 100.0,
    };
    DamiaoSpec {
        motors: vec![motor(1, MotorMode::Mit { kp: 10.0, kd: 1.0 }), motor(2, MotorMode::Velocity)],
        hz: 200,
        deadman: None,
        disable_after: Duration::from_secs(1),
        timeout: Duration::from_millis(400),
        silent_after: Duration::from_millis(50),
    }
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

fn feedback(slave: u16, status: MotorStatus) -> Vec<u8> {
    let id = slave.to_le_bytes()[0];
    let feedback = Feedback { id, status, q: 0.5, dq: 0.0, tau: 0.1, mos: 40, rotor: 41 };
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
    fn the_session_gets_to_motors_that_follow() {
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
