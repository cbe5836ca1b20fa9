//! Joints that are driven back into their limits, because it was asked for.

use super::*;

/// Two motors that have answered, the second in this mode and outside its limits of -2 to 2 rad.
fn outside(mode: MotorMode, at: f64) -> World {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT), motor(2, 0x12, mode)]));
    world.run_until(BusState::Disarmed);
    world.sims[1].q = at;
    world.run(2);
    world
}

#[test]
fn a_joint_outside_its_limits_returns_slowly_and_follows_no_action_meanwhile() {
    for (mode, at) in [(MIT, 2.6), (MIT, -2.6), (MotorMode::PositionVelocity, 2.6), (MotorMode::Velocity, -2.6)] {
        let mut world = outside(mode, at);
        world.arm();
        assert!(matches!(world.run_to_fault(), Fault::Strange { motor: 1, what: Strange::Beyond { .. } }));
        world.bus.arm_back(world.now);
        world.arm();
        world.run_until(BusState::Holding);
        assert_eq!(world.notified(Notice::Returning), 1, "{:?}", world.notices);
        let (mut before, begun) = (world.sims[1].q, world.now);
        while world.notified(Notice::Returned) == 0 {
            assert!(world.now.since(begun) < Duration::from_secs(20), "{mode:?}: {}", world.sims[1].q);
            assert!(!world.target(&[0.25, 0.25]), "{mode:?}: an action is followed on the way back");
            world.cycle();
            let moved = world.sims[1].q - before;
            assert!(moved * at <= 0.0 && moved.abs() <= RETURN_SPEED * 0.005 + 1e-3, "{mode:?}: {moved}");
            before = world.sims[1].q;
        }
        // 0.5 rad at 0.1 rad/s.
        assert!(world.now.since(begun) > Duration::from_secs(4), "{:?}", world.now.since(begun));
        assert!(world.sims[1].q.abs() <= 2.1 + 1e-3 && world.bus.is_armed(), "{}", world.sims[1].q);
        assert!((world.sims[0].q - 0.25).abs() < 1e-3, "the other one stays");
    }
}

#[test]
fn a_disarm_ends_the_return_and_the_next_arm_is_refused_again() {
    let mut world = outside(MIT, 2.6);
    world.bus.arm_back(world.now);
    world.arm();
    world.run_until(BusState::Holding);
    world.run(100);
    assert!((2.5..2.6).contains(&world.sims[1].q), "{}", world.sims[1].q);
    world.disarm();
    world.run_until(BusState::Disarmed);
    assert!(!world.sims[1].is_on());
    world.arm();
    assert!(matches!(world.run_to_fault(), Fault::Strange { motor: 1, what: Strange::Beyond { .. } }));
}

#[test]
fn an_arm_that_drives_back_is_an_ordinary_arm_within_the_limits() {
    let mut world = outside(MIT, 1.0);
    world.bus.arm_back(world.now);
    world.arm();
    world.run_until(BusState::Holding);
    world.run(2);
    assert_eq!(world.notified(Notice::Returned), 1);
    assert!(world.target(&[0.25, 1.0]));
}
