use proptest::prelude::*;

use super::*;

const MS: u64 = 1_000_000;
const S: u64 = 1_000 * MS;

#[test]
fn an_uncertain_time_is_believed_within_its_uncertainty() {
    let uncertainty = Duration::from_millis(20);
    // Capture time, arrival, stamp, and whether it is believed.
    let table = [
        (100 * S, 100 * S, 100 * S, true),
        // Ahead and back by no more than it may be wrong: stamps do not go back.
        (101 * S + 20 * MS, 101 * S, 101 * S + 20 * MS, true),
        (101 * S, 101 * S + 10 * MS, 101 * S + 20 * MS + 1, true),
        // By more.
        (101 * S + 31 * MS, 101 * S + 10 * MS, 101 * S + 20 * MS + 1, false),
        (100 * S + 999 * MS, 101 * S + 40 * MS, 101 * S + 30 * MS, false),
        (101 * S + 50 * MS, 101 * S + 60 * MS, 101 * S + 50 * MS, true),
    ];
    let mut times = CaptureTimes::default();
    for (stated, now, stamp, is_believed) in table {
        let captured = times.judge(Stamp(stated), uncertainty, Stamp(now));
        assert_eq!((captured.at.0, captured.doubt.is_none()), (stamp, is_believed), "{stated} at {now}");
    }
}

proptest! {
    #[test]
    fn a_later_sample_is_never_made_an_earlier_one(
        samples in proptest::collection::vec((any::<u64>(), 0_u64..S, 0_u64..S, 0..4), 1..50),
    ) {
        let mut times = CaptureTimes::default();
        let (mut now, mut newest) = (20 * S, 0);
        for (any, pause, uncertainty, kind) in samples {
            now += pause;
            let stated = match kind {
                0 => any,
                1 => now - any % (12 * S),
                _ => now - any % S,
            };
            let uncertainty = Duration::from_nanos(uncertainty);
            let Captured { at, doubt } = times.judge(Stamp(stated), uncertainty, Stamp(now));
            let moved = at.0.abs_diff(stated);
            prop_assert!(at.0 >= newest && (at <= Stamp(now).after(uncertainty) || at.0 == newest));
            prop_assert!(doubt.is_some() || moved == 0 || at.0 > stated, "{at:?} for {stated}");
            prop_assert!(now.saturating_sub(stated) <= 10 * S || doubt.is_some());
            newest = at.0;
        }
    }
}
