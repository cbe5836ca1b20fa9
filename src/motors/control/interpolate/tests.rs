#![expect(clippy::float_cmp, reason = "limits and targets themselves come back, bit for bit")]

use proptest::prelude::*;

use super::*;

const MS: u64 = 1_000_000;

fn at(ms: u64) -> Stamp {
    Stamp(ms * MS)
}

#[test]
fn a_target_is_reached_when_the_next_is_due() {
    let mut line = Interpolator::new(2);
    line.restart([1.0, -1.0]);
    assert_eq!((line.at(0, at(0)), line.at(1, at(9))), (1.0, -1.0));
    // The time between the first two is not known.
    line.head_for([2.0, -1.0], at(1000), [1.0, -1.0], at(1003));
    for (ms, command) in [(1003, 1.0), (1053, 1.5), (1103, 2.0), (5000, 2.0)] {
        assert_eq!(line.at(0, at(ms)), command);
        assert_eq!(line.at(1, at(ms)), -1.0);
    }
    line.head_for([4.0, 0.0], at(1050), [2.0, -1.0], at(1051));
    assert_eq!(line.period(), Duration::from_millis(50));
    assert_eq!((line.at(0, at(1076)), line.at(1, at(1076))), (3.0, -0.5));
    assert_eq!(line.at(0, at(1101)), 4.0);
    assert_eq!(line.at(2, at(1101)), 0.0);
}

#[test]
fn a_pause_does_not_change_the_rate_and_a_hold_ends_interpolation() {
    let mut line = Interpolator::new(1);
    line.head_for([1.0], at(0), [0.0], at(0));
    line.head_for([1.0], at(50), [0.0], at(50));
    line.head_for([1.0], at(5000), [0.0], at(5000));
    assert_eq!(line.period(), Duration::from_millis(50));
    line.hold([0.25]);
    assert_eq!((line.at(0, at(5001)), line.at(0, at(9000))), (0.25, 0.25));
    assert_eq!((line.period(), line.tick()), (Duration::from_millis(50), Some(at(5000))));
    line.restart([0.5]);
    assert_eq!((line.period(), line.tick()), (FIRST_PERIOD, None));
    // Nor does a shorter one; two of them are a rate, and the first quick one is another.
    for (tick, period) in [(5000, 100), (5900, 100), (6000, 100), (6900, 100), (7800, 900), (8100, 300), (8400, 300)] {
        line.head_for([1.0], at(tick), [0.0], at(tick));
        assert_eq!(line.period(), Duration::from_millis(period), "{tick}");
    }
    line.restart([0.5]);
    // Two at once.
    line.head_for([1.0], at(5000), [0.0], at(5000));
    line.head_for([1.0], at(5000), [0.0], at(5000));
    assert_eq!(line.period(), SHORTEST);
}

proptest! {
    #[test]
    fn interpolation_stays_between_its_targets(
        targets in prop::collection::vec((-10.0..10.0, 0_u64..400), 1..20), steps in 1_u64..20,
    ) {
        let mut line = Interpolator::new(1);
        let (mut now, mut command) = (0, 0.0_f64);
        for (target, later) in targets {
            line.head_for([target], at(now), [command], at(now));
            let (low, high) = (command.min(target), command.max(target));
            let mut before = command;
            for step in 0..=steps {
                command = line.at(0, at(now + later * step / steps));
                prop_assert!((low..=high).contains(&command));
                prop_assert!((command - target).abs() <= (before - target).abs());
                before = command;
            }
            now += later;
        }
    }
}
