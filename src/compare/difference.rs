//! How far two sequences of numbers are apart.
//!
//! Invariant: NaN is infinitely far from every other value, and equal to itself.

use rapid_policy::bundle::BundleAction;
use serde::Serialize;

/// Statistics of distances.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Spread {
    /// Their mean.
    pub mean: f64,
    /// The largest.
    pub largest: f64,
    /// Tick of the action with the largest.
    pub at_tick: u64,
    /// How many there are.
    pub values: u64,
}

impl Spread {
    fn add(&mut self, tick: u64, distance: f64) {
        self.values += 1;
        if distance > self.largest {
            (self.largest, self.at_tick) = (distance, tick);
        }
        // Once infinite, the mean stays infinite.
        if self.mean.is_finite() {
            self.mean += (distance - self.mean) / self.values as f64;
        }
    }
}

/// Distances of one axis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AxisDifference {
    /// Its name.
    pub name: String,
    /// Unit of its distances.
    pub unit: String,
    /// The distances.
    #[serde(flatten)]
    pub spread: Spread,
}

/// Distances between actions.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Difference {
    /// Over all axes, whatever their units.
    #[serde(flatten)]
    pub all: Spread,
    /// Per axis.
    pub axes: Vec<AxisDifference>,
}

impl Difference {
    pub(super) fn new(action: &BundleAction) -> Self {
        let axis = |(name, unit): (&String, &String)| AxisDifference {
            name: name.clone(),
            unit: unit.clone(),
            spread: Spread::default(),
        };
        Self { all: Spread::default(), axes: action.names.iter().zip(&action.units).map(axis).collect() }
    }

    /// Takes the two versions of the action of `tick`.
    pub(super) fn add(&mut self, tick: u64, one: impl Iterator<Item = f64>, other: impl Iterator<Item = f64>) {
        for (axis, (one, other)) in self.axes.iter_mut().zip(one.zip(other)) {
            let distance = distance(one, other);
            self.all.add(tick, distance);
            axis.spread.add(tick, distance);
        }
    }
}

/// See the module's comment.
pub(super) fn distance(one: f64, other: f64) -> f64 {
    match (one.is_nan(), other.is_nan()) {
        (true, true) => 0.0,
        (false, false) if one.to_bits() == other.to_bits() => 0.0,
        (false, false) => (one - other).abs(),
        _ => f64::INFINITY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_and_the_largest_are_reported_with_its_tick() {
        let mut spread = Spread::default();
        for (tick, distance) in [(3, 1.0), (4, 4.0), (5, 1.0)] {
            spread.add(tick, distance);
        }
        assert_eq!(spread, Spread { mean: 2.0, largest: 4.0, at_tick: 4, values: 3 });
        spread.add(6, f64::INFINITY);
        spread.add(7, 0.0);
        assert!(spread.mean.is_infinite() && spread.at_tick == 6);
    }

    #[test]
    fn nan_differs_from_everything_but_itself() {
        let (nan, far) = (f64::NAN, f64::INFINITY);
        for (one, other, expected) in [(1.0, 3.0, 2.0), (nan, nan, 0.0), (nan, 1.0, far), (far, far, 0.0)] {
            assert_eq!(distance(one, other).total_cmp(&expected), std::cmp::Ordering::Equal, "{one} {other}");
        }
    }
}
