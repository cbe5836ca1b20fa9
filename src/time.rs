//! Time: capture times on the monotonic clock, and their place on the wall clock.
//!
//! Owns the only code that reads the system's clocks. A [`Stamp`] orders samples; the wall clock, which
//! may be set at any moment, is always derived from it through a [`WallClock`] fixed at one moment.

use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

/// The wall clock was set if it moved by this against the monotonic clock: far more than the error of
/// reading both, and less than any deliberate change.
pub const STEP: Duration = Duration::from_millis(10);
/// Readings of a pair of clocks, at most.
const TRIES: usize = 5;
/// A reading that took no longer is accurate enough.
const QUICK_NS: u64 = 20_000;

/// A moment on `CLOCK_MONOTONIC`, in ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Stamp(pub u64);

impl Stamp {
    /// The moment of the call.
    pub fn now() -> Self {
        Self(read(ClockId::Monotonic))
    }

    /// This moment plus `duration`, saturating.
    #[must_use]
    pub fn after(self, duration: Duration) -> Self {
        Self(self.0.saturating_add(nanoseconds(duration)))
    }

    /// This moment minus `duration`, at least zero.
    #[must_use]
    pub fn before(self, duration: Duration) -> Self {
        Self(self.0.saturating_sub(nanoseconds(duration)))
    }

    /// Time from `earlier` to this moment; zero if `earlier` is in fact later.
    pub const fn since(self, earlier: Self) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}

/// `duration` in ns, saturating after 584 years.
pub fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

/// The wall clock as ns since 1970, at this moment.
pub fn realtime_ns() -> u64 {
    read(ClockId::Realtime)
}

/// A fixed relation between the monotonic and the wall clock, taken once, so that wall-clock times
/// within one episode never step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WallClock {
    offset_ns: i128,
}

impl WallClock {
    /// The present relation.
    pub fn now() -> Self {
        // The monotonic clock is read before and after the wall clock; their mean corresponds to it.
        // A preempted thread makes it inaccurate: the quickest of a few tries counts.
        let look = || {
            let before = read(ClockId::Monotonic);
            let wall = read(ClockId::Realtime);
            let after = read(ClockId::Monotonic);
            (after.saturating_sub(before), i128::from(wall) - i128::from(before.midpoint(after)))
        };
        let mut best = look();
        for _ in 1..TRIES {
            if best.0 <= QUICK_NS {
                break;
            }
            best = best.min(look());
        }
        Self { offset_ns: best.1 }
    }

    /// A relation chosen by the caller: wall ns minus monotonic ns.
    #[cfg(test)]
    pub(crate) const fn with_offset(offset_ns: i128) -> Self {
        Self { offset_ns }
    }

    /// `stamp` on the wall clock, ns since 1970; clamped to what a u64 holds.
    pub fn wall_ns(self, stamp: Stamp) -> u64 {
        u64::try_from((i128::from(stamp.0) + self.offset_ns).max(0)).unwrap_or(u64::MAX)
    }

    /// The stamp of a wall-clock time; clamped to what a u64 holds.
    pub fn stamp(self, wall_ns: u64) -> Stamp {
        Stamp(u64::try_from((i128::from(wall_ns) - self.offset_ns).max(0)).unwrap_or(u64::MAX))
    }
}

/// Notices that the wall clock was set.
///
/// A clock that is slewed (NTP) was not set: the kernel slews both clocks equally, so that
/// their relation stays. It changes when the wall clock is set, and by the time a machine sleeps.
#[derive(Debug, Clone, Copy)]
pub struct ClockWatch(WallClock);

impl ClockWatch {
    /// Steps are counted from `clock`.
    pub const fn new(clock: WallClock) -> Self {
        Self(clock)
    }

    /// By how many ns the wall clock was set since the last step, forward or backward; `None` if by less
    /// than [`STEP`].
    pub fn look(&mut self, now: WallClock) -> Option<i64> {
        let step = now.offset_ns - self.0.offset_ns;
        if step.unsigned_abs() < STEP.as_nanos() {
            return None;
        }
        self.0 = now;
        Some(i64::try_from(step).unwrap_or(if step < 0 { i64::MIN } else { i64::MAX }))
    }
}

/// A wall-clock time in UTC, to the millisecond: `2026-02-05T10:30:00.000Z` (RFC 3339).
pub fn rfc3339(wall_ns: u64) -> String {
    let (year, month, day) = date(wall_ns);
    format!("{year:04}-{month:02}-{day:02}T{}", time_of_day(wall_ns))
}

