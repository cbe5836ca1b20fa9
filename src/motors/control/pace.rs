//! When a cycle of the control thread begins: on a grid, or early for a fresh action.
//!
//! Invariant: from one cycle to the next no more than 9/8 of the configured cycle passes, unless the thread was
//! delayed.
//! Invariant: over any time there is at most 5/4 of the configured number of cycles plus one, however often actions
//! arrive: the bus has room for them.

use std::time::Duration;

use rapid_core::time::Stamp;

/// See the module's comment.
#[derive(Debug, Clone)]
pub struct Pace {
    cycle: Duration,
    due: Stamp,
    /// The leaky bucket (the generic cell rate algorithm, ITU-T I.371): when it would be empty.
    empty: Stamp,
}

impl Pace {
    /// The first cycle is due one cycle after `now`.
    pub fn new(cycle: Duration, now: Stamp) -> Self {
        Self { cycle, due: now.after(cycle), empty: now.after(cycle * 4 / 5) }
    }

    /// The latest time at which the next cycle begins.
    pub const fn due(&self) -> Stamp {
        self.due
    }

    /// The earliest time at which the next cycle may begin, for a fresh action.
    pub fn earliest(&self) -> Stamp {
        self.empty.before(self.cycle / 2).min(self.due)
    }

    /// A cycle began at `now`. On the grid, missed cycles are skipped. After an early cycle the grid restarts an eighth
    /// of a cycle later: actions once per cycle then find the thread waiting and not in a cycle.
    pub fn begin(&mut self, now: Stamp) {
        self.empty = self.empty.max(now).after(self.cycle * 4 / 5);
        if now < self.due {
            self.due = now.after(self.cycle * 9 / 8);
            return;
        }
        self.due = self.due.after(self.cycle);
        if self.due <= now {
            let missed = now.since(self.due).as_nanos() / self.cycle.as_nanos().max(1);
            self.due = self.due.after(self.cycle * u32::try_from(missed + 1).unwrap_or(1));
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const CYCLE: Duration = Duration::from_millis(5);
    const BEGIN: Stamp = Stamp(1_000_000_000);

    /// Begins cycles until `end`: when they are due, and early after each of `actions`. How long each action waited.
    fn run(actions: &[Stamp], end: Stamp) -> (Vec<Stamp>, Vec<Duration>) {
        let mut pace = Pace::new(CYCLE, BEGIN);
        let (mut cycles, mut waits) = (vec![BEGIN], Vec::new());
        let mut waiting = actions.iter().copied().peekable();
        loop {
            let early = waiting.peek().map(|action| pace.earliest().max(*action));
            let now = early.map_or(pace.due(), |early| early.min(pace.due()));
            if now >= end {
                return (cycles, waits);
            }
            while let Some(action) = waiting.next_if(|action| *action <= now) {
                waits.push(now.since(action));
            }
            pace.begin(now);
            cycles.push(now);
        }
    }

    proptest! {
        #[test]
        fn cycles_are_neither_too_far_apart_nor_too_many(gaps in prop::collection::vec(0_u64..20_000_000, 0..400)) {
            let mut at = BEGIN;
            let actions: Vec<Stamp> = gaps.iter().map(|gap| { at = Stamp(at.0 + gap); at }).collect();
            let (cycles, _) = run(&actions, at.after(CYCLE * 10));
            for pair in cycles.windows(2) {
                prop_assert!(pair[1] > pair[0] && pair[1].since(pair[0]) <= CYCLE * 9 / 8, "{pair:?}");
            }
            for (index, first) in cycles.iter().enumerate() {
                for (count, last) in cycles[index..].iter().enumerate() {
                    // `count` cycles after the first: 4/5 of a cycle each, less what an idle time had saved.
                    let least = (CYCLE * 4 / 5 * u32::try_from(count).unwrap()).saturating_sub(CYCLE / 2);
                    prop_assert!(last.since(*first) >= least, "{count} after {first:?} at {last:?}");
                }
            }
        }
    }

    #[test]
    fn actions_once_a_cycle_are_taken_on_arrival() {
        // 4.9 to 5.1 ms apart.
        let mut at = BEGIN;
        let actions: Vec<Stamp> = (0..1000_u64)
            .map(|n| {
                at = Stamp(at.0 + 4_900_000 + n * 7919 % 200_000);
                at
            })
            .collect();
        let (_, mut waits) = run(&actions, at);
        waits.sort_unstable();
        assert_eq!(waits[waits.len() * 99 / 100], Duration::ZERO);
    }

    #[test]
    fn most_actions_of_any_phase_do_not_wait() {
        let mut at = BEGIN;
        let actions: Vec<Stamp> = (0..1000_u64)
            .map(|n| {
                at = Stamp(at.0 + 90_000_000 + n * 7_919_000 % 20_000_000);
                at
            })
            .collect();
        let (_, mut waits) = run(&actions, at);
        waits.sort_unstable();
        assert_eq!(waits[waits.len() / 2], Duration::ZERO);
        assert!(waits[waits.len() - 1] <= CYCLE * 3 / 10, "{:?}", waits.last());
    }

    #[test]
    fn missed_cycles_are_skipped() {
        let mut pace = Pace::new(CYCLE, BEGIN);
        pace.begin(BEGIN.after(CYCLE * 7 / 2));
        assert_eq!(pace.due(), BEGIN.after(CYCLE * 4));
    }
}
