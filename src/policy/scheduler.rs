//! The noise scheduler: from a chunk of noise to a chunk of actions, one timestep after the other.
//!
//! DDIM with eta = 0 (Song et al., "Denoising Diffusion Implicit Models") and DDPM with the variance
//! called `fixed_small` (Ho et al., "Denoising Diffusion Probabilistic Models"), as the `diffusers`
//! library computes them, so that a policy behaves as in training. Easily mistaken: tables and samples are 32-bit floats; `leading` strides by the integer `T / n`; the
//! alpha before the first timestep is 1 unless `set_alpha_to_one` is false; DDIM does not
//! compute the noise again after it has clipped the clean sample.
//!
//! Invariant: pure; noise is given by the caller. A step allocates nothing.

use super::bundle::{BetaSchedule, PredictionType, SchedulerKind, SchedulerSpec, TimestepSpacing};

/// Why a schedule cannot be run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SchedulerError {
    /// More steps than there are timesteps, or none.
    #[error("scheduler.num_inference_steps = {steps}: write 1 to num_train_timesteps = {train}")]
    Steps {
        /// Those asked for.
        steps: usize,
        /// Those there are.
        train: usize,
    },
    /// A timestep that the denoiser was not trained with.
    #[error("scheduler.steps_offset leads to timestep {timestep} of {train}: write a smaller one")]
    Offset {
        /// The timestep.
        timestep: usize,
        /// Those there are.
        train: usize,
    },
    /// Betas with which nothing is left of the sample or of the noise in 32-bit floats.
    #[error("scheduler: the betas leave no noise or no sample at timestep {timestep}: correct beta_start and beta_end")]
    Betas {
        /// Where.
        timestep: usize,
    },
}

/// A schedule, ready to run. Steps are numbered from 0, the noisiest.
#[derive(Debug, Clone, PartialEq)]
pub struct Scheduler {
    steps: Vec<Step>,
    prediction: PredictionType,
    /// The clean sample is clipped to plus and minus this.
    clip: Option<f32>,
}

/// One step: `sample = from_clean * clean + from_other * other + from_noise * noise`, in which
/// `other` is the predicted noise in DDIM, the sample itself in DDPM.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Step {
    timestep: usize,
    /// Root of the share of the clean sample, and of the noise, at the timestep.
    root_alpha: f32,
    root_beta: f32,
    from_clean: f32,
    other: Other,
    from_other: f32,
    from_noise: f32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Other {
    Epsilon,
    Sample,
}

impl Scheduler {
    /// Works out the tables for `steps` steps; the bundle's own number is `num_inference_steps`.
    ///
    /// # Errors
    /// When there are fewer timesteps than that, or the betas are invalid.
    pub fn new(spec: &SchedulerSpec, steps: usize) -> Result<Self, SchedulerError> {
        let train = spec.num_train_timesteps;
        if steps == 0 || steps > train {
            return Err(SchedulerError::Steps { steps, train });
        }
        let alphas = alphas_cumprod(spec);
        if let Some(timestep) = alphas.iter().position(|alpha| !(*alpha > 0.0 && *alpha < 1.0)) {
            return Err(SchedulerError::Betas { timestep });
        }
        let timesteps = timesteps(spec, steps);
        if let Some(timestep) = timesteps.iter().copied().find(|timestep| *timestep >= train) {
            return Err(SchedulerError::Offset { timestep, train });
        }
        let before = |at: usize, timestep: usize| match spec.kind {
            SchedulerKind::Ddim => match timestep.checked_sub(train / steps) {
                Some(previous) => alphas[previous],
                None if spec.set_alpha_to_one => 1.0,
                None => alphas[0],
            },
            SchedulerKind::Ddpm => timesteps.get(at + 1).map_or(1.0, |previous| alphas[*previous]),
        };
        let steps = timesteps
            .iter()
            .enumerate()
            .map(|(at, timestep)| Step::new(spec.kind, *timestep, alphas[*timestep], before(at, *timestep)))
            .collect();
        Ok(Self { steps, prediction: spec.prediction_type, clip: spec.clip_sample.then_some(spec.clip_sample_range) })
    }

    /// The denoiser's input `timestep` at each step, falling.
    pub fn timesteps(&self) -> impl Iterator<Item = i64> {
        #[expect(clippy::cast_possible_wrap, reason = "at most 10000")]
        self.steps.iter().map(|step| step.timestep as i64)
    }

    /// Does step `at` add noise? It does in DDPM, but for timestep 0.
    pub fn wants_noise(&self, at: usize) -> bool {
        self.steps.get(at).is_some_and(|step| step.from_noise > 0.0)
    }

