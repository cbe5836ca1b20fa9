//! The phone's clock on ours.
//!
//! What the phone measured at its time `d` arrives here at `a`, some delay later. The least `a - d` of the
//! last seconds is the difference of the clocks but for the shortest delay, which on a local network is a
//! few milliseconds; a delay that is longer than that is thus seen as a delay and not as time, however long it is.
//! Where the phone's clock goes backwards, or is further ahead than any delay explains, it is another session's.
//!
//! Invariant: a stamp is never later than the arrival.

use std::time::Duration;

use crate::time::Stamp;

/// The least difference is looked for over so long, twice: clocks drift apart by some 50 us a second at most.
const WINDOW: Duration = Duration::from_secs(5);
/// A capture time this much before the shortest delay permits is another clock's: the session began anew.
const LEAP_NS: i128 = 1_000_000_000;

#[derive(Debug, Default)]
pub(super) struct Clock {
    /// The least differences of this window and of the one before, ns.
    now: Option<i128>,
    before: Option<i128>,
    since: Stamp,
    /// The phone's newest time, ns.
    newest: i128,
}

impl Clock {
    /// The moment on our clock at which the phone's clock showed `device` s.
    pub(super) fn stamp(&mut self, device: f64, arrived: Stamp) -> Stamp {
        // Beyond 100 years it is no clock.
        if !(0.0..3.2e9).contains(&device) {
            return arrived;
        }
        #[expect(clippy::cast_possible_truncation, reason = "within the range just checked")]
        let device = (device * 1e9) as i128;
        let difference = i128::from(arrived.0) - device;
        if device < self.newest || self.least().is_some_and(|least| difference < least - LEAP_NS) {
            *self = Self::default();
        }
        self.newest = device;
        if self.now.is_none() || arrived.since(self.since) >= WINDOW {
            (self.before, self.now, self.since) = (self.now, None, arrived);
        }
        self.now = Some(self.now.map_or(difference, |now| now.min(difference)));
        let least = self.least().unwrap_or(difference);
        Stamp(u64::try_from(device + least).unwrap_or(arrived.0)).min(arrived)
    }

    fn least(&self) -> Option<i128> {
        self.now.into_iter().chain(self.before).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Differences between stamp and true capture, for delays in ms at 30 frames a second.
    fn errors(delays: &[u64], drift_ppm: i64) -> Vec<i64> {
        let mut clock = Clock::default();
        let errors = delays.iter().zip(1_u64..).map(|(delay, frame)| {
            let captured = 1_000_000_000 + frame * 33_333_333;
            let device = captured as f64 * (1.0 + drift_ppm as f64 / 1e6) / 1e9 + 77.0;
            let stamp = clock.stamp(device, Stamp(captured + delay * 1_000_000));
            stamp.0.cast_signed() - captured.cast_signed()
        });
        errors.collect()
    }

    #[test]
    fn a_late_frame_is_not_a_later_one() {
        let late = errors(&[5, 5, 5, 40, 200, 5, 90], 0);
        assert!(late.iter().all(|error| (error - 5_000_000).abs() < 1000), "{late:?}");
        // What comes at first is late: better is known with the first that is not.
        let first = errors(&[30, 5, 30], 0);
        assert!(first[0] > 29_000_000 && first[2] < 5_100_000, "{first:?}");
    }

    #[test]
    fn what_comes_after_a_stall_is_as_old_as_it_is() {
        // The network stands still for four seconds, and what it held comes at once.
        let stalled = (0..120).map(|frame| 4005 - frame * 1000 / 30);
        let delays: Vec<u64> = [5; 60].into_iter().chain(stalled).chain([5; 30]).collect();
        let errors = errors(&delays, 0);
        let bounds = 4_900_000..40_000_000;
        assert!(errors.iter().all(|error| bounds.contains(error)), "{errors:?}");
    }

    #[test]
    fn a_clock_that_drifts_is_followed() {
        let delays: Vec<u64> = (0..1800).map(|frame| 5 + (frame * 7) % 30).collect();
        for ppm in [-100, 100] {
            let errors = errors(&delays, ppm);
            assert!(errors.iter().skip(30).all(|error| (3_500_000..8_000_000).contains(error)), "{ppm}: {errors:?}");
        }
    }

    #[test]
    fn no_number_breaks_it_and_none_is_later_than_the_arrival() {
        let mut clock = Clock::default();
        for device in [f64::NAN, f64::INFINITY, -1.0, 1e300, 0.0, 12.0, 0.0, 3e9, 5.0] {
            assert!(clock.stamp(device, Stamp(9_000_000_000)) <= Stamp(9_000_000_000), "{device}");
        }
        // The session began anew: its first frame stands at its arrival.
        clock.stamp(100.0, Stamp(10_000_000_000));
        assert_eq!(clock.stamp(5.0, Stamp(11_000_000_000)), Stamp(11_000_000_000));
        // So did this one, whose clock is far ahead.
        assert_eq!(clock.stamp(500.0, Stamp(12_000_000_000)), Stamp(12_000_000_000));
    }
}
