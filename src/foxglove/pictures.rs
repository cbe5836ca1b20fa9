//! Which pictures of a camera are sent: no more than [`MOST_HZ`] a second, and of those that a turn takes the newest.
//!
//! Invariant: a camera at [`MOST_HZ`] or slower loses none by its jitter.

use std::time::Duration;

use rapid_core::time::Stamp;

/// Pictures of one topic that are sent each second, at most.
const MOST_HZ: u64 = 30;
const INTERVAL: Duration = Duration::from_nanos(1_000_000_000 / MOST_HZ);
/// By how much a picture may be early.
const JITTER: Duration = Duration::from_millis(8);

/// Decides for one topic.
#[derive(Debug, Default)]
pub(super) struct RateLimit {
    /// When the next picture is due.
    due: Stamp,
}

impl RateLimit {
    /// Whether a picture captured at `captured` is sent; the next one is then due an interval later.
    pub(super) fn admits(&mut self, captured: Stamp) -> bool {
        if captured.after(JITTER) < self.due {
            return false;
        }
        // On a grid: early and late ones compensate each other.
        self.due = self.due.max(captured.before(INTERVAL)).after(INTERVAL);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn sent(captured: impl Iterator<Item = u64>) -> usize {
        let mut pace = RateLimit::default();
        captured.filter(|captured| pace.admits(Stamp(*captured))).count()
    }

    #[test]
    fn a_faster_camera_is_slowed_down_and_no_other() {
        let begin = 1000 * MS;
        let at = |hz: u64| (0..10 * hz).map(move |index| begin + index * 1_000_000_000 / hz);
        assert_eq!([5, 15, 30].map(|hz| sent(at(hz))), [50, 150, 300]);
        // Half of 60 Hz, a third of 90 Hz.
        for hz in [60, 90, 500] {
            assert!((295..=305).contains(&sent(at(hz))), "{hz} Hz: {}", sent(at(hz)));
        }
        // Each second picture is 5 ms early.
        assert_eq!(sent(at(30).enumerate().map(|(index, at)| at - index as u64 % 2 * 5 * MS)), 300);
        // A pause, or a clock that steps, leaves no debt.
        assert_eq!(sent([0, 5000 * MS, 5033 * MS, 5067 * MS].into_iter()), 4);
    }
}
