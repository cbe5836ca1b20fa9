//! The latency of a camera that recorded a light.
//!
//! A picture stamped `t` is taken to show the mean of the light over its exposure `e`, whose middle
//! is at `t - latency`. The fit uses differences from picture to picture, so that a camera that
//! adapts slowly to the light does not shift the result:
//!
//! `y(i) - y(i-1) = contrast * (light(i) - light(i-1)) + noise`
//!
//! by least squares, over a grid of latencies and exposures. The estimate is the mean of the
//! latencies weighted by the likelihood of the measurements (Gaussian noise of the size of the best
//! fit's residual, uniform prior), and the uncertainty follows from their spread.

use rapid_core::time::Stamp;

/// Range of latencies considered, seconds. Below zero: a stamp taken before the exposure.
const EARLIEST: f64 = -0.1;
const LATEST: f64 = 1.0;
/// Below these numbers of pictures and flips there is no result.
const LEAST_PICTURES: usize = 30;
const LEAST_FLIPS: usize = 8;
/// Least difference between dark and lit, of 255, that is not noise.
const LEAST_CONTRAST: f64 = 2.0;
/// Least correlation; anything that is not the pattern stays below half of it.
const LEAST_CORRELATION: f64 = 0.5;
/// Another latency that fits better than this share of the best makes the result ambiguous...
const RIVAL: f64 = 0.8;
/// ...if it is further away than this, seconds.
const RIVAL_DISTANCE: f64 = 0.15;
/// The model error is at least this share of the contrast: light does not switch instantly.
const MODEL_ERROR: f64 = 0.005;
/// Steps per picture of the coarse grid and of the fine one, and number of exposures tried.
const COARSE: f64 = 4.0;
const FINE: f64 = 64.0;
const EXPOSURES: u32 = 8;

/// A change of the light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Flip {
    /// When.
    pub at: Stamp,
    /// Lit from then on, or dark.
    pub lit: bool,
}

/// The measurement of one picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Its capture time.
    pub at: Stamp,
    /// Its mean brightness, 0 to 255.
    pub brightness: f64,
}

/// A measured latency.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Estimate {
    /// From an event to the capture time of the picture that shows it, ms.
    pub latency_ms: f64,
    /// Half width of the 95 % interval of the true value, ms.
    pub uncertainty_ms: f64,
    /// How well the pictures follow the light, 0 to 1.
    pub correlation: f64,
    /// Difference between dark and lit, of 255.
    pub contrast: f64,
    /// Pictures evaluated.
    pub pictures: usize,
    /// Changes of the light.
    pub flips: usize,
}

/// Why no latency can be determined.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// There is too little data.
    #[error("only {pictures} pictures and {flips} changes of the light: let it run longer")]
    TooFew {
        /// Pictures.
        pictures: usize,
        /// Changes of the light.
        flips: usize,
    },
    /// The pictures are saturated, dark or lit.
    #[error("the pictures are white throughout: lower the exposure, or move the camera away from the light")]
    Saturated,
    /// The pictures do not change.
    #[error(
        "the pictures do not change with the light (brightness {brightness:.0} of 255 throughout): point the camera at \
         it from near by, and darken the room"
    )]
    Flat {
        /// Mean brightness, of 255.
        brightness: f64,
    },
    /// The pictures change, but not with the light.
    #[error(
        "the pictures change, but not with the light (correlation {correlation:.2}): point the camera at it, hold it \
         still, and switch automatic exposure off"
    )]
    Unlike {
        /// The best correlation at any latency.
        correlation: f64,
    },
    /// Two latencies fit nearly equally well.
    #[error("the pictures fit a latency of {first_ms:.0} ms and one of {second_ms:.0} ms: let it run longer")]
    Ambiguous {
        /// The better, ms.
        first_ms: f64,
        /// The other, ms.
        second_ms: f64,
    },
}

