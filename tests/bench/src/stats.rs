//! Statistics of samples: pure, and the only place where they are computed.

/// Samples in ascending order.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Sorted(Vec<f64>);

impl Sorted {
    /// Sorts; NaN is left out.
    pub(crate) fn new(samples: impl IntoIterator<Item = f64>) -> Self {
        let mut samples: Vec<f64> = samples.into_iter().filter(|sample| !sample.is_nan()).collect();
        samples.sort_by(f64::total_cmp);
        Self(samples)
    }

    /// Number of samples.
    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }

    /// The least sample not exceeded by this share of all (nearest rank), share in `0..=1`; `None` without samples.
    pub(crate) fn quantile(&self, share: f64) -> Option<f64> {
        let rank = (share.clamp(0.0, 1.0) * self.0.len() as f64).ceil() as usize;
        self.0.get(rank.max(1) - 1).copied()
    }

    /// The largest sample.
    pub(crate) fn max(&self) -> Option<f64> {
        self.0.last().copied()
    }
}

/// The median of all runs, the mean of the middle two if their number is even; `None` without runs.
pub(crate) fn median(runs: &[f64]) -> Option<f64> {
    let sorted = Sorted::new(runs.iter().copied()).0;
    let middle = sorted.len() / 2;
    let upper = *sorted.get(middle)?;
    if sorted.len().is_multiple_of(2) { Some((sorted.get(middle - 1)? + upper) / 2.0) } else { Some(upper) }
}

/// Smallest and largest of all runs.
pub(crate) fn range(runs: &[f64]) -> Option<(f64, f64)> {
    let sorted = Sorted::new(runs.iter().copied()).0;
    Some((*sorted.first()?, *sorted.last()?))
}

/// Differences of neighbours with consecutive numbers; how many numbers are missing between the others.
pub(crate) fn steps(numbered: &[(u64, u64)]) -> (Vec<u64>, u64) {
    let mut steps = Vec::with_capacity(numbered.len());
    let mut missing = 0;
    for pair in numbered.windows(2) {
        let [(before, from), (number, to)] = *pair else { continue };
        match number.saturating_sub(before) {
            0 => {}
            1 => steps.push(to.saturating_sub(from)),
            more => missing += more - 1,
        }
    }
    (steps, missing)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_samples_by_nearest_rank() {
        let hundred = Sorted::new((1..=100).rev().map(f64::from));
        for (share, expected) in [(0.0, 1.0), (0.5, 50.0), (0.95, 95.0), (0.99, 99.0), (0.991, 100.0), (1.0, 100.0)] {
            assert_eq!(hundred.quantile(share), Some(expected), "{share}");
        }
        assert_eq!((hundred.max(), hundred.len()), (Some(100.0), 100));
        let one = Sorted::new([7.0, f64::NAN]);
        assert_eq!((one.quantile(0.5), one.len()), (Some(7.0), 1));
        assert_eq!(Sorted::default().quantile(0.5), None);
    }

    #[test]
    fn the_median_of_an_even_count_lies_between_the_middle_two() {
        assert_eq!(median(&[9.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[4.0, 1.0, 2.0, 9.0]), Some(3.0));
        assert_eq!((median(&[]), range(&[])), (None, None));
        assert_eq!(range(&[3.0, 1.0, 2.0]), Some((1.0, 3.0)));
    }

    #[test]
    fn a_step_over_a_missing_number_is_not_an_interval() {
        let (steps, missing) = steps(&[(1, 10), (1, 10), (2, 12), (5, 30), (6, 33)]);
        assert_eq!((steps, missing), (vec![2, 3], 2));
    }
}
