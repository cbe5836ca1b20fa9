//! Motors that turn against their joints, and motors whose zero is not their joint's: their frames are of the motor, and
//! everything else is of the joint.

use proptest::prelude::*;
use rapid_registry::{Mounting, Stop};

use super::*;
use crate::control::damiao::codec::{Feedback, Ranges};

const MOUNTINGS: [Mounting; 3] = [
    Mounting { zero: 1.25, reversed: false },
    Mounting { zero: 0.0, reversed: true },
    Mounting { zero: -2.5, reversed: true },
];
const MODES: [MotorMode; 3] = [MIT, MotorMode::PositionVelocity, MotorMode::Velocity];

/// A motor in this mode and mounted so, and another one.
fn mounted(mode: MotorMode, mounting: Mounting) -> DamiaoSpec {
    let mut spec = spec(vec![motor(1, 0x11, mode), motor(2, 0x12, MIT)]);
    spec.motors[0].mounting = mounting;
    spec
}

/// They have answered.
fn ready(mode: MotorMode, mounting: Mounting) -> World {
    let mut world = World::new(mounted(mode, mounting));
    world.run_until(BusState::Disarmed);
    world
}

fn armed(mode: MotorMode, mounting: Mounting) -> World {
    let mut world = ready(mode, mounting);
    world.arm();
    world.run_until(BusState::Holding);
    world
}

/// What the first motor itself reports.
fn own(world: &World) -> Feedback {
    Feedback::decode(&world.sims[0].feedback().unwrap(), &Ranges::new(12.5, 30.0, 10.0).unwrap()).unwrap()
}

const fn sign(mounting: Mounting) -> f64 {
    if mounting.reversed { -1.0 } else { 1.0 }
}

#[test]
fn actions_and_samples_are_of_the_joint() {
    for mounting in MOUNTINGS {
        for mode in [MIT, MotorMode::PositionVelocity] {
            let mut world = armed(mode, mounting);
            world.sims[0].tau = 0.5;
            let mut sample = [0.0; 12];
            assert!(world.target(&[1.5, 0.25]));
            world.run(10);
            assert!(world.bus.sample(&mut sample).is_some());
            // On the way up, whichever way the motor turns.
            assert!(sample[1] > 0.1 && own(&world).dq * sign(mounting) > 0.1, "{mounting:?}: {sample:?}");
            for _ in 0..10 {
                assert!(world.target(&[1.5, 0.25]));
                world.run(20);
            }
            assert!(world.bus.sample(&mut sample).is_some());
            assert!((sample[0] - 1.5).abs() < 1e-3 && (sample[2] - 0.5).abs() < 0.01, "{mounting:?}: {sample:?}");
            assert!((sample[6] - 0.25).abs() < 1e-3, "the other one stays");
            let own = own(&world);
            assert!((own.q - mounting.zero - sign(mounting) * 1.5).abs() < 1e-3, "{mounting:?}: {own:?}");
            assert!((own.tau - sign(mounting) * 0.5).abs() < 0.01, "{mounting:?}: {own:?}");
        }
    }
}

#[test]
fn a_velocity_ends_at_the_limits_of_the_joint() {
    for mounting in MOUNTINGS {
        for toward in [1.0, -1.0] {
            let mut world = armed(MotorMode::Velocity, mounting);
            for _ in 0..50 {
                assert!(world.target(&[toward, 0.25]));
                world.run(20);
            }
            assert_eq!(world.bus.state(), BusState::Following, "{mounting:?}: {:?}", world.notices);
            let reached = world.sims[0].q * toward;
            assert!((1.95..=2.01).contains(&reached), "{mounting:?}: {reached}");
        }
    }
}