/// The latency of the camera that recorded `seen` while the light changed at `flips`; both in the order of time. Before
/// the first flip the light was in the opposite state.
///
/// # Errors
/// When the pictures do not follow the light, or there are too few of them.
pub fn estimate(flips: &[Flip], seen: &[Seen]) -> Result<Estimate, Refusal> {
    let scene = Scene::new(flips, seen).filter(|_| seen.len() >= LEAST_PICTURES && flips.len() >= LEAST_FLIPS);
    let Some(scene) = scene else { return Err(Refusal::TooFew { pictures: seen.len(), flips: flips.len() }) };
    scene.check_contrast()?;
    let coarse = scene.coarse()?;
    let fine = scene.fine(coarse);
    if fine.contrast < LEAST_CONTRAST {
        return Err(Refusal::Flat { brightness: scene.mean });
    }
    Ok(Estimate { pictures: seen.len(), flips: flips.len(), ..fine })
}

/// How well a latency and an exposure explain the measurements.
#[derive(Debug, Clone, Copy)]
struct Fit {
    residual: f64,
    correlation: f64,
    contrast: f64,
}

/// Light and pictures, in seconds from the first flip.
struct Scene {
    /// Time and state of each flip, and for how long it had been lit before.
    flips: Vec<(f64, bool, f64)>,
    times: Vec<f64>,
    steps: Vec<f64>,
    /// Sum of the squares of the steps.
    power: f64,
    /// The usual time between two pictures.
    period: f64,
    mean: f64,
    /// The 5th and 95th percentile of the brightness.
    range: (f64, f64),
}