    /// Takes `sample` from step `at` to the next, given what the denoiser predicted for it.
    /// `noise`, standard normal, is used only if [`Self::wants_noise`]; without it none is added. All slices are as
    /// long as the sample; a shorter one ends the step early. Beyond the last step nothing happens.
    pub fn step(&self, at: usize, sample: &mut [f32], prediction: &[f32], noise: Option<&[f32]>) {
        let Some(step) = self.steps.get(at) else { return };
        for (x, prediction) in sample.iter_mut().zip(prediction) {
            *x = step.denoise(*x, *prediction, self.prediction, self.clip);
        }
        if let Some(noise) = noise.filter(|_| step.from_noise > 0.0) {
            for (x, noise) in sample.iter_mut().zip(noise) {
                *x += step.from_noise * noise;
            }
        }
    }
}

impl Step {
    /// `alpha` is the share of the clean sample at this timestep, `before` at the one before.
    fn new(kind: SchedulerKind, timestep: usize, alpha: f32, before: f32) -> Self {
        let beta = 1.0 - alpha;
        let (from_clean, other, from_other, from_noise) = match kind {
            SchedulerKind::Ddim => (before.sqrt(), Other::Epsilon, (1.0 - before).sqrt(), 0.0),
            SchedulerKind::Ddpm => {
                let ratio = alpha / before;
                let (fresh, left) = (1.0 - ratio, 1.0 - before);
                let variance = (left / beta * fresh).max(1e-20);
                let from_noise = if timestep > 0 { variance.sqrt() } else { 0.0 };
                (before.sqrt() * fresh / beta, Other::Sample, ratio.sqrt() * left / beta, from_noise)
            }
        };
        Self { timestep, root_alpha: alpha.sqrt(), root_beta: beta.sqrt(), from_clean, other, from_other, from_noise }
    }

    fn denoise(self, x: f32, predicted: f32, prediction: PredictionType, clip: Option<f32>) -> f32 {
        let (a, b) = (self.root_alpha, self.root_beta);
        let (clean, epsilon) = match prediction {
            PredictionType::Epsilon => ((x - b * predicted) / a, predicted),
            PredictionType::Sample => (predicted, (x - a * predicted) / b),
            PredictionType::VPrediction => (a * x - b * predicted, a * predicted + b * x),
        };
        let clean = clip.map_or(clean, |range| clean.clamp(-range, range));
        let other = match self.other {
            Other::Epsilon => epsilon,
            Other::Sample => x,
        };
        self.from_clean * clean + self.from_other * other
    }
}

/// The share of the clean sample at each timestep.
#[expect(clippy::cast_possible_truncation, reason = "tables are 32-bit floats")]
fn alphas_cumprod(spec: &SchedulerSpec) -> Vec<f32> {
    let total = spec.num_train_timesteps;
    let even = |first: f64, last: f64, at: usize| {
        let share = if total > 1 { at as f64 / (total - 1) as f64 } else { 0.0 };
        (first + (last - first) * share) as f32
    };
    let beta = |at: usize| match spec.beta_schedule {
        BetaSchedule::SquaredcosCapV2 => {
            let bar = |at: usize| {
                let angle = (at as f64 / total as f64 + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2;
                angle.cos().powi(2)
            };
            (1.0 - bar(at + 1) / bar(at)).min(0.999) as f32
        }
        BetaSchedule::Linear => even(spec.beta_start, spec.beta_end, at),
        BetaSchedule::ScaledLinear => even(spec.beta_start.sqrt(), spec.beta_end.sqrt(), at).powi(2),
    };
    let product = |left: &mut f32, at: usize| {
        *left *= 1.0 - beta(at);
        Some(*left)
    };
    (0..total).scan(1.0_f32, product).collect()
}

/// The timesteps visited, falling. Halves are rounded to even, as numpy does.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "rounded, from 0 to 10000")]
fn timesteps(spec: &SchedulerSpec, steps: usize) -> Vec<usize> {
    let total = spec.num_train_timesteps;
    let timestep = |at: usize| match spec.timestep_spacing {
        TimestepSpacing::Leading => at * (total / steps) + spec.steps_offset,
        TimestepSpacing::Trailing => {
            let left = (steps - 1 - at) as f64;
            let up = total as f64 - left * (total as f64 / steps as f64);
            (up.round_ties_even() as usize).saturating_sub(1)
        }
        TimestepSpacing::Linspace if steps == 1 => 0,
        TimestepSpacing::Linspace => {
            let stride = (total - 1) as f64 / (steps - 1) as f64;
            (at as f64 * stride).round_ties_even() as usize
        }
    };
    (0..steps).rev().map(timestep).collect()
}

#[cfg(test)]
mod tests;
