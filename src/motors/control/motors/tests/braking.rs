//! Joints with a brake.

use rapid_core::action::Trip;
use rapid_registry::{Stop, StopSpec};

use super::*;
use world::brake;

/// Two motors, the second of which has a brake and stops in these ways.
fn braked(stop: StopSpec) -> DamiaoSpec {
    let mut spec = spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, MIT)]);
    (spec.motors[1].stop, spec.motors[1].brake) = (stop, Some(brake()));
    spec
}

/// In the same way at any fault and at an emergency stop.
const fn always(stop: Stop) -> StopSpec {
    StopSpec { own_fault: stop, other_fault: stop, emergency: stop, hold_for: None }
}

fn ready(stop: Stop) -> World {
    let mut world = World::new(braked(always(stop)));
    world.run_until(BusState::Disarmed);
    world
}

fn armed(stop: Stop) -> World {
    World::following(braked(always(stop)))
}

const EMERGENCY: Trip = Trip { stop: 0, is_lost: false };

#[test]
fn a_brake_is_released_once_its_motor_is_on_and_no_action_is_followed_before() {
    let mut world = ready(Stop::Limp);
    assert_eq!(world.bus.releases(), 0);
    world.arm();
    let mut released = None;
    while !world.bus.is_armed() {
        world.cycle();
        assert!(world.bus.state() == BusState::Arming || world.bus.is_armed());
        if world.bus.releases() != 0 && released.is_none() {
            assert!(world.sims[1].is_on());
            // What motors without a brake have means nothing.
            released = Some(world.now);
        }
        assert!(!world.target(&[0.5, 0.5]) || world.bus.is_armed());
    }
    let waited = world.now.since(released.expect("it is released"));
    assert!(waited >= brake().releases_in, "{waited:?}");
    world.disarm();
    world.cycle();
    assert_eq!(world.bus.releases(), 0, "a disarm engages it at once");
}

#[test]
fn a_joint_that_stops_by_its_brake_holds_until_the_brake_does_and_is_then_disabled() {
    for trouble in [
        |world: &mut World| world.sims[0].status = MotorStatus::OverCurrent,
        |world: &mut World| world.sims[1].mos = 99,
        |world: &mut World| world.emergency(EMERGENCY),
    ] {
        let mut world = armed(Stop::Brake);
        trouble(&mut world);
        world.cycle();
        world.run_to_fault();
        world.cycle();
        assert_eq!(world.notified(Notice::Kept { damped: 0, held: 0, braked: 2 }), 1, "{:?}", world.notices);
        assert_eq!(world.bus.releases(), 0, "it is engaged at once");
        let (begun, held) = (world.now, world.sims[1].q);
        while world.sims[1].is_on() {
            world.cycle();
            assert!((world.sims[1].q - held).abs() < 1e-3, "it holds");
        }
        let kept = world.now.since(begun);
        assert!(kept >= brake().engages_in && kept <= brake().engages_in + world::CYCLE * 5, "{kept:?}");
    }
}

#[test]
fn a_joint_whose_brake_does_not_engage_keeps_holding() {
    for (is_stuck, hold_for) in [(true, None), (false, None), (false, Some(Duration::from_millis(500)))] {
        let mut world = World::following(braked(StopSpec { hold_for, ..always(Stop::Brake) }));
        // Its chip hangs, or is gone.
        (world.are_brakes_stuck, world.brakes.broken) = (true, if is_stuck { 0 } else { 3 });
        world.emergency(EMERGENCY);
        world.run(80);
        assert!(world.sims[1].is_on() && !world.sims[0].is_on());
        world.run(100);
        assert_eq!(world.sims[1].is_on(), hold_for.is_none());
        world.disarm();
        world.run(5);
        assert!(!world.sims[1].is_on(), "a disarm disables all");
    }
}

#[test]
fn a_brake_that_cannot_be_driven_refuses_an_arm_and_ends_one() {
    let mut world = ready(Stop::Hold);
    world.brakes.broken = 2;
    world.arm();
    assert_eq!(world.run_to_fault(), Fault::Brake { motor: 1 });
    world.brakes.broken = 1;
    world.arm();
    world.run_until(BusState::Holding);
    world.brakes.broken = 2;
    assert_eq!(world.run_to_fault(), Fault::Brake { motor: 1 });
    world.run(10);
    assert!(world.sims[1].is_on() && !world.sims[0].is_on(), "each in its way");
    let text = Fault::Brake { motor: 1 }.words(world.bus.names()).to_string();
    assert_eq!(text, "the brake of motor joint_2 cannot be driven: the log gives the reason");
}

#[test]
fn a_joint_that_has_sunk_is_not_driven_back_up_by_an_emergency_stop() {
    for is_broken in [false, true] {
        let stop = StopSpec { own_fault: Stop::Limp, other_fault: Stop::Damp, emergency: Stop::Brake, hold_for: None };
        let mut world = World::following(braked(stop));
        world.sims[0].status = MotorStatus::OverCurrent;
        world.run_to_fault();
        let before = world.sims[1].q;
        world.sims[1].drift = -1.0;
        world.run(40);
        let sunk = world.sims[1].q;
        assert!(sunk < before - 0.05 && world.sims[1].is_on(), "it sinks: {before} to {sunk}");
        if is_broken {
            (world.are_brakes_stuck, world.brakes.broken) = (true, 2);
        }
        world.emergency(EMERGENCY);
        for _ in 0..60 {
            let last = world.sims[1].q;
            world.cycle();
            assert!(world.sims[1].q <= last + 1e-3, "it goes back up from {last} to {}", world.sims[1].q);
        }
        assert_eq!(world.sims[1].is_on(), is_broken, "its brake holds it, or its motor damps it");
        assert_eq!(world.notified(Notice::NotBraked { motor: 1 }), usize::from(is_broken), "{:?}", world.notices);
    }
}

