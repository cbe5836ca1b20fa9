//! The machine against simulated motors: what it does by the book, and what it never does, whatever
//! happens.

mod always;
mod arming;
mod braking;
mod following;
mod mounted;
mod returning;
mod starting;
mod stopping;
mod watched;
mod world;

use std::time::Duration;

use rapid_registry::MotorMode;

use super::*;
use crate::control::damiao::codec::{MotorStatus, StateCommand};
use crate::control::damiao::parameter::{Parameter, Value};
use world::{MIT, Sim, World, motor, spec};

#[test]
fn motors_are_queried_configured_and_monitored_without_being_enabled() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]));
    world.sims[1].mode = 3;
    world.sims[1].ranges = [12.5, 30.0, 7.0];
    let mut sample = [0.0; 12];
    assert_eq!(world.bus.sample(&mut sample), None);
    world.run_until(BusState::Disarmed);
    let timeout = |motor| Notice::ParameterSet {
        motor,
        parameter: Parameter::Timeout,
        was: Value::Whole(0),
        is: Value::Whole(8000),
    };
    let mode =
        Notice::ParameterSet { motor: 1, parameter: Parameter::ControlMode, was: Value::Whole(3), is: Value::Whole(1) };
    assert!(
        matches!(
            world.notices[..],
            [set_mode, set_0, Notice::RangesDiffer { motor: 1, shipped: [12.5, 30.0, 10.0], .. } | Notice::ParameterSet { .. }, ..]
            if set_mode == mode && set_0 == timeout(0)
        ),
        "{:?}",
        world.notices
    );
    assert_eq!((world.notified(timeout(0)), world.notified(timeout(1)), world.notified(Notice::Ready)), (1, 1, 1));
    assert_eq!((world.sims[0].timeout, world.sims[1].timeout, world.sims[1].mode), (8000, 8000, 1));
    // From here, a sample each cycle.
    world.run(2);
    world.bus.sample(&mut sample);
    for _ in 0..10 {
        let before = world.now;
        world.cycle();
        assert_eq!(world.bus.sample(&mut sample), Some(world.now));
        assert!(world.now > before && !world.moved());
        assert_eq!(world.bus.sample(&mut sample), None, "nothing new");
        assert_eq!(world.bus.sample(&mut [0.0; 11]), None);
    }
    assert!((sample[0] - 0.25).abs() < 1e-3);
    assert_eq!(sample[3..6], [30.0, 31.0, 0.0]);
}

#[test]
fn a_sample_waits_for_all_motors_and_has_the_time_of_the_oldest() {
    let mut world = World::ready();
    world.run(2);
    let mut sample = [0.0; 12];
    world.bus.sample(&mut sample);
    world.sims[1].silent = true;
    world.cycle();
    // What was on its way has come.
    assert!(world.bus.sample(&mut sample).is_some());
    world.run(3);
    assert_eq!(world.bus.sample(&mut sample), None);
    let first = world.now;
    world.sims[1].silent = false;
    world.run(2);
    assert!(world.bus.sample(&mut sample).is_some_and(|captured| captured > first));
}

#[test]
fn a_motor_that_is_found_enabled_is_disabled() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT)]));
    world.sims[0].status = MotorStatus::Enabled;
    world.run_until(BusState::Disarmed);
    assert!(!world.sims[0].is_on());
    world.run(5);
    world.sims[0].status = MotorStatus::Enabled;
    world.run(3);
    assert!(!world.sims[0].is_on());
    assert_eq!(world.bus.state(), BusState::Disarmed);
}

#[test]
fn unpowered_motors_are_awaited_and_reported_once() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]));
    world.sims[1].silent = true;
    world.run(1000);
    assert_eq!(world.bus.state(), BusState::Probing);
    assert_eq!(world.notified(Notice::Unanswered { motor: 1 }), 1);
    assert_eq!(world.notified(Notice::Unanswered { motor: 0 }), 0);
    world.sims[1].silent = false;
    world.run_until(BusState::Disarmed);
}

#[test]
fn unusable_parameters_are_a_fault() {
    for (ranges, parameter) in [
        ([0.0, 30.0, 10.0], Parameter::PMax),
        ([12.5, f64::NAN, 10.0], Parameter::VMax),
        ([12.5, 30.0, f64::INFINITY], Parameter::TMax),
    ] {
        let mut world = World::new(spec(vec![motor(1, 0x11, MIT)]));
        world.sims[0].ranges = ranges;
        // Its feedback cannot be simulated with such ranges, nor is it needed.
        let mut reported = false;
        for _ in 0..20 {
            world.now = world.now.after(world::CYCLE);
            let mut sent = Vec::new();
            world.bus.step(world.now, |frame| sent.push(frame));
            let off = Sim { ranges: [1.0; 3], ..world.sims[0].clone() };
            for frame in sent {
                let answer = if frame.id == 0x7ff && frame.data[2] != 0xcc {
                    world.sims[0].clone().answer(&frame)
                } else {
                    off.feedback()
                };
                world.bus.feed(&answer.unwrap(), world.now);
            }
            reported |= matches!(world.bus.state(),
                BusState::Faulted(Fault::Unusable { motor: 0, parameter: what, .. }) if what == parameter);
        }
        assert!(reported, "{parameter}: {:?}", world.bus.state());
    }
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT)]));
    world.sims[0].mode = 2;
    world.sims[0].stubborn = true;
    let parameter = Parameter::ControlMode;
    assert_eq!(world.run_to_fault(), Fault::Unusable { motor: 0, parameter, value: Value::Whole(2) });
}

