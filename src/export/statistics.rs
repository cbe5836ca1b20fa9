//! Statistics of a column of a dataset, as LeRobot normalises with them: over an episode, and of episodes together.
//!
//! Those of several episodes are made of each episode's as `lerobot.datasets.compute_stats.aggregate_stats` does: exact
//! but for the quantiles, which are the weighted mean of the episodes'.

/// The quantiles of LeRobot, by name.
pub(super) const QUANTILES: [(&str, f64); 5] = [("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)];

/// One column over its valid rows.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Column {
    pub(super) min: f64,
    pub(super) max: f64,
    pub(super) mean: f64,
    /// Of the population.
    pub(super) std: f64,
    pub(super) quantiles: [f64; 5],
    /// How many rows are valid; without any the others are 0.
    pub(super) count: u64,
}

impl Column {
    /// Of these values, which it sorts.
    pub(super) fn from_values(values: &mut [f64]) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let (Some(min), Some(max)) = (values.first(), values.last()) else { return Self::default() };
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        let quantiles = QUANTILES.map(|(_, share)| quantile(values, share));
        Self { min: *min, max: *max, mean, std: variance.sqrt(), quantiles, count: values.len() as u64 }
    }

    /// Of the levels of pixels, 0 to 1, of which there are so many of each; `count` pictures.
    pub(super) fn of_levels(levels: &[u64; 256], count: u64) -> Self {
        let total: u64 = levels.iter().sum();
        let used = || (0_u32..).zip(levels).filter(|(_, count)| **count > 0);
        let level = |level: u32| f64::from(level) / 255.0;
        let (Some((least, _)), Some((most, _))) = (used().next(), used().last()) else { return Self::default() };
        let mean_of = |value: &dyn Fn(f64) -> f64| {
            used().map(|(at, count)| value(level(at)) * *count as f64).sum::<f64>() / total as f64
        };
        let mean = mean_of(&|value| value);
        let variance = mean_of(&|value| (value - mean).powi(2));
        let quantiles = QUANTILES.map(|(_, share)| {
            let mut below = 0;
            let reached = used().find(|(_, count)| {
                below += **count;
                below as f64 >= share * total as f64
            });
            reached.map_or(0.0, |(at, _)| level(at))
        });
        Self { min: level(least), max: level(most), mean, std: variance.sqrt(), quantiles, count }
    }

    /// Of a flag that is set in so many of all rows.
    pub(super) fn of_flags(set: u64, rows: u64) -> Self {
        let mut flags = vec![0.0; usize::try_from(rows - set.min(rows)).unwrap_or_default()];
        flags.resize(usize::try_from(rows).unwrap_or_default(), 1.0);
        Self::from_values(&mut flags)
    }

    /// Of both together.
    pub(super) fn with(self, other: Self) -> Self {
        if self.count == 0 || other.count == 0 {
            return if self.count == 0 { other } else { self };
        }
        let count = self.count.saturating_add(other.count);
        let [a, b] = [self.count, other.count].map(|part| part as f64 / count as f64);
        let mean = a * self.mean + b * other.mean;
        let variance =
            a * (self.std.powi(2) + (self.mean - mean).powi(2)) + b * (other.std.powi(2) + (other.mean - mean).powi(2));
        let mut quantiles = self.quantiles.map(|value| a * value);
        for (quantile, value) in quantiles.iter_mut().zip(other.quantiles) {
            *quantile += b * value;
        }
        let (min, max) = (self.min.min(other.min), self.max.max(other.max));
        Self { min, max, mean, std: variance.sqrt(), quantiles, count }
    }

    /// The statistics by name, as LeRobot has them.
    pub(super) fn named(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let moments = [("min", self.min), ("max", self.max), ("mean", self.mean), ("std", self.std)];
        moments.into_iter().chain(QUANTILES.iter().zip(self.quantiles).map(|((name, _), value)| (*name, value)))
    }

    /// Where the statistic of this name is.
    pub(super) fn place(&mut self, name: &str) -> Option<&mut f64> {
        Some(match name {
            "min" => &mut self.min,
            "max" => &mut self.max,
            "mean" => &mut self.mean,
            "std" => &mut self.std,
            name => {
                let at = QUANTILES.iter().position(|(quantile, _)| *quantile == name)?;
                self.quantiles.get_mut(at)?
            }
        })
    }
}

/// Of sorted values, interpolated linearly as by `numpy.quantile`.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * sorted.len().saturating_sub(1) as f64;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share of a length")]
    let at = place as usize;
    let low = sorted.get(at).copied().unwrap_or_default();
    let high = sorted.get(at + 1).copied().unwrap_or(low);
    low + (high - low) * place.fract()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: Column, expected: Column) {
        let pairs = found.named().zip(expected.named());
        for ((name, found), (_, expected)) in pairs {
            assert!((found - expected).abs() < 1e-12, "{name}: {found} {expected}");
        }
        assert_eq!(found.count, expected.count);
    }

    #[test]
    fn a_column_has_the_statistics_of_numpy() {
        // numpy.quantile([1, 2, 4, 8], [.01, .1, .5, .9, .99])
        let quantiles = [1.03, 1.3, 3.0, 6.8, 7.88];
        let std = 7.1875_f64.sqrt();
        let expected = Column { min: 1.0, max: 8.0, mean: 3.75, std, quantiles, count: 4 };
        near(Column::from_values(&mut [8.0, 1.0, 4.0, 2.0]), expected);
        assert_eq!(Column::from_values(&mut []), Column::default());
    }

    #[test]
    fn two_episodes_together_are_as_one() {
        let all = Column::from_values(&mut [1.0, 5.0, 2.0, 9.0, 9.5]);
        let parts = Column::from_values(&mut [1.0, 5.0]).with(Column::from_values(&mut [2.0, 9.0, 9.5]));
        near(parts, Column { quantiles: parts.quantiles, ..all });
        // Without a valid row an episode has no weight.
        assert_eq!(all.with(Column::default()), all);
        assert_eq!(Column::default().with(all), all);
    }

    #[test]
    fn levels_are_shares_of_white() {
        let mut levels = [0; 256];
        (levels[0], levels[255]) = (3, 1);
        let quantiles = [0.0, 0.0, 0.0, 1.0, 1.0];
        let expected = Column { min: 0.0, max: 1.0, mean: 0.25, std: 0.1875_f64.sqrt(), quantiles, count: 2 };
        near(Column::of_levels(&levels, 2), expected);
    }
}
