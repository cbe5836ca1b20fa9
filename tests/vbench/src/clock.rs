//! The two clocks in every printed line.

use std::time::Duration;

use rustix::time::{ClockId, Timespec, clock_gettime};

/// CLOCK_MONOTONIC in ns: for differences within one boot.
pub fn mono_ns() -> u64 {
    nanoseconds(clock_gettime(ClockId::Monotonic))
}

/// CLOCK_REALTIME in ns: for comparing with recorded log times.
pub fn real_ns() -> u64 {
    nanoseconds(clock_gettime(ClockId::Realtime))
}

/// The time left until `due_ns` on CLOCK_MONOTONIC; zero if it has passed.
pub fn until(due_ns: u64) -> Duration {
    Duration::from_nanos(due_ns.saturating_sub(mono_ns()))
}

fn nanoseconds(time: Timespec) -> u64 {
    time.tv_sec.unsigned_abs() * 1_000_000_000 + time.tv_nsec.unsigned_abs()
}