/// The time of day of a wall-clock time in UTC: `22:13:20.123Z`.
pub fn time_of_day(wall_ns: u64) -> String {
    let ms = wall_ns % NS_PER_DAY / 1_000_000;
    format!("{:02}:{:02}:{:02}.{:03}Z", ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60, ms % 1000)
}

/// Year, month and day of a wall-clock time in UTC.
pub const fn date(wall_ns: u64) -> (u64, u64, u64) {
    civil(wall_ns / NS_PER_DAY)
}

const NS_PER_DAY: u64 = 86_400_000_000_000;

/// Year, month and day of a number of days since 1970-01-01, in the Gregorian calendar.
///
/// The year is counted from March, so that the leap day is its last: then the months before any
/// given one have 153 days for every five of them, and a cycle of 400 years has 146,097 days.
const fn civil(days: u64) -> (u64, u64, u64) {
    // 0000-03-01 is 719,468 days before 1970-01-01.
    let shifted = days + 719_468;
    let (cycle, in_cycle) = (shifted / 146_097, shifted % 146_097);
    let year_of_cycle = (in_cycle - in_cycle / 1460 + in_cycle / 36_524 - in_cycle / 146_096) / 365;
    let in_year = in_cycle - (365 * year_of_cycle + year_of_cycle / 4 - year_of_cycle / 100);
    let from_march = (5 * in_year + 2) / 153;
    let day = in_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    let year = cycle * 400 + year_of_cycle;
    (if month <= 2 { year + 1 } else { year }, month, day)
}

fn read(clock: ClockId) -> u64 {
    let time = clock_gettime(clock);
    // Both clocks count up from a non-negative start: the boot, and 1970.
    u64::try_from(time.tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(time.tv_nsec).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wall_and_monotonic_convert_both_ways() {
        let clock = WallClock::with_offset(1_700_000_000_000_000_000);
        assert_eq!(clock.wall_ns(Stamp(5)), 1_700_000_000_000_000_005);
        assert_eq!(clock.stamp(1_700_000_000_000_000_005), Stamp(5));
        assert_eq!(clock.stamp(3), Stamp(0));
    }

    #[test]
    fn a_clock_step_is_reported_once_and_a_slew_never() {
        const SECOND: i128 = 1_000_000_000;
        let mut watch = ClockWatch::new(WallClock::with_offset(1_700 * SECOND));
        let mut look = |offset| watch.look(WallClock::with_offset(offset));
        assert_eq!(look(1_700 * SECOND + 9_999_999), None);
        assert_eq!(look(1_700 * SECOND - 9_999_999), None);
        assert_eq!(look(5_300 * SECOND), Some(3_600_000_000_000));
        assert_eq!(look(5_300 * SECOND), None);
        assert_eq!(look(5_299 * SECOND), Some(-1_000_000_000));
        // Several small steps are reported once they add up to one of this size.
        assert_eq!(
            [4, 8, 12, 16].map(|ms| look(5_299 * SECOND + ms * 1_000_000)),
            [None, None, Some(12_000_000), None]
        );
        assert_eq!(look(i128::from(u64::MAX)), Some(i64::MAX));
    }

    #[test]
    fn the_clocks_of_this_machine_keep_their_relation() {
        let mut watch = ClockWatch::new(WallClock::now());
        assert_eq!((0..1000).find_map(|_| watch.look(WallClock::now())), None);
    }

    #[test]
    fn dates_match_the_calendar() {
        // Against `date -u -d @SECONDS`.
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00.000Z"),
            (951_782_400, "2000-02-29T00:00:00.000Z"),
            (1_770_287_400, "2026-02-05T10:30:00.000Z"),
            (4_107_542_399, "2100-02-28T23:59:59.000Z"),
            (4_107_542_400, "2100-03-01T00:00:00.000Z"),
        ] {
            assert_eq!(rfc3339(seconds * 1_000_000_000), text);
        }
        assert_eq!(rfc3339(1_770_287_400_250_000_000), "2026-02-05T10:30:00.250Z");
        assert_eq!(time_of_day(1_700_000_000_123_456_789), "22:13:20.123Z");
    }

    #[test]
    fn arithmetic_saturates() {
        assert_eq!(Stamp(5).before(Duration::from_secs(1)), Stamp(0));
        assert_eq!(Stamp(u64::MAX).after(Duration::from_secs(1)), Stamp(u64::MAX));
        assert_eq!(Stamp(1).since(Stamp(9)), Duration::ZERO);
    }
}