#[test]
fn the_engaging_time_of_a_brake_counts_from_when_its_state_is_known() {
    let cycles = |limit: Duration| usize::try_from(limit.as_millis() / world::CYCLE.as_millis()).unwrap();
    let engages = cycles(brake().engages_in);
    for trouble in [
        // It was engaged, and an order to release it is on its way.
        |brakes: &mut Brakes| (brakes.moving, brakes.released) = (2, 0),
        // Its chip is gone, and comes back.
        |brakes: &mut Brakes| (brakes.broken, brakes.released) = (2, 0),
    ] {
        let mut world = armed(Stop::Brake);
        world.are_brakes_stuck = true;
        trouble(&mut world.brakes);
        world.emergency(EMERGENCY);
        world.run(engages * 3);
        assert!(world.sims[1].is_on(), "the state of its brake is unknown");
        world.brakes = Brakes::default();
        world.run(engages - 1);
        assert!(world.sims[1].is_on(), "it takes {:?} to engage", brake().engages_in);
        world.run(10);
        assert!(!world.sims[1].is_on());
    }
    // Nor is one released before its line is.
    let mut world = ready(Stop::Brake);
    world.are_brakes_stuck = true;
    world.brakes.moving = 2;
    world.arm();
    world.run(cycles(brake().releases_in) * 2);
    assert_eq!(world.bus.state(), BusState::Arming);
    (world.brakes.moving, world.brakes.released) = (0, 2);
    world.run(cycles(brake().releases_in) - 1);
    assert_eq!(world.bus.state(), BusState::Arming);
    world.run_until(BusState::Holding);
}

#[test]
fn a_brake_that_is_about_to_be_released_is_not_taken_for_engaged() {
    let mut world = ready(Stop::Brake);
    // It has been engaged for long, and its line is not set yet when the motor turns on.
    world.are_brakes_stuck = true;
    world.arm();
    while world.bus.releases() & 2 == 0 {
        world.cycle();
    }
    world.run(3);
    world.emergency(EMERGENCY);
    let begun = world.now;
    while world.sims[1].is_on() {
        world.cycle();
    }
    let kept = world.now.since(begun);
    assert!(kept >= brake().engages_in, "off after {kept:?}");
}

#[test]
fn a_brake_engages_before_the_motor_that_held_its_joint_is_turned_off() {
    let hold_for = Some(Duration::from_millis(400));
    for (stop, hold_for) in [(Stop::Hold, hold_for), (Stop::Hold, Some(Duration::from_millis(10)))] {
        let mut world =
            World::following(braked(StopSpec { own_fault: stop, other_fault: stop, emergency: stop, hold_for }));
        world.emergency(EMERGENCY);
        let mut engaged = None;
        let begun = world.now;
        while world.sims[1].is_on() {
            world.cycle();
            if world.bus.releases() & 2 == 0 {
                engaged.get_or_insert(world.now);
            }
            assert!(world.now.since(begun) < Duration::from_secs(2));
        }
        let before = world.now.since(engaged.expect("it is engaged"));
        assert!(before >= brake().engages_in, "engaged {before:?} before the motor is off");
        let late = world.now.since(begun).saturating_sub(hold_for.unwrap_or_default().max(brake().engages_in));
        assert!(late <= world::CYCLE * 5, "off {late:?} too late");
    }
}

#[test]
fn a_healthy_joint_does_not_fall_because_its_brake_cannot_be_driven() {
    for (other_fault, is_damped) in [(Stop::Hold, 0), (Stop::Damp, 2)] {
        let stop = StopSpec { own_fault: Stop::Limp, other_fault, emergency: Stop::Limp, hold_for: None };
        let mut world = World::following(braked(stop));
        (world.are_brakes_stuck, world.brakes.broken) = (true, 2);
        assert_eq!(world.run_to_fault(), Fault::Brake { motor: 1 });
        world.run(100);
        assert!(world.sims[1].is_on());
        let kept = Notice::Kept { damped: is_damped, held: 2 - is_damped, braked: 0 };
        assert_eq!(world.notified(kept), 1, "{:?}", world.notices);
    }
}

#[test]
fn a_brake_that_is_not_released_refuses_the_arm() {
    let mut world = ready(Stop::Limp);
    world.are_brakes_stuck = true;
    world.arm();
    assert_eq!(world.run_to_fault(), Fault::NotReleased { motor: 1 });
    world.run(5);
    assert!(!world.sims.iter().any(Sim::is_on), "none was armed");
}

#[test]
fn when_the_program_dies_brakes_engage_where_nothing_else_keeps_the_joint() {
    for (stop, engages) in [(Stop::Limp, 2), (Stop::Brake, 2), (Stop::Hold, 0), (Stop::Damp, 0)] {
        let mut world = armed(stop);
        let first = world.bus.engages_at_death();
        assert_eq!(first & 2, engages, "{stop:?}");
        world.disarm();
        world.run(5);
        assert_eq!(world.bus.engages_at_death() & 2, 2, "it is off");
    }
}
