//! Seeded streams of numbers, the same on every machine and in every version: the seed alone is
//! enough to record what they decide.
//!
//! The generator is PCG XSL 128/64 (O'Neill 2014), whose output its crate guarantees to keep. Streams of
//! one seed do not overlap: drawing more numbers from one does not affect another.

use rand_distr::{Distribution, StandardNormal, StandardUniform};
use rand_pcg::Pcg64;

/// One stream of one seed.
#[derive(Debug, Clone)]
pub struct Random(Pcg64);

impl Random {
    /// The stream from its beginning.
    #[inline]
    pub fn new(seed: u64, stream: u64) -> Self {
        Self(Pcg64::new(seed.into(), stream.into()))
    }

    /// A sample of the normal distribution with mean 0 and deviation 1.
    #[inline]
    pub fn normal(&mut self) -> f32 {
        StandardNormal.sample(&mut self.0)
    }

    /// All of them normal.
    #[inline]
    pub fn fill_normal(&mut self, values: &mut [f32]) {
        for value in values {
            *value = self.normal();
        }
    }

    /// Uniform from `low` to below `high`.
    #[inline]
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        let share: f64 = StandardUniform.sample(&mut self.0);
        low + share * (high - low)
    }

    /// A whole number below `end`; 0 if that is 0.
    #[inline]
    pub fn below(&mut self, end: u64) -> u64 {
        let number: u64 = StandardUniform.sample(&mut self.0);
        // The high half of the product (Lemire 2019): off by less than end / 2^64.
        u64::try_from((u128::from(number) * u128::from(end)) >> 64).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_are_reproducible_and_differ_from_each_other() {
        let draw = |seed, stream| {
            let mut random = Random::new(seed, stream);
            (0..4).map(|_| random.below(1000)).collect::<Vec<_>>()
        };
        assert_eq!(draw(7, 1), draw(7, 1));
        assert_ne!(draw(7, 1), draw(7, 2));
        assert_ne!(draw(7, 1), draw(8, 1));
        // Pinned: a recording names the seed and relies on these numbers.
        assert_eq!(draw(7, 1), [877, 532, 87, 281]);
    }

    #[test]
    fn numbers_have_the_documented_distribution() {
        let mut random = Random::new(1, 0);
        let mut noise = vec![0.0; 20_000];
        random.fill_normal(&mut noise);
        let mean = noise.iter().sum::<f32>() / 20_000.0;
        let variance = noise.iter().map(|value| value * value).sum::<f32>() / 20_000.0;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
        assert!((0..1000).all(|_| (2.0..3.0).contains(&random.uniform(2.0, 3.0))));
        let mut seen = [false; 5];
        (0..100).for_each(|_| seen[usize::try_from(random.below(5)).unwrap()] = true);
        assert_eq!(seen, [true; 5]);
        assert_eq!(random.below(0), 0);
    }
}
