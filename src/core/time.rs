//! Time: capture times on the monotonic clock, and their place on the wall clock.
//!
//! Owns the only code that reads the system's clocks, and the only use of the calendar and of time zones. A [`Stamp`] orders samples; the wall clock, which
//! may be set at any moment, is always derived from it through a [`WallClock`] fixed at one moment.

use std::time::Duration;

use jiff::tz::TimeZone;
use jiff::{Timestamp, ZonedDateTime, civil};
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

    /// A relation chosen by the caller, for tests: wall ns minus monotonic ns.
    pub const fn with_offset(offset_ns: i128) -> Self {
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
    pub fn detect_step(&mut self, now: WallClock) -> Option<i64> {
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
    timestamp(wall_ns).strftime("%Y-%m-%dT%H:%M:%S.%3fZ").to_string()
}

/// The time of day of a wall-clock time in UTC: `22:13:20.123Z`.
pub fn time_of_day(wall_ns: u64) -> String {
    timestamp(wall_ns).strftime("%H:%M:%S.%3fZ").to_string()
}

/// The day of a wall-clock time in UTC: `20260205`.
pub fn compact_date(wall_ns: u64) -> String {
    timestamp(wall_ns).strftime("%Y%m%d").to_string()
}

/// Every number is a time: the last of 64 bits is in the year 2554.
fn timestamp(wall_ns: u64) -> Timestamp {
    Timestamp::from_nanosecond(i128::from(wall_ns)).unwrap_or(Timestamp::MAX)
}

/// The zone in which people read times. Files and JSON are always in UTC.
#[derive(Debug, Clone)]
pub struct Zone(TimeZone);

impl Zone {
    /// Universal time.
    pub const UTC: Self = Self(TimeZone::UTC);

    /// That of this machine (`TZ`, else `/etc/localtime`); UTC where neither is readable.
    pub fn local() -> Self {
        Self(TimeZone::try_system().unwrap_or(TimeZone::UTC))
    }

    /// Day and minute: `2026-02-05 11:30`.
    pub fn minute(&self, wall_ns: u64) -> String {
        self.zoned(wall_ns).strftime("%Y-%m-%d %H:%M").to_string()
    }

    /// The time of day: `11:30:00.000`.
    pub fn time_of_day(&self, wall_ns: u64) -> String {
        self.zoned(wall_ns).strftime("%H:%M:%S.%3f").to_string()
    }

    /// The abbreviation in force at that time: `CET`, or `+05`.
    pub fn name(&self, wall_ns: u64) -> String {
        self.zoned(wall_ns).strftime("%Z").to_string()
    }

    /// The wall-clock time, ns, of `2026-02-05` (its first moment) or `2026-02-05T11:30`; seconds may follow, and `Z` or an
    /// offset for a time of another zone.
    ///
    /// # Errors
    /// When it is not a time, or before 1970; the text states what was expected.
    pub fn wall_ns(&self, text: &str) -> Result<u64, String> {
        let own = || text.parse::<Timestamp>().ok();
        let here = || {
            text.parse::<civil::DateTime>().ok()?.to_zoned_datetime(self.0.clone()).ok().map(|zoned| zoned.timestamp())
        };
        let moment = own().or_else(here).and_then(|moment| u64::try_from(moment.as_nanosecond()).ok());
        moment.ok_or_else(|| format!("{text:?} is not a date since 1970: write 2026-02-05 or 2026-02-05T11:30"))
    }

    fn zoned(&self, wall_ns: u64) -> ZonedDateTime {
        timestamp(wall_ns).to_zoned_datetime(self.0.clone())
    }
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
        let mut look = |offset| watch.detect_step(WallClock::with_offset(offset));
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
        assert_eq!((0..1000).find_map(|_| watch.detect_step(WallClock::now())), None);
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
        for (seconds, day) in [
            (0, "19700101"),
            (951_782_399, "20000228"),
            (951_782_400, "20000229"),
            (951_868_800, "20000301"),
            (1_700_000_000, "20231114"),
            (1_735_689_599, "20241231"),
            (4_107_542_400, "21000301"),
        ] {
            assert_eq!(compact_date(seconds * 1_000_000_000), day);
        }
        assert_eq!(rfc3339(u64::MAX), "2554-07-21T23:34:33.709Z");
    }

    #[test]
    fn a_zone_reads_the_times_it_writes() {
        let berlin = Zone(TimeZone::posix("CET-1CEST,M3.5.0,M10.5.0/3").expect("a zone"));
        let winter = 1_770_287_400_000_000_000;
        assert_eq!((berlin.minute(winter), berlin.name(winter)), ("2026-02-05 11:30".to_owned(), "CET".to_owned()));
        assert_eq!(berlin.time_of_day(winter + 250_000_000), "11:30:00.250");
        assert_eq!(berlin.name(winter + 150 * 86_400_000_000_000), "CEST");
        for text in ["2026-02-05T11:30", "2026-02-05 11:30", "2026-02-05T11:30:00", "2026-02-05T10:30Z"] {
            assert_eq!(berlin.wall_ns(text), Ok(winter), "{text}");
        }
        assert_eq!(berlin.wall_ns("2026-02-05"), Ok(winter - 11 * 3_600_000_000_000 - 1_800_000_000_000));
        for text in ["", "yesterday", "2026-02-30", "1969-12-31", "99999-01-01"] {
            assert!(berlin.wall_ns(text).is_err_and(|error| error.contains("2026-02-05")), "{text}");
        }
    }

    #[test]
    fn arithmetic_saturates() {
        assert_eq!(Stamp(5).before(Duration::from_secs(1)), Stamp(0));
        assert_eq!(Stamp(u64::MAX).after(Duration::from_secs(1)), Stamp(u64::MAX));
        assert_eq!(Stamp(1).since(Stamp(9)), Duration::ZERO);
    }
}
