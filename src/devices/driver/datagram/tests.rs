use std::time::Duration;

use proptest::prelude::*;

use super::*;

const S: u64 = 1_000_000_000;
const MS: u64 = 1_000_000;
const WALL: i128 = 1_700_000_000_000_000_000;

proptest! {
    /// Datagrams arrive every 10 ms; each waits until a process that is stopped now and then reads it; the wall clock is set
    /// once, by far more than anything waits, forward or back.
    #[test]
    fn a_datagram_keeps_its_age_however_long_it_waits(
        stops in proptest::collection::vec((0_u64..1000, 1_u64..300), 0..4), set in 0_u64..1000,
        by in prop_oneof![-1_000_000_i128..-100, 100_i128..1_000_000],
    ) {
        let arrives = |number: u64| 100 * S + number * 10 * MS;
        let relation = |at: u64| WallClock::with_offset(WALL + if at < arrives(set) { 0 } else { by * i128::from(S) });
        let mut clock = StampClock::new(relation(0), Stamp(90 * S));
        let mut read = 0;
        for number in 0..1000 {
            let arrived = arrives(number);
            read = read.max(arrived + 10_000);
            if let Some((_, steps)) = stops.iter().find(|(stop, _)| *stop == number) {
                read = read.max(arrived + steps * 10 * MS);
            }
            let stamp_ns = relation(arrived).wall_ns(Stamp(arrived));
            let found = clock.convert(stamp_ns, relation(read), Stamp(read));
            prop_assert_eq!(found, Some(Stamp(arrived)), "number {} read at {}", number, read);
        }
    }
}

#[test]
fn a_wall_clock_that_was_set_twice_gives_no_time_and_then_the_next_one() {
    let now = Stamp(100 * S);
    let relation = |seconds: i128| WallClock::with_offset(WALL + seconds * i128::from(S));
    let mut clock = StampClock::new(relation(0), Stamp(90 * S));
    assert_eq!(clock.convert(relation(0).wall_ns(now), relation(0), now), Some(now));
    let next = now.after(Duration::from_millis(10));
    assert_eq!(clock.convert(relation(3600).wall_ns(next), relation(-3600), next), None);
    assert_eq!(clock.convert(relation(-3600).wall_ns(next), relation(-3600), next), Some(next));
}
