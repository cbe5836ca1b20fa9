//! How far the clock of another computer is from this one, by exchanges of messages.
//!
//! An exchange is a request, sent at `sent` and answered until `received` on this clock, and the time `at` that the other
//! clock had in between. The difference of the clocks is then between `at - received` and `at - sent`, however the delay
//! is divided between the two ways: nothing else is assumed. An older exchange is as good, widened by what the clocks
//! may have drifted since. All of the last seconds hold at once, so that the difference lies in their intersection. Its
//! middle is the offset, and half its width the uncertainty.
//!
//! Invariant: pure: times come in as arguments.
//! Invariant: the newest exchange always counts. Older ones that contradict it (a clock of a computer that was started
//! again, one that is slewed) are left out.

use std::collections::VecDeque;

/// NTP slews a clock by up to 500 parts in a million, and two may be slewed apart; quartz alone is far below that.
const DRIFT_PPM: i128 = 1000;
/// Exchanges that are kept: with four a second those of the last 16 s, in which the clocks drift 16 ms at most.
const KEPT: usize = 64;

/// See the module's comment.
#[derive(Debug, Default)]
pub struct Clock {
    exchanges: VecDeque<Exchange>,
}

/// Bounds of the difference, ns, as they were at a moment of this clock.
#[derive(Debug, Clone, Copy)]
struct Exchange {
    at: u64,
    low: i128,
    high: i128,
}

/// The clock there minus the clock here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Estimate {
    /// ns.
    pub offset_ns: i64,
    /// How far that may be wrong, either way, ns.
    pub uncertainty_ns: u64,
}

impl Clock {
    /// Takes an exchange. One whose answer came before its request is ignored.
    pub fn exchange(&mut self, sent: u64, there: u64, received: u64) {
        if received < sent {
            return;
        }
        if self.exchanges.len() == KEPT {
            self.exchanges.pop_front();
        }
        let (low, high) = (i128::from(there) - i128::from(received), i128::from(there) - i128::from(sent));
        // The other clock was read at some moment of it: the clocks may have drifted since its beginning.
        self.exchanges.push_back(Exchange { at: sent, low, high });
    }

    /// The other computer is gone: when it is back, its clock may be another one.
    pub fn forget(&mut self) {
        self.exchanges.clear();
    }

    /// How many exchanges there were, up to those that are kept.
    pub fn exchanges(&self) -> usize {
        self.exchanges.len()
    }

    /// The estimate at a moment of this clock; `None` before the first exchange.
    pub fn estimate(&self, now: u64) -> Option<Estimate> {
        let mut bounds: Option<(i128, i128)> = None;
        for exchange in self.exchanges.iter().rev() {
            let drift = i128::from(now.saturating_sub(exchange.at)) * DRIFT_PPM / 1_000_000;
            let (low, high) = (exchange.low - drift, exchange.high + drift);
            let (least, most) = bounds.map_or((low, high), |(least, most)| (least.max(low), most.min(high)));
            if least > most {
                break;
            }
            bounds = Some((least, most));
        }
        let (low, high) = bounds?;
        let offset = i64::try_from(low.midpoint(high)).ok()?;
        // Rounded up.
        let uncertainty_ns = u64::try_from((high - low + 1) / 2).ok()?;
        Some(Estimate { offset_ns: offset, uncertainty_ns })
    }
}

impl Estimate {
    /// A time of the clock there on the clock here.
    pub fn here(self, there: u64) -> u64 {
        let here = i128::from(there) - i128::from(self.offset_ns);
        u64::try_from(here.max(0)).unwrap_or(u64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn one_exchange_is_known_to_half_its_duration() {
        let mut clock = Clock::default();
        assert_eq!(clock.estimate(0), None);
        clock.exchange(100 * MS, 5_000 * MS, 110 * MS);
        assert_eq!(
            clock.estimate(110 * MS),
            Some(Estimate { offset_ns: 4_895_000_000, uncertainty_ns: 5 * MS + 10_000 })
        );
        // A second later the clocks may have drifted by 1 ms.
        assert_eq!(clock.estimate(1_110 * MS).map(|known| known.uncertainty_ns), Some(6 * MS + 10_000));
        clock.exchange(9, 0, 8);
        assert_eq!(clock.exchanges(), 1);
        clock.forget();
        assert_eq!(clock.estimate(110 * MS), None);
    }

    #[test]
    fn delays_on_different_ways_bound_it_from_both_sides() {
        let mut clock = Clock::default();
        // The same clock: the first request was late, the second answer.
        clock.exchange(0, 9 * MS, 10 * MS);
        clock.exchange(10 * MS, 11 * MS, 20 * MS);
        let known = clock.estimate(20 * MS).expect("known");
        // 15 us are the drift that there may have been since each began.
        assert!(known.uncertainty_ns <= MS + 15_000 && known.offset_ns.unsigned_abs() < 10_000, "{known:?}");
    }

    #[test]
    fn a_clock_that_begins_again_counts_at_once() {
        let mut clock = Clock::default();
        for number in 0..10 {
            clock.exchange(number * MS, 1_000_000 * MS + number * MS, number * MS + 1000);
        }
        clock.exchange(20 * MS, 7, 21 * MS);
        let known = clock.estimate(21 * MS).expect("known");
        assert_eq!((known.uncertainty_ns, known.here(7)), (MS / 2 + 1000, 20 * MS + MS / 2));
    }

    #[test]
    fn any_times_are_survived() {
        for times in [[0, u64::MAX, 0], [0, 0, u64::MAX], [u64::MAX; 3]] {
            let mut clock = Clock::default();
            let [sent, there, received] = times;
            clock.exchange(sent, there, received);
            if let Some(known) = clock.estimate(u64::MAX) {
                known.here(0);
                known.here(u64::MAX);
            }
        }
    }

    proptest! {
        /// Whatever the delays are, the true difference is within the uncertainty.
        #[test]
        fn the_truth_is_within_the_uncertainty(
            offset in -1_000_000_000_000_i64..1_000_000_000_000,
            drift_ppm in -1000_i64..=1000,
            delays in prop::collection::vec((0_u64..200_000_000, 0_u64..200_000_000), 1..100),
        ) {
            let start = 2_000_000_000_000_u64;
            let there = |here: u64| {
                let drift = (i128::from(here) - i128::from(start)) * i128::from(drift_ppm) / 1_000_000;
                u64::try_from(i128::from(here) + i128::from(offset) + drift).expect("a time")
            };
            let (mut clock, mut now) = (Clock::default(), start);
            for (out, back) in delays {
                clock.exchange(now, there(now + out), now + out + back);
                now += out + back;
                let known = clock.estimate(now).expect("known");
                let truth = i128::from(there(now)) - i128::from(now);
                // Times are whole nanoseconds, each rounded.
                let wrong = (truth - i128::from(known.offset_ns)).unsigned_abs();
                prop_assert!(wrong <= u128::from(known.uncertainty_ns) + 3, "{wrong} of {known:?}");
                now += 250_000_000;
            }
        }
    }
}
