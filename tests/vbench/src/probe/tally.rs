//! Counts of what came with a number each.
//!
//! The kernel hands packets of one device to several processors and may give two of them in the other order; what counts is that
//! none is missing.

use serde_json::{Value, json};

use crate::clock;

/// The numbers that came, in their order.
#[derive(Debug, Default)]
pub struct Tally {
    numbers: Vec<u32>,
    begun_ns: u64,
}

impl Tally {
    /// This number came.
    pub fn add(&mut self, number: u32) {
        if self.numbers.is_empty() {
            self.begun_ns = clock::mono_ns();
        }
        self.numbers.push(number);
    }

    /// How many came.
    pub fn len(&self) -> usize {
        self.numbers.len()
    }

    /// None came.
    pub fn is_empty(&self) -> bool {
        self.numbers.is_empty()
    }

    /// How many came, how many between the first and the last did not, how many came after a later one, and the time all took.
    pub fn summary(mut self) -> Value {
        let seconds = clock::mono_ns().saturating_sub(self.begun_ns) as f64 / 1e9;
        let came = self.numbers.len();
        let swapped = self.numbers.windows(2).filter(|pair| pair[1] < pair[0]).count();
        self.numbers.sort_unstable();
        self.numbers.dedup();
        let span = self.numbers.last().zip(self.numbers.first()).map_or(0, |(last, first)| u64::from(last - first) + 1);
        json!({"came": came, "lost": span - self.numbers.len() as u64, "swapped": swapped, "seconds": seconds})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn swapped_is_not_lost() {
        let mut tally = Tally::default();
        [7, 9, 8, 10, 13].into_iter().for_each(|number| tally.add(number));
        let summary = tally.summary();
        assert_eq!((&summary["came"], &summary["lost"], &summary["swapped"]), (&json!(5), &json!(2), &json!(1)));
        assert_eq!(Tally::default().summary()["lost"], 0);
    }
}
