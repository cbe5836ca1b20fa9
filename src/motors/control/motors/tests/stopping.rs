//! How joints stop at a fault: each in its way, and none until the next arm in another.

use rapid_core::action::Trip;
use rapid_registry::{Stop, StopSpec};

use super::*;

/// Two motors that are armed, the second of which stops in this way.
fn armed(mode: MotorMode, stop: StopSpec) -> World {
    let mut spec = spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, mode)]);
    spec.motors[1].stop = stop;
    World::following(spec)
}

/// The last command to the second motor.
fn second(world: &World) -> Option<CanFrame> {
    world.sent.iter().copied().find(|frame| [0x2, 0x102, 0x202].contains(&frame.id))
}

const fn others(other_fault: Stop) -> StopSpec {
    StopSpec { own_fault: Stop::Limp, other_fault, emergency: Stop::Limp, hold_for: None }
}

#[test]
fn by_default_a_faulty_joint_is_limp_and_the_others_are_damped() {
    assert_eq!(StopSpec::default(), others(Stop::Damp));
    for trouble in [
        |sim: &mut Sim| sim.silent = true,
        |sim: &mut Sim| sim.status = MotorStatus::OverCurrent,
        |sim: &mut Sim| sim.mos = 99,
    ] {
        let mut world = armed(MIT, StopSpec::default());
        trouble(&mut world.sims[0]);
        let fault = world.run_to_fault();
        assert_eq!(fault.motor(), Some(0));
        assert_eq!(world.notified(Notice::Kept { damped: 2, held: 0, braked: 0 }), 1, "{:?}", world.notices);
        // No action moves it, however long it is kept so.
        for _ in 0..20 {
            assert!(!world.target(&[1.0, 1.0]));
            world.run(50);
            let frame = second(&world).expect("it is damped");
            let kp = u16::from_be_bytes([frame.data[3] & 0xf, frame.data[4]]);
            let kd = u16::from_be_bytes([frame.data[5], frame.data[6]]) >> 4;
            assert_eq!((kp, kd), (0, 819), "{frame:x?}: 1 Nm s/rad of 5, in 12 bits");
            assert!(world.sims[1].is_on() && world.bus.state() == BusState::Faulted(fault));
        }
        world.disarm();
        world.run(5);
        assert!(!world.sims[1].is_on() && second(&world).is_none_or(|frame| frame == StateCommand::Disable.frame(2)));
    }
}

#[test]
fn a_joint_that_holds_stays_at_its_command_for_the_configured_time() {
    for (hold_for, is_on) in
        [(None, true), (Some(Duration::from_millis(900)), true), (Some(Duration::from_millis(500)), false)]
    {
        for mode in [MIT, MotorMode::PositionVelocity] {
            let mut world = armed(mode, StopSpec { hold_for, ..others(Stop::Hold) });
            world.sims[0].status = MotorStatus::OverCurrent;
            world.run_to_fault();
            world.run(2);
            let held = world.sims[1].q;
            world.run(140);
            assert_eq!(world.sims[1].is_on(), is_on, "{hold_for:?}");
            assert!((world.sims[1].q - held).abs() < 1e-3, "{} and not {held}", world.sims[1].q);
        }
    }
}

#[test]
fn motors_that_run_their_own_loop_hold_where_others_are_damped() {
    for (mode, id) in [(MotorMode::PositionVelocity, 0x102), (MotorMode::Velocity, 0x202)] {
        let mut world = armed(mode, others(Stop::Damp));
        world.sims[0].status = MotorStatus::OverCurrent;
        world.run_to_fault();
        world.run(20);
        let frame = second(&world).expect("a command");
        assert_eq!(frame.id, id);
        assert!(mode != MotorMode::Velocity || frame.data == [0; 8], "{frame:x?}");
        let before = world.sims[1].q;
        world.run(50);
        assert!((world.sims[1].q - before).abs() < 1e-3);
    }
}

#[test]
fn a_kept_joint_with_its_own_fault_is_disabled() {
    for trouble in [
        |sim: &mut Sim| sim.silent = true,
        |sim: &mut Sim| sim.status = MotorStatus::OverCurrent,
        |sim: &mut Sim| sim.rotor = 120,
    ] {
        let mut world = armed(MIT, others(Stop::Hold));
        world.sims[0].status = MotorStatus::OverCurrent;
        let first = world.run_to_fault();
        world.run(10);
        trouble(&mut world.sims[1]);
        world.run(40);
        assert!(second(&world).is_none_or(|frame| frame == StateCommand::Disable.frame(2)), "{:x?}", second(&world));
        assert_eq!(world.bus.state(), BusState::Faulted(first), "the first fault is reported");
    }
}

#[test]
fn an_overheated_joint_stops_as_configured_and_is_reported_once() {
    for (own_fault, is_on) in [(Stop::Limp, false), (Stop::Damp, true), (Stop::Hold, true)] {
        let mut world = armed(MIT, StopSpec { own_fault, ..others(Stop::Limp) });
        world.sims[1].mos = 99;
        let fault = world.run_to_fault();
        world.run(100);
        assert_eq!(world.sims[1].is_on(), is_on, "{own_fault:?}");
        assert_eq!((world.notified(Notice::Fault(fault)), world.bus.counts().faults), (1, 1));
    }
}

