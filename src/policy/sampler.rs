//! Action chunks: from observations and a seed.
//!
//! The encoder runs once. The denoiser then takes the noise out of a sample step by step, as the
//! scheduler requires, and the last sample is mapped back to the units of the action.
//!
//! Invariant: the same observations and the same seed give the same chunk, on the same machine with
//! the same onnxruntime and number of threads.
//! Invariant: non-finite values are passed on unchanged: the action queue refuses them.
//! Invariant: a chunk is computed without an allocation on this side of onnxruntime.

use std::io;

use rapid_core::random::Random;
use rapid_registry::InferenceSpec;

use super::bundle::{Bundle, BundleErrors, Graph, POLICY_FILE};
use super::graphs::{BoundGraph, GraphError, GraphProblem, LoadedGraph, Trial};
use super::normalize::Normalizer;
use super::observation::ObservationTensors;
use super::onnxruntime::Environment;
use super::scheduler::{Scheduler, SchedulerError};

/// The stream of a seed that the noise is drawn from.
const NOISE: u64 = 0x706f_6c69_6379;

/// Why a policy cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// The graphs do not match `policy.json`.
    #[error(transparent)]
    Bundle(#[from] BundleErrors),
    /// A graph cannot be loaded or run.
    #[error(transparent)]
    Graph(#[from] GraphError),
    /// The schedule cannot be run.
    #[error(transparent)]
    Scheduler(#[from] SchedulerError),
    /// The system provides no thread for the trial.
    #[error("a thread: {0}")]
    Thread(#[from] io::Error),
    /// The output does not have the length of a chunk.
    #[error("a chunk of {expected} values does not go into {found}")]
    Place {
        /// Numbers of a chunk.
        expected: usize,
        /// Numbers of the output.
        found: usize,
    },
}

/// How a policy is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Computing {
    /// Steps of denoising instead of the bundle's own number.
    pub denoising_steps: Option<usize>,
    /// On what.
    pub on: InferenceSpec,
}

/// A policy, ready to run.
#[derive(Debug)]
pub struct Sampler {
    encoder: BoundGraph,
    denoiser: BoundGraph,
    /// Inputs of the encoder: one for each observation of the bundle.
    observations: Vec<usize>,
    /// Of those with a history, which of their steps have a sample.
    valid: Vec<Option<usize>>,
    mask: Option<usize>,
    /// Inputs of the denoiser.
    sample: usize,
    timestep: usize,
    condition: usize,
    scheduler: Scheduler,
    normalizer: Normalizer,
    /// Of one step, where the scheduler adds some.
    noise: Vec<f32>,
}

impl Sampler {
    /// Loads the graphs of a bundle and makes all memory.
    ///
    /// # Errors
    /// When the graphs do not match the bundle, or the schedule has fewer steps.
    pub fn new(bundle: &Bundle, environment: &Environment, computing: Computing) -> Result<Self, PolicyError> {
        let load = |graph: Graph| {
            let bytes = bundle.read_graph(graph)?;
            Ok::<_, PolicyError>(LoadedGraph::load(environment, &bundle.graph(graph).file, &bytes, computing.on)?)
        };
        let (encoder, denoiser) = (load(Graph::Encoder)?, load(Graph::Denoiser)?);
        bundle.check_graphs(&encoder.shape(), &denoiser.shape())?;
        let (encoder, denoiser) = (encoder.bind()?, denoiser.bind()?);
        let steps = computing.denoising_steps.unwrap_or(bundle.scheduler.num_inference_steps);
        let names = bundle.observations.iter().map(|observation| &observation.key);
        let valid = bundle.observations.iter().map(|observation| observation.history.as_ref());
        let valid = valid.map(|history| history.map(|history| encoder.input_index(&history.valid)).transpose());
        Ok(Self {
            observations: names.map(|name| encoder.input_index(name)).collect::<Result<_, _>>()?,
            valid: valid.collect::<Result<_, _>>()?,
            mask: bundle.mask.as_ref().map(|mask| encoder.input_index(&mask.input)).transpose()?,
            sample: denoiser.input_index("sample")?,
            timestep: denoiser.input_index("timestep")?,
            condition: denoiser.input_index("global_cond")?,
            scheduler: Scheduler::new(&bundle.scheduler, steps)?,
            normalizer: Normalizer::of_action(&bundle.action),
            noise: vec![0.0; bundle.horizon * bundle.action.outputs()],
            encoder,
            denoiser,
        })
    }

    /// Numbers of a chunk: horizon x values of an action in the network's output.
    pub fn chunk_len(&self) -> usize {
        self.noise.len()
    }

    /// Steps of denoising.
    pub fn steps(&self) -> usize {
        self.scheduler.timesteps().count()
    }

    /// The noise of a seed, as [`Self::chunk`] draws it: the first sample, and that of each step that adds some.
    pub fn noise(&self, seed: u64) -> (Vec<f32>, Vec<Vec<f32>>) {
        let mut random = Random::new(seed, NOISE);
        let mut draw = || {
            let mut noise = vec![0.0; self.noise.len()];
            random.fill_normal(&mut noise);
            noise
        };
        let first = draw();
        let steps = (0..self.steps()).filter(|at| self.scheduler.wants_noise(*at)).map(|_| draw());
        (first, steps.collect())
    }

    /// Computes a chunk that `trial` can end, and whose numbers must be finite.
    ///
    /// # Errors
    /// As [`Self::chunk`], and with the file from which the first number comes that is not finite.
    pub fn try_out(&mut self, observation: &ObservationTensors, trial: &Trial) -> Result<(), PolicyError> {
        for graph in [&mut self.encoder, &mut self.denoiser] {
            graph.set_trial(Some(trial.clone()));
        }
        let mut chunk = vec![0.0; self.chunk_len()];
        let computed = self.chunk(observation, 0, &mut chunk);
        for graph in [&mut self.encoder, &mut self.denoiser] {
            graph.set_trial(None);
        }
        computed?;
        if chunk.iter().all(|value| value.is_finite()) {
            return Ok(());
        }
        let from = [&self.encoder, &self.denoiser].into_iter().find(|graph| !graph.is_finite());
        Err(GraphProblem::NotFinite.in_graph(from.map_or(POLICY_FILE, BoundGraph::name)).into())
    }

    /// Writes a chunk, action by action, denormalised, as the network gives it: see
    /// [`Composer`](super::compose::Composer) for what is executed. The noise is the seed's.
    ///
    /// # Errors
    /// When onnxruntime fails, the observations are of another bundle, or `out` is not
    /// [`Self::chunk_len`] long. `out` is then invalid.
    pub fn chunk(
        &mut self,
        observation: &ObservationTensors,
        noise_seed: u64,
        out: &mut [f32],
    ) -> Result<(), PolicyError> {
        if out.len() != self.noise.len() {
            return Err(PolicyError::Place { expected: self.noise.len(), found: out.len() });
        }
        for (at, (input, valid)) in self.observations.iter().zip(&self.valid).enumerate() {
            self.encoder.write(*input, observation.values(at))?;
            if let Some(valid) = valid {
                self.encoder.write(*valid, observation.valid(at))?;
            }
        }
        if let Some(mask) = self.mask {
            self.encoder.write(mask, observation.mask())?;
        }
        self.encoder.run(|condition| self.denoiser.write(self.condition, condition))??;

        let mut random = Random::new(noise_seed, NOISE);
        random.fill_normal(out);
        for (at, timestep) in self.scheduler.timesteps().enumerate() {
            let noise = self.scheduler.wants_noise(at).then(|| {
                random.fill_normal(&mut self.noise);
                &*self.noise
            });
            self.denoiser.write(self.sample, out)?;
            self.denoiser.write_integer(self.timestep, timestep)?;
            self.denoiser.run(|prediction| self.scheduler.step(at, out, prediction, noise))?;
        }
        self.normalizer.invert(out);
        Ok(())
    }
}