#[test]
fn a_joint_outside_its_limits_is_refused_and_driven_back() {
    for mounting in MOUNTINGS {
        for (mode, at) in [(MIT, 2.6), (MotorMode::PositionVelocity, -2.6), (MotorMode::Velocity, 2.6)] {
            let mut world = ready(mode, mounting);
            world.sims[0].q = at;
            world.run(2);
            world.arm();
            assert!(matches!(world.run_to_fault(), Fault::Strange { motor: 0, what: Strange::Beyond { .. } }));
            world.bus.arm_back(world.now);
            world.arm();
            world.run_until(BusState::Holding);
            let mut cycles = 0;
            while world.notified(Notice::Returned) == 0 {
                assert!(world.sims[0].q.abs() < 2.6 + 1e-3 && cycles < 4000, "{mounting:?}: {}", world.sims[0].q);
                world.cycle();
                cycles += 1;
            }
            assert!((1.99..=2.1 + 1e-3).contains(&world.sims[0].q.abs()), "{mounting:?}: {}", world.sims[0].q);
        }
    }
}

#[test]
fn limits_are_cut_to_what_the_motor_counts() {
    for (reversed, target, used) in [(false, 1.9, 0.5), (true, -1.9, -0.5)] {
        let mut world = World::new(mounted(MIT, Mounting { zero: 1.0, reversed }));
        world.sims[0].ranges = [1.5, 30.0, 10.0];
        world.run_until(BusState::Disarmed);
        world.arm();
        world.run_until(BusState::Holding);
        assert!(world.target(&[target, 0.25]));
        world.cycle();
        assert_eq!(world.notified(Notice::Clamped { motor: 0, target, used }), 1, "{:?}", world.notices);
    }
}

#[test]
fn limits_that_the_motor_does_not_count_are_a_fault() {
    for reversed in [false, true] {
        let mut spec = mounted(MIT, Mounting { zero: -14.0, reversed });
        spec.motors[0].position = [-1.0, 1.0];
        let mut world = World::new(spec);
        world.arm();
        let unusable = Fault::Unusable { motor: 0, parameter: Parameter::PMax, value: Value::Float(12.5) };
        assert_eq!(world.run_to_fault(), unusable);
    }
}

#[test]
fn the_last_frames_are_of_the_motor() {
    for mounting in MOUNTINGS {
        for mode in MODES {
            let mut spec = mounted(mode, mounting);
            spec.motors.iter_mut().for_each(|motor| motor.stop.other_fault = Stop::Hold);
            let world = World::following(spec);
            let frame = world.bus.last_will().unwrap().next().unwrap();
            let held = mounting.zero + sign(mounting) * world.command(0);
            match mode {
                MotorMode::Mit { .. } => {
                    let [a, b, _, d, e, ..] = frame.data;
                    assert_eq!((frame.id, d & 0xf, e), (1, 0, 0), "without stiffness");
                    let damped = f64::from(u16::from_be_bytes([a, b])) / 65_535.0 * 25.0 - 12.5;
                    // Where it was reported, which is a cycle ago.
                    assert!((damped - held).abs() < 0.05, "{mounting:?}: {damped} and {held}");
                }
                MotorMode::PositionVelocity => {
                    let velocity = world.spec.motors[0].velocity;
                    assert_eq!(Ok(frame), codec::position_velocity(1, held, velocity), "{mounting:?}");
                }
                MotorMode::Velocity => assert_eq!((frame.id, frame.data), (0x201, [0; 8]), "{mounting:?}"),
            }
        }
    }
}

proptest! {
    /// What is commanded first is what was reported, to the count: rounding adds up to nothing.
    #[test]
    fn an_arm_moves_no_joint(q in -1.9_f64..1.9, zero in -9.0_f64..9.0, reversed in any::<bool>()) {
        let mut world = ready(MIT, Mounting { zero, reversed });
        world.sims[0].q = q;
        world.run(2);
        let before = world.sims[0].feedback().unwrap().data;
        world.arm();
        world.run_until(BusState::Holding);
        world.run(5);
        let commands: Vec<[u8; 8]> = world.sent.iter().filter(|frame| frame.id == 1).map(|frame| frame.data).collect();
        prop_assert_eq!(commands.len(), 1);
        prop_assert_eq!(&commands[0][..2], &before[1..3]);
        prop_assert_eq!(&world.sims[0].feedback().unwrap().data[1..3], &before[1..3]);
    }
}