#[test]
fn an_arm_takes_over_kept_joints() {
    let mut world = armed(MIT, StopSpec::default());
    world.sims[0].status = MotorStatus::OverCurrent;
    world.run_to_fault();
    world.run(100);
    world.arm();
    world.run_until(BusState::Holding);
    assert!(world.target(&[0.6, 0.6]));
    world.run(30);
    assert!((world.sims[1].q - 0.6).abs() < 1e-3);
}

const TRIP: Trip = Trip { stop: 1, is_lost: false };

fn emergency(world: &mut World) {
    world.emergency(TRIP);
}

#[test]
fn at_an_emergency_stop_each_joint_stops_as_configured_in_the_next_cycle() {
    for (way, damped, held) in [(Stop::Limp, 0, 0), (Stop::Damp, 2, 0), (Stop::Hold, 0, 2)] {
        let mut world = armed(MIT, StopSpec { emergency: way, ..StopSpec::default() });
        emergency(&mut world);
        world.cycle();
        assert_eq!(world.bus.state(), BusState::Faulted(Fault::EmergencyStop(TRIP)));
        let disabled = StateCommand::Disable.frame(1);
        assert!(world.sent.contains(&disabled), "the first is limp: {:x?}", world.sent);
        assert_eq!(world.notified(Notice::Kept { damped, held, braked: 0 }), usize::from(damped | held != 0));
        // Pressed again, or lost meanwhile: that is the same stop.
        emergency(&mut world);
        assert!(!world.target(&[1.0, 1.0]));
        world.run(200);
        assert_eq!((world.sims[0].is_on(), world.sims[1].is_on()), (false, way != Stop::Limp));
        assert_eq!(world.notified(Notice::Fault(Fault::EmergencyStop(TRIP))), 1, "{:?}", world.notices);
        // A disarm turns off what is held, an arm begins again.
        world.disarm();
        world.run(5);
        assert!(!world.sims[1].is_on());
        world.arm();
        world.run_until(BusState::Holding);
        assert!(world.target(&[0.6, 0.6]));
    }
}

#[test]
fn an_emergency_stop_is_named() {
    let mut world = armed(MIT, StopSpec::default());
    emergency(&mut world);
    world.cycle();
    let fault = world.run_to_fault();
    assert_eq!(fault.motor(), None);
    let stops = ["door".into(), "pendant".into()];
    let text = |trip| Notice::Fault(Fault::EmergencyStop(trip)).words(&[]).with_stops(&stops).to_string();
    assert_eq!(text(TRIP), "emergency stop pendant pressed: all motors are stopped");
    assert_eq!(text(Trip { stop: 0, is_lost: true }), "emergency stop door lost: all motors are stopped");
}

#[test]
fn an_emergency_stop_ends_an_arm_and_stops_joints_that_a_fault_left_on() {
    let mut world = World::ready();
    // Nothing is on: there is nothing to stop.
    emergency(&mut world);
    world.run(20);
    assert_eq!(world.bus.state(), BusState::Disarmed);
    world.arm();
    world.cycle();
    emergency(&mut world);
    world.run(100);
    assert_eq!(world.bus.state(), BusState::Faulted(Fault::EmergencyStop(TRIP)));
    assert!(world.sims.iter().all(|sim| !sim.is_on()));

    for (way, is_on) in [(Stop::Limp, false), (Stop::Damp, true), (Stop::Hold, true)] {
        let mut world = armed(MIT, StopSpec { emergency: way, ..others(Stop::Hold) });
        world.sims[0].status = MotorStatus::OverCurrent;
        world.run_to_fault();
        world.run(20);
        emergency(&mut world);
        world.run(20);
        assert_eq!(world.bus.state(), BusState::Faulted(Fault::EmergencyStop(TRIP)));
        assert_eq!(world.sims[1].is_on(), is_on, "{way:?}");
        let kp = second(&world).map_or(0, |frame| u16::from_be_bytes([frame.data[3] & 0xf, frame.data[4]]));
        assert!(way != Stop::Damp || kp == 0, "it holds no more than it is to");
    }
}

#[test]
fn one_damaged_frame_does_not_drop_a_joint_that_is_to_be_kept() {
    for (own_fault, is_on) in [(Stop::Limp, false), (Stop::Damp, true), (Stop::Hold, true)] {
        let mut world = armed(MIT, StopSpec { own_fault, ..others(Stop::Limp) });
        let damaged = |world: &mut World| {
            let mut frame = world.sims[1].feedback().unwrap();
            frame.data[0] = frame.data[0] & 0xf | 0xa0;
            world.feed(&frame, world.now);
        };
        damaged(&mut world);
        world.cycle();
        let fault = Fault::Latched { motor: 1, status: MotorStatus::OverCurrent };
        assert_eq!(world.bus.state(), BusState::Faulted(fault));
        world.run(10);
        assert_eq!(world.sims[1].is_on(), is_on, "{own_fault:?}");
        // Nor is one that is kept let go for it.
        damaged(&mut world);
        world.run(10);
        assert_eq!(world.sims[1].is_on(), is_on, "{own_fault:?}");
        // Two in a row are no accident.
        damaged(&mut world);
        damaged(&mut world);
        world.run(10);
        assert!(!world.sims[1].is_on());
    }
}

#[test]
fn a_frame_with_an_impossible_position_is_ignored() {
    let mut world = armed(MIT, others(Stop::Limp));
    let mut frame = world.sims[1].feedback().unwrap();
    (frame.data[0], frame.data[1]) = (frame.data[0] & 0xf | 0xa0, 0xff);
    world.feed(&frame, world.now);
    world.run(5);
    assert_eq!(world.bus.state(), BusState::Following);
}