impl Scene {
    fn new(flips: &[Flip], seen: &[Seen]) -> Option<Self> {
        let origin = flips.first()?.at;
        let seconds = |at: Stamp| at.since(origin).as_secs_f64() - origin.since(at).as_secs_f64();
        let mut lit_for = 0.0;
        let mut before: Option<(f64, bool)> = None;
        let mut placed = Vec::with_capacity(flips.len());
        for flip in flips {
            let at = seconds(flip.at);
            if let Some((since, true)) = before {
                lit_for += at - since;
            }
            placed.push((at, flip.lit, lit_for));
            before = Some((at, flip.lit));
        }
        let times: Vec<f64> = seen.iter().map(|seen| seconds(seen.at)).collect();
        let steps: Vec<f64> = seen.windows(2).map(|pair| pair[1].brightness - pair[0].brightness).collect();
        let mut periods: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).filter(|gap| *gap > 0.0).collect();
        periods.sort_by(f64::total_cmp);
        let mut levels: Vec<f64> = seen.iter().map(|seen| seen.brightness).collect();
        levels.sort_by(f64::total_cmp);
        let level = |share: usize| levels.get(levels.len().saturating_sub(1) * share / 100).copied();
        Some(Self {
            flips: placed,
            power: steps.iter().map(|step| step * step).sum(),
            steps,
            period: periods.get(periods.len() / 2).copied()?.clamp(1e-3, 1.0),
            mean: levels.iter().sum::<f64>() / levels.len() as f64,
            range: (level(5)?, level(95)?),
            times,
        })
    }

    fn check_contrast(&self) -> Result<(), Refusal> {
        /// White, as far as a camera can measure.
        const WHITE: f64 = 250.0;
        let (dark, bright) = self.range;
        if bright - dark >= LEAST_CONTRAST {
            return Ok(());
        }
        Err(if dark >= WHITE { Refusal::Saturated } else { Refusal::Flat { brightness: self.mean } })
    }

    /// How long the light was on until a moment. `next` is the first flip after the moment that was asked for before: the
    /// search begins there, because the next one is nearly always near it, and a fit asks for thousands.
    fn lit_until(&self, at: f64, next: &mut usize) -> f64 {
        let is_past = |index: usize| self.flips.get(index).is_some_and(|(flip, ..)| *flip <= at);
        while is_past(*next) {
            *next += 1;
        }
        while next.checked_sub(1).is_some_and(|last| !is_past(last)) {
            *next -= 1;
        }
        match next.checked_sub(1).and_then(|last| self.flips.get(last)) {
            Some((flip, lit, before)) => before + if *lit { at - flip } else { 0.0 },
            // Before the first flip: lit if that one turned it dark.
            None => self.flips.first().map_or(0.0, |(flip, lit, _)| if *lit { 0.0 } else { at - flip }),
        }
    }

    /// The mean of the light over an exposure; `next` as in [`Self::lit_until`], for its begin and its end.
    fn light(&self, at: f64, exposure: f64, next: &mut [usize; 2]) -> f64 {
        // A single moment is treated as an exposure too short to matter.
        let half = exposure.max(1e-6) / 2.0;
        let [begin, end] = next;
        (self.lit_until(at + half, end) - self.lit_until(at - half, begin)) / (2.0 * half)
    }

    fn fit(&self, latency: f64, exposure: f64) -> Fit {
        let mut before = None;
        let mut next = [0; 2];
        let (mut light_power, mut together) = (0.0, 0.0);
        for (at, step) in self.times.iter().zip(std::iter::once(&0.0).chain(&self.steps)) {
            let light = self.light(at - latency, exposure, &mut next);
            if let Some(before) = before.replace(light) {
                let change: f64 = light - before;
                light_power += change * change;
                together += change * step;
            }
        }
        // A light that gets brighter never makes the picture darker.
        let contrast = if light_power > 0.0 { (together / light_power).max(0.0) } else { 0.0 };
        let correlation = if self.power > 0.0 { contrast * (light_power / self.power).sqrt() } else { 0.0 };
        Fit { residual: (self.power - contrast * contrast * light_power).max(0.0), correlation, contrast }
    }

    /// The latency that fits best, to about a quarter of a picture.
    fn coarse(&self) -> Result<f64, Refusal> {
        let step = self.period / COARSE;
        let fits: Vec<(f64, f64)> =
            grid(EARLIEST, LATEST, step).map(|latency| (latency, self.fit(latency, self.period).correlation)).collect();
        let best = |far_from: Option<f64>| {
            let distance = RIVAL_DISTANCE.max(2.0 * self.period);
            let near = |latency: f64| far_from.is_some_and(|best| (latency - best).abs() < distance);
            fits.iter().filter(|(latency, _)| !near(*latency)).max_by(|a, b| a.1.total_cmp(&b.1)).copied()
        };
        let Some((latency, correlation)) = best(None) else { return Err(Refusal::Unlike { correlation: 0.0 }) };
        if correlation < LEAST_CORRELATION {
            return Err(Refusal::Unlike { correlation });
        }
        match best(Some(latency)) {
            Some((second, rival)) if rival >= RIVAL * correlation => {
                Err(Refusal::Ambiguous { first_ms: latency * 1e3, second_ms: second * 1e3 })
            }
            _ => Ok(latency),
        }
    }

    /// The mean and the spread of the latencies around `near` that explain the measurements.
    fn fine(&self, near: f64) -> Estimate {
        let step = self.period / FINE;
        let fits: Vec<(f64, Fit)> = (0..=EXPOSURES)
            .map(|exposure| self.period * f64::from(exposure) / f64::from(EXPOSURES))
            .flat_map(|exposure| {
                grid(near - 1.5 * self.period, near + 1.5 * self.period, step)
                    .map(move |latency| (latency, self.fit(latency, exposure)))
            })
            .collect();
        let nothing = Fit { residual: self.power, correlation: 0.0, contrast: 0.0 };
        let best = fits.iter().map(|(_, fit)| *fit).min_by(|a, b| a.residual.total_cmp(&b.residual)).unwrap_or(nothing);
        let count = self.steps.len() as f64;
        let noise = (best.residual / (count - 3.0).max(1.0)).max((MODEL_ERROR * best.contrast).powi(2)).max(1e-12);
        let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
        for (latency, fit) in &fits {
            let weight = (-(fit.residual - best.residual) / (2.0 * noise)).exp();
            let offset = latency - near;
            sum += weight;
            first += weight * offset;
            second += weight * offset * offset;
        }
        let (mean, square) = (first / sum, second / sum);
        let deviation = (square - mean * mean).max(0.0).sqrt();
        Estimate {
            latency_ms: (near + mean) * 1e3,
            // Latencies within a step of one another are not distinguished.
            uncertainty_ms: (1.96 * deviation + step) * 1e3,
            correlation: best.correlation.min(1.0),
            contrast: best.contrast,
            pictures: 0,
            flips: 0,
        }
    }
}

fn grid(from: f64, to: f64, step: f64) -> impl Iterator<Item = f64> {
    (0_u32..).map(move |index| from + f64::from(index) * step).take_while(move |at| *at <= to)
}

#[cfg(test)]
mod tests;
