//! Sends numbered items at a fixed rate.
//!
//! Invariant: a number is assigned only to an item that is sent; late ones are skipped and counted.

use serde_json::{Value, json};

/// Maximum lateness of a tick; later ones are skipped.
const LATEST_NS: u64 = 50_000_000;
/// Ticks closer than this are sent several at a time.
const SHORTEST_NS: u64 = 1_000_000;

/// A clock with a count of its ticks.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    hz: f64,
    begun_ns: u64,
    /// Ticks passed, sent or not.
    passed: u64,
    sent: u32,
    skipped: u64,
}

impl Pace {
    /// Starts with `hz` ticks per second.
    pub fn new(hz: f64, now_ns: u64) -> Self {
        Self { hz, begun_ns: now_ns, passed: 0, sent: 0, skipped: 0 }
    }

    /// The number of the tick that is due, if any: it must be sent.
    pub fn beat(&mut self, now_ns: u64) -> Option<u32> {
        self.skip(now_ns);
        if self.due_ns() > now_ns {
            return None;
        }
        self.passed += 1;
        self.sent += 1;
        Some(self.sent - 1)
    }

    /// When to check again.
    pub fn next_ns(&self, now_ns: u64) -> u64 {
        self.due_ns().max(now_ns + SHORTEST_NS)
    }

    /// The result.
    pub fn summary(&mut self, now_ns: u64) -> Value {
        self.skip(now_ns);
        json!({"sent": self.sent, "skipped": self.skipped})
    }

    fn due_ns(&self) -> u64 {
        self.begun_ns + ((self.passed + 1) as f64 / self.hz * 1e9) as u64
    }

    fn skip(&mut self, now_ns: u64) {
        let oldest_ns = now_ns.saturating_sub(LATEST_NS).saturating_sub(self.begun_ns);
        let passed = (oldest_ns as f64 * self.hz / 1e9) as u64;
        self.skipped += passed.saturating_sub(self.passed);
        self.passed = self.passed.max(passed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn numbers_have_no_gaps() {
        let mut pace = Pace::new(1_000.0, 0);
        let mut beats = |ms: u64| std::iter::from_fn(|| pace.beat(ms * MS)).collect::<Vec<u32>>();
        assert_eq!(beats(0), [0_u32; 0]);
        assert_eq!(beats(3), [0, 1, 2]);
        // No check for a second.
        let late = beats(1_003);
        assert_eq!((late.first(), late.len()), (Some(&3), 50));
        assert_eq!(pace.next_ns(1_003 * MS), 1_004 * MS);
        assert_eq!(pace.summary(1_003 * MS), json!({"sent": 53, "skipped": 950}));
    }
}
