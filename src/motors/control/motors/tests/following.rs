//! Actions: followed, refused, missed.

use super::*;

/// Ten actions a second.
const PERIOD: usize = 20;

#[test]
fn an_action_is_reached_when_the_next_is_due() {
    let mut world = World::armed();
    world.target(&[0.25, 0.25]);
    world.run(PERIOD);
    assert_eq!((world.bus.state(), world.notified(Notice::Following)), (BusState::Following, 1));
    // 0.4 rad in 100 ms: 4 rad/s, below the slew limit of 5 rad/s.
    assert!(world.target(&[0.65, 0.05]));
    world.run(PERIOD / 2);
    assert!((world.sims[0].q - 0.45).abs() < 0.03, "{}", world.sims[0].q);
    assert!((world.sims[1].q - 0.15).abs() < 0.03, "{}", world.sims[1].q);
    world.run(PERIOD / 2);
    assert!((world.sims[0].q - 0.65).abs() < 1e-3, "{}", world.sims[0].q);
    world.run(10);
    assert!((world.sims[0].q - 0.65).abs() < 1e-3, "{}", world.sims[0].q);
    assert_eq!(world.bus.counts().actions, 2);
}

#[test]
fn a_jump_takes_as_long_as_the_slew_limit_requires() {
    let mut world = World::armed();
    let mut cycles = 0;
    while world.sims[0].q < 1.75 - 1e-3 {
        if cycles % PERIOD == 0 {
            assert!(world.target(&[1.75, 0.25]));
        }
        world.cycle();
        cycles += 1;
        assert!(cycles < 1000, "{}", world.sims[0].q);
    }
    // 1.5 rad at 5 rad/s, in cycles of 5 ms.
    assert!((60..=63).contains(&cycles), "{cycles}");
}

#[test]
fn a_late_step_causes_no_jump() {
    let mut world = World::armed();
    world.target(&[2.0, 0.25]);
    world.cycle();
    let before = world.sims[0].q;
    // The program was held up, not the motors.
    world.now = world.now.after(Duration::from_millis(40));
    world.cycle();
    assert!(world.sims[0].q - before <= 5.0 * 0.010 + 1e-3, "{}", world.sims[0].q - before);
    assert_eq!(world.bus.state(), BusState::Following);
}

#[test]
fn targets_beyond_the_limits_are_clamped() {
    let mut world = World::armed();
    for _ in 0..10 {
        world.target(&[7.0, -1e9]);
        world.run(PERIOD);
    }
    assert!((world.sims[0].q - 2.0).abs() < 1e-3 && (world.sims[1].q + 2.0).abs() < 1e-3);
    assert_eq!(world.notified(Notice::Clamped { motor: 0, target: 7.0, used: 2.0 }), 1);
    assert_eq!(world.notified(Notice::Clamped { motor: 1, target: -1e9, used: -2.0 }), 1);
    assert_eq!(world.bus.counts().clamped, 20);
}

#[test]
fn limits_beyond_the_range_of_the_motor_are_cut_to_it() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MIT)]));
    world.sims[0].ranges = [1.5, 30.0, 10.0];
    world.run_until(BusState::Disarmed);
    world.arm();
    world.run_until(BusState::Holding);
    world.target(&[1.9]);
    world.cycle();
    assert_eq!(world.notified(Notice::Clamped { motor: 0, target: 1.9, used: 1.5 }), 1);
}

#[test]
fn actions_that_cannot_be_followed_move_nothing_and_do_not_feed_the_deadman() {
    let long_ago = Duration::from_millis(200);
    for (refusal, target, tick) in [
        (Refusal::Length, &[1.0][..], 0_i64),
        (Refusal::Length, &[1.0, 1.0, 1.0], 0),
        (Refusal::NotFinite, &[1.0, f64::NAN], 0),
        (Refusal::NotFinite, &[f64::INFINITY, 1.0], 0),
        (Refusal::Early, &[1.0, 1.0], 101),
        (Refusal::Old, &[1.0, 1.0], -200),
    ] {
        let mut world = World::armed();
        world.run(100);
        for _ in 0..PERIOD * 12 {
            let tick = if tick < 0 {
                world.now.before(long_ago)
            } else {
                world.now.after(Duration::from_millis(tick.unsigned_abs()))
            };
            assert!(!world.bus.target(target, tick, world.now));
            world.cycle();
        }
        assert_eq!(world.notified(Notice::Refused(refusal)), 1);
        assert_eq!(world.bus.counts().refused, 12 * PERIOD as u64);
        assert!((world.sims[0].q - 0.25).abs() < 1e-3);
        assert_eq!(world.bus.state(), BusState::Disarmed, "{refusal:?}");
    }
}

