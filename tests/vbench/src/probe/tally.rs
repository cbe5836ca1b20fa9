//! Counts received numbers.
//!
//! The kernel distributes packets of one device over several processors and may deliver two of them in reverse order;
//! what matters is that none is missing.

use serde_json::{Value, json};

use crate::clock;

/// The numbers received, in order.
#[derive(Debug, Default)]
pub struct Tally {
    numbers: Vec<u32>,
    begun_ns: u64,
}

impl Tally {
    /// A number was received.
    pub fn add(&mut self, number: u32) {
        if self.numbers.is_empty() {
            self.begun_ns = clock::mono_ns();
        }
        self.numbers.push(number);
    }

    /// How many were received.
    pub fn len(&self) -> usize {
        self.numbers.len()
    }

    /// Whether none was received.
    pub fn is_empty(&self) -> bool {
        self.numbers.is_empty()
    }

    /// Numbers received, missing between the first and the last, and received after a later one; and the total time.
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
