//! How motors start: near to where they are, softly, and after every fault that they have latched was reported.

use rapid_registry::MotionSpec;

use super::world::CYCLE;
use super::*;

/// A motor in MIT mode that starts as one does by default, and has answered.
fn ready(slew: f64) -> World {
    let mut motor = motor(1, 0x11, MIT);
    motor.slew = slew;
    motor.motion = MotionSpec::of_slew(slew);
    let mut world = World::new(spec(vec![motor]));
    world.run_until(BusState::Disarmed);
    world
}

#[test]
fn an_arm_is_refused_while_actions_ask_for_a_far_position() {
    for (target, is_far) in [(0.25, false), (0.74, false), (0.76, true), (-1.0, true), (1e9, true)] {
        let mut world = ready(5.0);
        world.target(&[target]);
        world.cycle();
        world.arm();
        world.target(&[target]);
        if is_far {
            let target = if target > 2.0 { 1e9 } else { target };
            let Fault::Far { motor: 0, position, target: asked } = world.run_to_fault() else { panic!("{target}") };
            assert!((position - 0.25).abs() < 1e-3 && (asked - target).abs() < 1e-9);
            assert!(!world.sims[0].is_on());
        } else {
            world.run_until(BusState::Holding);
        }
    }
}

#[test]
fn old_actions_do_not_prevent_an_arm() {
    let mut world = ready(5.0);
    world.target(&[2.0]);
    world.run(100);
    world.arm();
    world.run_until(BusState::Holding);
}

#[test]
fn the_first_action_after_an_arm_is_near_and_the_next_may_be_far() {
    let mut world = ready(5.0);
    world.arm();
    world.run_until(BusState::Holding);
    for _ in 0..5 {
        assert!(!world.target(&[1.5]));
        world.run(10);
    }
    assert_eq!(world.notified(Notice::Refused(Refusal::Far { motor: 0 })), 1, "{:?}", world.notices);
    assert!((world.sims[0].q - 0.25).abs() < 1e-3 && world.bus.state() == BusState::Holding);
    assert!(world.target(&[0.4]));
    world.run(10);
    assert!(world.target(&[1.5]));
    world.run(10);
    assert_eq!(world.bus.state(), BusState::Following);
}

#[test]
fn the_first_motion_is_soft_and_no_motion_jerks() {
    let mut world = ready(2.0);
    world.arm();
    world.run_until(BusState::Holding);
    let (mut before, mut speed, mut fastest) = (world.command(0), 0.0_f64, Vec::new());
    for cycle in 0..600 {
        if cycle % 20 == 0 {
            // It turns round every second.
            world.target(&[if cycle / 200 % 2 == 0 { 0.7 } else { -0.2 }]);
        }
        world.cycle();
        let command = world.command(0);
        let now = (command - before) / CYCLE.as_secs_f64();
        assert!((now - speed).abs() <= 40.0 * CYCLE.as_secs_f64() + 1e-6, "from {speed} to {now} rad/s in a cycle");
        (before, speed) = (command, now);
        fastest.push(now.abs());
    }
    let most = |range: std::ops::Range<usize>| fastest[range].iter().fold(0.0, |most: f64, speed| most.max(*speed));
    assert!(most(0..20) <= 0.2 + 1e-6, "{}", most(0..20));
    assert!(most(200..600) > 1.9, "{}", most(200..600));
}

#[test]
fn a_pause_of_the_actions_stops_the_joint_softly() {
    let mut world = ready(2.0);
    world.arm();
    world.run_until(BusState::Holding);
    for target in [0.5, 0.9, 1.3, 1.7] {
        world.target(&[target]);
        world.run(60);
    }
    world.target(&[-2.0]);
    world.run(25);
    let (before, mut speed) = (world.command(0), -2.0_f64);
    world.run_until(BusState::Holding);
    for _ in 0..40 {
        let last = world.command(0);
        world.cycle();
        let now = (world.command(0) - last) / CYCLE.as_secs_f64();
        assert!((now - speed).abs() <= 40.0 * CYCLE.as_secs_f64() + 0.1, "from {speed} to {now} rad/s");
        speed = now;
    }
    assert!(speed.abs() < 1e-9 && world.command(0) < before);
}

#[test]
fn an_unseen_fault_is_reported_before_arming_clears_it() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]));
    let [lost, hot] = [MotorStatus::CommunicationLost, MotorStatus::MosOverTemperature];
    (world.sims[0].status, world.sims[1].status) = (lost, hot);
    // Before anything is known of them.
    world.arm();
    assert_eq!(world.run_to_fault(), Fault::Latched { motor: 0, status: lost });
    assert_eq!(world.notified(Notice::Latched { motor: 1, status: hot }), 1, "{:?}", world.notices);
    assert_eq!((world.sims[0].status, world.sims[1].status), (lost, hot));
    world.arm();
    world.run_until(BusState::Holding);
    for (motor, status) in [(0, lost), (1, hot)] {
        assert_eq!(world.notified(Notice::Cleared { motor, status }), 1);
    }
}

#[test]
fn a_fault_hidden_by_another_is_reported_as_soon_as_it_is_seen() {
    let mut world = World::armed();
    world.sims[1].silent = true;
    let fault = world.run_to_fault();
    world.sims[1].silent = false;
    world.sims[1].status = MotorStatus::CommunicationLost;
    world.run(3);
    let latched = Notice::Latched { motor: 1, status: MotorStatus::CommunicationLost };
    assert_eq!((world.bus.state(), world.notified(latched)), (BusState::Faulted(fault), 1));
    world.arm();
    world.run_until(BusState::Holding);
}

#[test]
fn leaning_on_a_joint_before_the_first_action_does_not_shorten_its_soft_start() {
    let fastest_after = |push: f64| {
        let mut world = ready(2.0);
        world.spec.motors[0].torque = 1.0;
        let spec = world.spec.clone();
        world = World::new(spec);
        world.run_until(BusState::Disarmed);
        world.arm();
        world.run_until(BusState::Holding);
        world.sims[0].q += push;
        world.run(400);
        let target = world.sims[0].q + 0.4;
        let (mut before, mut fastest) = (world.command(0), 0.0_f64);
        for _ in 0..10 {
            world.target(&[target]);
            world.run(1);
            fastest = fastest.max((world.command(0) - before).abs() / CYCLE.as_secs_f64());
            before = world.command(0);
        }
        fastest
    };
    let [rested, leaned] = [0.0, 0.12].map(fastest_after);
    assert!((rested - leaned).abs() < 0.05 && rested < 0.5, "{rested} and {leaned} rad/s");
}