#[test]
fn an_action_older_than_the_arm_or_than_another_action_is_not_followed() {
    let mut world = World::ready();
    world.arm();
    let tick = world.now;
    world.run_until(BusState::Holding);
    assert!(!world.bus.target(&[1.0, 1.0], tick, world.now));
    assert_eq!(world.bus.state(), BusState::Holding);
    let tick = world.now;
    assert!(world.bus.target(&[1.0, 1.0], tick, world.now));
    world.cycle();
    assert!(!world.bus.target(&[1.5, 1.5], tick, world.now));
    assert!(!world.bus.target(&[1.5, 1.5], tick.before(Duration::from_millis(1)), world.now));
    // Nor one from before a disarm.
    world.disarm();
    world.arm();
    world.run_until(BusState::Holding);
    world.run(60);
    assert!((world.sims[0].q - world.sims[0].command.unwrap().1).abs() < 1e-9);
    assert_eq!(world.bus.state(), BusState::Holding);
    assert!(world.sims[0].q < 0.5, "{}", world.sims[0].q);
}

#[test]
fn without_actions_motors_hold_and_are_then_disabled() {
    for (configured, cycles) in [(None, 2 * PERIOD), (Some(Duration::from_millis(50)), 10)] {
        let mut spec = spec(vec![motor(1, 0x11, MIT)]);
        spec.deadman = configured;
        let mut world = World::new(spec);
        world.arm();
        world.run_until(BusState::Holding);
        world.target(&[2.0]);
        world.run(cycles - 1);
        assert_eq!(world.bus.state(), BusState::Following);
        world.cycle();
        assert_eq!((world.bus.state(), world.notified(Notice::Holding)), (BusState::Holding, 1));
        let held = world.sims[0].q;
        world.run(30);
        assert!((world.sims[0].q - held).abs() < 1e-3);
        // An action moves them again.
        assert!(world.target(&[0.25]));
        assert_eq!(world.bus.state(), BusState::Following);
        world.run(cycles + 199);
        assert_eq!(world.bus.state(), BusState::Holding);
        world.run_until(BusState::Disarmed);
        assert_eq!(world.notified(Notice::Disabled(Reason::Deadman)), 1);
        assert!(!world.target(&[1.0]));
        world.run(20);
        assert!(!world.moved());
    }
}

#[test]
fn the_time_until_a_hold_counts_from_the_tick_of_a_delayed_action() {
    let mut world = World::armed();
    world.run(40);
    let tick = world.now.before(Duration::from_millis(150));
    assert!(world.bus.target(&[0.5, 0.5], tick, world.now));
    world.run(9);
    assert_eq!(world.bus.state(), BusState::Following);
    world.cycle();
    assert_eq!(world.bus.state(), BusState::Holding, "200 ms after its tick");
}

#[test]
fn the_rate_of_actions_before_a_disarm_is_forgotten() {
    let mut world = World::armed();
    for _ in 0..5 {
        assert!(world.target(&[0.5, 0.5]));
        world.run(2);
    }
    world.disarm();
    world.run(100);
    world.arm();
    world.run_until(BusState::Holding);
    world.run(150);
    assert!(world.target(&[0.5, 0.5]));
    world.run(39);
    assert_eq!(world.bus.state(), BusState::Following, "two actions 10 ms apart do not change the rate of these");
}

#[test]
fn an_arm_without_an_action_does_not_last() {
    let mut world = World::armed();
    world.run(199);
    assert!(world.bus.is_armed());
    world.run_until(BusState::Disarmed);
    assert_eq!(world.notified(Notice::Disabled(Reason::Deadman)), 1);
}

#[test]
fn a_joint_that_is_held_back_is_pushed_no_harder_than_the_torque_limit() {
    let mut stiff = motor(1, 0x11, MotorMode::Mit { kp: 20.0, kd: 1.0 });
    stiff.torque = 4.0;
    let mut world = World::new(spec(vec![stiff]));
    world.run_until(BusState::Disarmed);
    world.sims[0].stuck = true;
    world.arm();
    world.run_until(BusState::Holding);
    for _ in 0..5 {
        world.target(&[2.0]);
        world.run(PERIOD);
    }
    let pushed = world.sims[0].command.unwrap().1;
    assert!((pushed - 0.45).abs() < 1e-3, "{pushed}: 4 Nm at 20 Nm/rad are 0.2 rad");
    // Released, it continues at the slew limit from there.
    world.sims[0].stuck = false;
    world.target(&[2.0]);
    world.cycle();
    assert!(world.sims[0].q - pushed <= 5.0 * 0.005 + 1e-3);
    // Pushed away, it yields, no faster than it may move, and with no more torque at any moment: the judge looks.
    world.sims[0].stuck = true;
    for _ in 0..60 {
        world.sims[0].q -= 0.02;
        world.cycle();
    }
    world.run(10);
    let pushed = world.sims[0].command.unwrap().1;
    assert!((pushed - world.sims[0].q - 0.2).abs() < 1e-3, "{pushed}");
}