#[test]
fn answers_that_take_several_cycles_are_understood() {
    // A serial adapter may gather answers for 16 ms.
    for latency in 0..5 {
        let mut world = World::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]));
        world.sims.iter_mut().for_each(|sim| sim.mode = 2);
        world.latency = latency;
        world.run_until(BusState::Disarmed);
        world.arm();
        world.run_until(BusState::Holding);
        for _ in 0..20 {
            assert!(world.target(&[1.0, -1.0]));
            world.run(20);
        }
        assert_eq!(world.bus.state(), BusState::Following, "latency {latency}");
        assert!((world.sims[0].q - 1.0).abs() < 1e-3);
        world.disarm();
        world.run_until(BusState::Disarmed);
        world.run(10);
        assert!(!world.sims.iter().any(Sim::is_on));
    }
}

#[test]
fn motors_with_a_shared_feedback_id_are_distinguished() {
    for masters in [[0, 0], [0x11, 0x11], [0x15, 0x16]] {
        let mut world = World::new(spec(vec![motor(5, masters[0], MIT), motor(0x16, masters[1], MIT)]));
        (world.sims[0].q, world.sims[1].q) = (0.5, -0.5);
        world.run_until(BusState::Disarmed);
        world.run(2);
        let mut sample = [0.0; 12];
        assert!(world.bus.sample(&mut sample).is_some());
        assert!((sample[0] - 0.5).abs() < 1e-3 && (sample[6] + 0.5).abs() < 1e-3, "{sample:?}");
    }
}

#[test]
fn frames_of_others_change_nothing_and_are_counted() {
    let mut world = World::ready();
    world.run(2);
    let mut sample = [0.0; 12];
    world.bus.sample(&mut sample);
    let own = world.sims[0].feedback().unwrap();
    let of_other = CanFrame { id: 0x13, ..own };
    let other_number = CanFrame { data: [0x07, 0, 0, 0, 0, 0, 0, 0], ..own };
    // A reply of motor 0x21, whose low bits are those of motor 1.
    let reply = Reply { slave: 0x21, written: false, parameter: Parameter::PMax, value: Value::Float(1.0) };
    for frame in [of_other, other_number, reply.encode(0x11)] {
        world.bus.feed(&frame, world.now);
    }
    assert_eq!(world.bus.counts().strangers, 3);
    for frame in [
        CanFrame { len: 7, ..own },
        CanFrame { extended: true, ..own },
        CanFrame { remote: true, ..own },
        CanFrame { error: true, ..own },
    ] {
        world.bus.feed(&frame, world.now);
    }
    assert_eq!(world.bus.sample(&mut sample), None);
    // An answer to an old question is no position.
    let late = Reply { slave: 1, written: false, parameter: Parameter::PMax, value: Value::Float(3.0) };
    world.bus.feed(&late.encode(0x11), world.now);
    world.run(2);
    assert!(world.bus.sample(&mut sample).is_some());
    assert!((sample[0] - 0.25).abs() < 1e-3);
    assert_eq!(world.bus.state(), BusState::Disarmed);
}

#[test]
fn unread_notices_are_dropped_and_counted() {
    let mut world = World::ready();
    let order = |world: &mut World, times| {
        for _ in 0..times {
            world.arm();
            world.disarm();
        }
    };
    order(&mut world, 50);
    assert_eq!(std::iter::from_fn(|| world.bus.take_notice()).count(), 50, "an arm each");
    order(&mut world, 100);
    assert_eq!(world.bus.counts().lost_notices, 100 - 64);
    assert_eq!(std::iter::from_fn(|| world.bus.take_notice()).count(), 64);
}

#[test]
fn a_notice_names_its_motor() {
    let names = ["shoulder".to_owned(), "elbow".to_owned()];
    let fault = Fault::Hot { motor: 1, part: Part::Mos, celsius: 81.0, limit: 80.0 };
    assert_eq!(fault.words(&names).to_string(), "motor elbow: transistors at 81 °C (limit 80 °C)");
    let notice = Notice::Fault(Fault::Latched { motor: 0, status: MotorStatus::OverCurrent });
    assert_eq!(notice.words(&names).to_string(), "motor shoulder reports over-current: all motors are stopped");
    assert!(notice.is_problem() && !Notice::Armed.is_problem());
    assert_eq!(Fault::Silent { motor: 9 }.words(&names).to_string(), "motor ? does not answer");
}
