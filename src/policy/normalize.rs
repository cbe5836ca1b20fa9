//! Normalisation of numbers as in training, and its inverse.
//!
//! `min_max`: `(v - min) / (max - min) * 2 - 1`. `mean_std`: `(v - mean) / (std + eps)`. `identity`:
//! `v`. Arithmetic is that of 32-bit floats, as in training.
//!
//! Invariant: nothing here allocates after construction, and no input causes a panic.

use super::bundle::{BundleAction, Normalization};

/// The statistics of one normalisation, dimension by dimension.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalizer {
    dimensions: Vec<Dimension>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Dimension {
    /// Subtracted first, so that values near it keep their digits.
    offset: f32,
    width: f32,
    low: f32,
    span: f32,
}

impl Dimension {
    const IDENTITY: Self = Self { offset: 0.0, width: 1.0, low: 0.0, span: 1.0 };

    fn forward(self, value: f32) -> f32 {
        (value - self.offset) / self.width * self.span + self.low
    }

    fn inverse(self, normalized: f32) -> f32 {
        (normalized - self.low) / self.span * self.width + self.offset
    }
}

impl Normalizer {
    /// For `len` dimensions: channels of a picture, values of a vector. Dimensions without statistics are
    /// left unchanged; those of a checked bundle are complete.
    pub fn new(normalization: &Normalization, len: usize) -> Self {
        let mut dimensions = vec![Dimension::IDENTITY; len];
        fill(&mut dimensions, normalization);
        Self { dimensions }
    }

    /// For an action in the network's output, composed of its slices.
    pub fn of_action(action: &BundleAction) -> Self {
        let mut dimensions = vec![Dimension::IDENTITY; action.outputs()];
        for part in &action.normalization {
            fill(dimensions.get_mut(part.slice.clone()).unwrap_or_default(), &part.normalization);
        }
        Self { dimensions }
    }

    /// Denormalises consecutive vectors, as in a denoiser's output `[Tp, Da]`, in place.
    pub fn invert(&self, values: &mut [f32]) {
        for vector in values.chunks_exact_mut(self.dimensions.len().max(1)) {
            for (dimension, value) in self.dimensions.iter().zip(vector) {
                *value = dimension.inverse(*value);
            }
        }
    }

    /// Normalises a picture with consecutive channels, `[C, H * W]`, in place.
    pub fn normalize_planes(&self, picture: &mut [f32]) {
        let plane = (picture.len() / self.dimensions.len().max(1)).max(1);
        for (dimension, plane) in self.dimensions.iter().zip(picture.chunks_exact_mut(plane)) {
            for value in plane {
                *value = dimension.forward(*value);
            }
        }
    }
}

fn fill(dimensions: &mut [Dimension], normalization: &Normalization) {
    match normalization {
        Normalization::MinMax { min, max } => {
            for (dimension, (min, max)) in dimensions.iter_mut().zip(min.iter().zip(max)) {
                *dimension = Dimension { offset: *min, width: max - min, low: -1.0, span: 2.0 };
            }
        }
        Normalization::MeanStd { mean, std, eps } => {
            for (dimension, (mean, std)) in dimensions.iter_mut().zip(mean.iter().zip(std)) {
                *dimension = Dimension { offset: *mean, width: std + eps, low: 0.0, span: 1.0 };
            }
        }
        Normalization::Identity => {}
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "numbers that 32-bit floats hold exactly")]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn forward(normalizer: &Normalizer, values: &[f32]) -> Vec<f32> {
        let mut out = values.to_vec();
        for vector in out.chunks_mut(normalizer.dimensions.len()) {
            normalizer.normalize_planes(vector);
        }
        out
    }

    fn inverse(normalizer: &Normalizer, values: &[f32]) -> Vec<f32> {
        let mut out = values.to_vec();
        normalizer.invert(&mut out);
        out
    }

    fn min_max() -> Normalization {
        Normalization::MinMax { min: vec![0.0, -2.0], max: vec![1.0, 6.0] }
    }

    #[test]
    fn every_mode_follows_its_formula() {
        let normalizer = Normalizer::new(&min_max(), 2);
        let out = forward(&normalizer, &[0.0, -2.0, 1.0, 6.0, 0.5, 0.0]);
        assert_eq!(out, [-1.0, -1.0, 1.0, 1.0, 0.0, -0.5]);
        let mean_std = Normalization::MeanStd { mean: vec![1.0, 2.0], std: vec![1.5, 0.0], eps: 0.5 };
        assert_eq!(forward(&Normalizer::new(&mean_std, 2), &[5.0, 3.0]), [2.0, 2.0]);
        assert_eq!(inverse(&Normalizer::new(&mean_std, 2), &[2.0, 2.0]), [5.0, 3.0]);
        let identity = Normalizer::new(&Normalization::Identity, 2);
        assert_eq!(forward(&identity, &[0.1, f32::MAX]), [0.1, f32::MAX]);
    }

    #[test]
    fn a_picture_is_normalised_channel_by_channel() {
        let mean_std = Normalization::MeanStd { mean: vec![0.0, 1.0, 2.0], std: vec![1.0, 2.0, 4.0], eps: 0.0 };
        let mut picture = [1.0, 2.0, 1.0, 3.0, 2.0, 6.0];
        Normalizer::new(&mean_std, 3).normalize_planes(&mut picture);
        assert_eq!(picture, [1.0, 2.0, 0.0, 1.0, 0.0, 1.0]);
    }

    #[test]
    fn slices_of_an_action_have_their_own_modes() {
        let mut action = crate::bundle::Bundle::parse(crate::example::POLICY, "").unwrap().action;
        let slice = |slice, normalization| crate::bundle::SliceNormalization { slice, normalization };
        action.normalization = vec![
            slice(0..2, min_max()),
            slice(2..3, Normalization::Identity),
            slice(3..4, Normalization::MeanStd { mean: vec![3.0], std: vec![2.0], eps: 0.0 }),
        ];
        let mut chunk = [-1.0, 1.0, 0.25, 2.0, 1.0, -1.0, 0.5, -1.0];
        Normalizer::of_action(&action).invert(&mut chunk);
        assert_eq!(chunk, [0.0, 6.0, 0.25, 7.0, 1.0, -2.0, 0.5, 1.0]);
    }

    proptest! {
        #[test]
        fn the_inverse_restores_the_value(value in -10.0_f32..10.0, min in -5.0_f32..5.0, width in 0.01_f32..10.0) {
            for normalization in [
                Normalization::MinMax { min: vec![min], max: vec![min + width] },
                Normalization::MeanStd { mean: vec![min], std: vec![width], eps: 1e-8 },
            ] {
                let normalizer = Normalizer::new(&normalization, 1);
                let there = forward(&normalizer, &[value]);
                let back = inverse(&normalizer, &there);
                prop_assert!((back[0] - value).abs() <= 1e-5 * (1.0 + value.abs()), "{value} -> {} -> {}", there[0], back[0]);
            }
        }
    }
}