#[test]
fn the_motors_own_modes_have_their_own_frames() {
    let mut world =
        World::new(spec(vec![motor(1, 0x11, MotorMode::PositionVelocity), motor(2, 0x12, MotorMode::Velocity)]));
    world.run_until(BusState::Disarmed);
    assert_eq!((world.sims[0].mode, world.sims[1].mode), (2, 3));
    world.sims[1].q = 1.0;
    world.run(2);
    world.arm();
    world.run_until(BusState::Holding);
    assert_eq!(world.sims[1].command, Some((0x202, 0.0)));
    for _ in 0..3 {
        world.target(&[1.0, 1.5]);
        world.run(PERIOD);
    }
    assert!((world.sims[0].q - 1.0).abs() < 1e-3);
    assert!(world.sent.iter().any(|frame| frame.id == 0x101 && frame.data[4..] == 20.0_f32.to_le_bytes()));
    assert_eq!(world.sims[1].command, Some((0x202, 1.5)));
    // It comes to rest at the end of its positions, and without actions.
    for _ in 0..20 {
        world.target(&[1.0, 1.5]);
        world.run(PERIOD);
    }
    assert!((world.sims[1].q - 2.0).abs() < 0.01, "{}", world.sims[1].q);
    for _ in 0..3 {
        world.target(&[1.0, -1.5]);
        world.run(PERIOD);
    }
    world.run(150);
    assert_eq!(world.bus.state(), BusState::Holding);
    assert_eq!(world.sims[1].command, Some((0x202, 0.0)));
}

#[test]
fn one_pause_does_not_extend_the_patience_of_the_deadman() {
    let mut world = World::armed();
    for _ in 0..5 {
        assert!(world.target(&[0.5, 0.5]));
        world.run(PERIOD);
    }
    // 0.9 s in all, within which it held.
    world.run(8 * PERIOD);
    assert_eq!(world.bus.state(), BusState::Holding);
    assert!(world.target(&[1.0, 1.0]));
    world.run(2 * PERIOD - 1);
    assert_eq!(world.bus.state(), BusState::Following);
    world.cycle();
    assert_eq!(world.bus.state(), BusState::Holding, "200 ms after the last action");
}

#[test]
fn a_slow_publisher_is_detected_by_the_second_action() {
    let mut world = World::armed();
    for _ in 0..3 {
        assert!(world.target(&[0.5, 0.5]));
        world.run(5 * PERIOD);
    }
    assert!(world.target(&[0.5, 0.5]));
    world.run(10 * PERIOD - 1);
    assert_eq!(world.bus.state(), BusState::Following, "two actions a second are awaited for a second");
}

#[test]
fn two_actions_at_once_do_not_end_following() {
    let mut world = World::armed();
    world.run(20);
    let way = Duration::from_millis(12);
    for ms in [1, 0] {
        let tick = world.now.before(Duration::from_millis(ms));
        assert!(world.bus.target(&[0.5, 0.5], tick, world.now));
    }
    for _ in 0..10 {
        world.run(4);
        let tick = world.now.before(way);
        assert!(world.bus.target(&[0.5, 0.5], tick, world.now), "12 ms on its way is not too old");
    }
}

#[test]
fn a_velocity_comes_to_rest_at_the_end_of_the_range_of_the_motor() {
    let mut world = World::new(spec(vec![motor(1, 0x11, MotorMode::Velocity)]));
    world.sims[0].ranges = [1.0, 30.0, 10.0];
    world.run_until(BusState::Disarmed);
    world.arm();
    world.run_until(BusState::Holding);
    for _ in 0..20 {
        world.target(&[1.5]);
        world.run(PERIOD);
    }
    assert!((world.sims[0].q - 1.0).abs() < 0.01, "{}", world.sims[0].q);
}

#[test]
fn intermittent_conditions_are_reported_once_a_second() {
    let mut world = World::armed();
    for round in 0..400 {
        // Beyond its limits and not, and refused for one reason and another.
        let target = [[7.0, 0.25], [f64::NAN, 0.25], [0.5, 0.25]][round % 3];
        world.target(&target);
        world.bus.target(&[1.0], world.now, world.now);
        world.cycle();
    }
    let reported = |is: &dyn Fn(&Notice) -> bool| world.notices.iter().filter(|notice| is(notice)).count();
    let clamped = reported(&|notice| matches!(notice, Notice::Clamped { .. }));
    let refused = reported(&|notice| matches!(notice, Notice::Refused(_)));
    assert!((2..=3).contains(&clamped) && (2..=3).contains(&refused), "{clamped} and {refused} in two seconds");
}

#[test]
fn a_condition_within_a_second_of_the_last_report_is_reported_if_it_lasts() {
    let mut world = World::armed();
    world.target(&[7.0, 0.25]);
    world.run(20);
    world.target(&[1.0, 0.25]);
    for _ in 0..20 {
        world.run(20);
        world.target(&[8.0, 0.25]);
    }
    assert_eq!(world.notified(Notice::Clamped { motor: 0, target: 8.0, used: 2.0 }), 1, "{:?}", world.notices);
}
