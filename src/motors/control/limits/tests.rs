#![expect(clippy::float_cmp, reason = "limits and targets themselves come back, bit for bit")]

use proptest::prelude::*;

use super::*;

#[test]
fn values_beyond_the_range_are_clamped() {
    let mut limits = Limits::new(-1.0, 2.0, 1.0);
    for (target, value, is_beyond) in [
        (0.0, 0.0, false),
        (2.0, 2.0, false),
        (2.1, 2.0, true),
        (1e300, 2.0, true),
        (-1.0, -1.0, false),
        (-9.0, -1.0, true),
    ] {
        assert_eq!(limits.clamp(target), Some(Clamped { value, is_beyond }), "{target}");
    }
    assert_eq!(limits.clamped(), 3);
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        assert_eq!(limits.clamp(bad), None);
    }
    assert_eq!(limits.clamped(), 3);
}

#[test]
fn invalid_limits_allow_only_zero() {
    for (low, high) in [(1.0, -1.0), (f64::NAN, 1.0), (0.0, f64::NAN)] {
        assert_eq!(Limits::new(low, high, 1.0).range(), [0.0, 0.0]);
    }
    for slew in [f64::NAN, -1.0] {
        assert_eq!(Limits::new(-1.0, 1.0, slew).slew(0.0, 1.0, Duration::from_secs(1)), 0.0);
    }
}

#[test]
fn a_joint_beyond_its_range_holds_or_returns() {
    let limits = Limits::new(-1.0, 2.0, 1.0);
    for (before, wanted, next) in
        [(3.0, 4.0, 3.0), (3.0, 0.0, 2.5), (-2.0, -3.0, -2.0), (2.0, 3.0, 2.0), (0.0, 9.0, 0.5)]
    {
        assert_eq!(limits.slew(before, wanted, Duration::from_millis(500)), next);
    }
}

#[test]
fn a_velocity_is_braked_at_the_ends_of_the_positions() {
    let limits = Limits::new(-5.0, 5.0, 2.0);
    let braked = |velocity, position| limits.brake(velocity, position, [-1.0, 1.0]);
    assert_eq!(braked(3.0, -1.0), 8.0_f64.sqrt());
    assert_eq!(braked(3.0, 0.75), 1.0);
    assert_eq!(braked(3.0, 1.0), 0.0);
    assert_eq!(braked(3.0, 1.5), 0.0);
    assert_eq!(braked(-0.5, 1.5), -0.5);
    assert_eq!(braked(-3.0, -0.75), -1.0);
}

#[test]
fn a_braked_joint_stays_within_the_positions() {
    let limits = Limits::new(-5.0, 5.0, 2.0);
    let (mut position, mut velocity) = (0.0, 0.0);
    let step = Duration::from_millis(5);
    for _ in 0..2000 {
        velocity = limits.brake(limits.slew(velocity, 5.0, step), position, [-1.0, 1.0]);
        position += velocity * step.as_secs_f64();
        assert!(position <= 1.0 + 1e-3, "{position}");
    }
    assert!(position > 0.99, "{position}");
}

#[test]
fn a_stiff_joint_is_commanded_near_its_position() {
    assert_eq!(within_torque(3.0, 0.0, 1.0, 2.0), 0.5);
    assert_eq!(within_torque(-3.0, 0.0, 1.0, 2.0), -0.5);
    assert_eq!(within_torque(0.4, 0.0, 1.0, 2.0), 0.4);
    assert_eq!(within_torque(3.0, 0.0, 1.0, 0.0), 3.0);
    assert_eq!(within_torque(3.0, f64::NAN, 1.0, 2.0), 3.0);
}

proptest! {
    #[test]
    fn a_command_never_outruns_its_slew_and_arrives(
        slew in 0.01..100.0, start in -10.0..10.0, wanted in -10.0..10.0, ms in 1_u64..50,
    ) {
        let limits = Limits::new(-10.0, 10.0, slew);
        let passed = Duration::from_millis(ms);
        let steps = (20.0 / (slew * passed.as_secs_f64())).ceil();
        let mut command = start;
        let mut left = steps;
        while left >= 0.0 && command != wanted {
            let next = limits.slew(command, wanted, passed);
            prop_assert!((next - command).abs() <= slew * passed.as_secs_f64() * (1.0 + 1e-9));
            prop_assert!((next - wanted).abs() <= (command - wanted).abs());
            command = next;
            left -= 1.0;
        }
        prop_assert_eq!(command, wanted);
    }
}
