//! A bus of motors allocates nothing from its first cycle on: probing, arming, following actions, faults, disarming.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "what fails here fails a test")]

use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_motors::control::damiao::codec::{Feedback, MotorStatus, Ranges, StateCommand};
use rapid_motors::control::damiao::parameter::{Parameter, Reply, Value};
use rapid_motors::control::motors::{BusState, MotorBus, SAMPLE_VALUES};

use crate::support::allocations::allocations;
use crate::support::motors::motor_spec;

const MOTORS: u16 = 7;

/// What a motor answers, as long as it is well.
fn answer(frame: &CanFrame, enabled: &mut [bool; 8]) -> CanFrame {
    let to_all = frame.id == 0x7ff;
    let slave = if to_all { u16::from(frame.data[0]) } else { u16::try_from(frame.id).unwrap() };
    let master = 0x10 + slave;
    if to_all && frame.data[2] != 0xcc {
        let parameter = Parameter::from_rid(frame.data[3]).unwrap();
        let value = match parameter {
            Parameter::PMax => Value::Float(12.5),
            Parameter::VMax => Value::Float(30.0),
            Parameter::TMax => Value::Float(10.0),
            Parameter::ControlMode => Value::Whole(1),
            _ => Value::Whole(8000),
        };
        return Reply { slave, written: frame.data[2] == 0x55, parameter, value }.encode(master);
    }
    let on = &mut enabled[usize::from(slave)];
    *on = *frame == StateCommand::Enable.frame(slave) || *on && *frame != StateCommand::Disable.frame(slave);
    let status = if *on { MotorStatus::Enabled } else { MotorStatus::Disabled };
    let id = u8::try_from(slave).unwrap();
    let feedback = Feedback { id, status, q: 0.5, dq: 0.0, tau: 0.1, mos: 40, rotor: 41 };
    feedback.encode(master, &Ranges::new(12.5, 30.0, 10.0).unwrap()).unwrap()
}

#[test]
fn a_bus_of_motors_allocates_nothing() {
    let mut now = Stamp(1_000_000_000_000);
    let spec = motor_spec::bus((1..=MOTORS).map(motor_spec::motor).collect());
    let mut bus = MotorBus::new(&spec, now);
    let mut enabled = [false; 8];
    let mut answers = [CanFrame::default(); 2 * MOTORS as usize];
    let mut sample = [0.0; SAMPLE_VALUES * MOTORS as usize];
    let (mut samples, mut followed) = (0, 0);
    let mut stops = 0;
    let allocated = allocations(|| {
        for cycle in 0..2000 {
            now = now.after(Duration::from_millis(5));
            match cycle % 500 {
                50 => bus.arm(now),
                450 => bus.disarm(now),
                at @ 100..400 if at % 20 == 0 => {
                    bus.target(&[1.0, -1.0, 9.0, 0.0, 0.0, 0.0, 0.5], now, now);
                }
                at @ 400..440 => {
                    bus.target(&[f64::NAN; MOTORS as usize], now, now.after(Duration::from_millis(at)));
                }
                _ => {}
            }
            let mut sent = 0;
            bus.step(now, |frame| {
                answers[sent] = answer(&frame, &mut enabled);
                sent += 1;
            });
            // One of them is silent for a while, at the end.
            for frame in answers.iter().take(sent).filter(|frame| frame.id != 0x11 || !(1950..1980).contains(&cycle)) {
                bus.feed(frame, now);
            }
            samples += usize::from(bus.sample(&mut sample).is_some());
            followed += usize::from(bus.state() == BusState::Following);
        }
        stops = bus.stop_frames().count();
    });
    assert_eq!(allocated, 0);
    assert_eq!((stops, bus.counts().faults), (usize::from(MOTORS), 1));
    assert!(samples > 1900 && followed > 1000, "{samples} samples, {followed} cycles of following");
    assert!(bus.counts().lost_notices > 0 || bus.take_notice().is_some());
}
