//! The complete policy: requests in, action chunks out.
//!
//! Invariant: the same request gives the same chunk, given the same reference pictures.
//! Invariant: samples of an absent modality are not read: its numbers are zeros and its element of the mask is 0.
//! Invariant: a policy that is loaded has computed a finite chunk ([`Model::load`]).
//! Invariant: a picture of a history is converted once, as long as it is a step of one request after another.

use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use rapid_core::sample::Encoding;
use rapid_registry::Provider;

use super::bundle::{Bundle, ObservationInput, POLICY_FILE, VectorOperation};
use super::graphs::{GraphError, GraphProblem, Trial};
use super::observation::{ObservationTensors, VectorError};
use super::onnxruntime::Environment;
use super::picture::{Picture, PictureError, Preprocessor};
use super::request::{Cell, Request};
use super::sampler::{Computing, PolicyError, Sampler};

/// Why a request has no answer.
#[derive(Debug, thiserror::Error)]
pub enum AnswerError {
    /// A sample cannot be used.
    #[error("{modality}: {reason}")]
    Sample {
        /// The modality.
        modality: String,
        /// Why.
        reason: SampleError,
    },
    /// The graphs.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// Why a sample cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SampleError {
    /// It is a picture.
    #[error(transparent)]
    Picture(#[from] PictureError),
    /// It is a vector.
    #[error(transparent)]
    Vector(#[from] VectorError),
    /// Its encoding is not accepted by any policy.
    #[error("samples of an unknown encoding")]
    Encoding,
}

/// Time for the trial of a policy: many times what a chunk may take that is worth to be computed.
const LIMIT: Duration = Duration::from_mins(1);
/// The same where the first run compiles the graphs.
const LIMIT_COMPILED: Duration = Duration::from_mins(20);
/// Time for the node that a graph computes when its trial is ended.
const GRACE: Duration = Duration::from_secs(5);
/// Chunks that are timed when a policy is loaded.
const REHEARSALS: usize = 3;

/// See the module's comment.
#[derive(Debug)]
pub struct Model {
    inputs: Vec<InputBuffer>,
    tensors: ObservationTensors,
    sampler: Sampler,
}

#[derive(Debug)]
struct InputBuffer {
    modality: String,
    /// `None` for a vector.
    pictures: Option<Preprocessor>,
    /// Values of a vector.
    numbers: Vec<f64>,
    /// Of a vector that is its first sample: whether `numbers` are of that. `None` for all others.
    has_first: Option<bool>,
    /// The sample with which all later ones are compared, or which stands for them, until it is reported.
    first: Option<Cell>,
    /// Of a history, the sample whose numbers each of its steps in the tensors has.
    written: Vec<Option<SampleId>>,
}

/// Tells the samples of a modality from one another: number, attachment, time of capture.
type SampleId = (u64, u32, u64);

impl Model {
    /// Loads the graphs of a bundle, and computes a chunk on trial: from an observation in which all is present, and every
    /// picture and number is the middle of its range.
    ///
    /// # Errors
    /// When the graphs do not match the bundle, or the chunk is not finite, or not there within a minute (twenty where it is
    /// not computed on the processor).
    pub fn load(bundle: &Bundle, environment: &Environment, computing: Computing) -> Result<Self, PolicyError> {
        let limit = if computing.on.provider == Provider::Cpu { LIMIT } else { LIMIT_COMPILED };
        Self::load_within(bundle, environment, computing, limit)
    }

    /// As [`Self::load`], with this limit of the trial.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_within(
        bundle: &Bundle,
        environment: &Environment,
        computing: Computing,
        limit: Duration,
    ) -> Result<Self, PolicyError> {
        let inputs = bundle.observations.iter().map(|observation| InputBuffer {
            modality: observation.modality.clone(),
            pictures: match observation.input {
                ObservationInput::Image(image) => Some(Preprocessor::new(image, &observation.normalization)),
                ObservationInput::Vector(_) => None,
            },
            numbers: Vec::new(),
            has_first: match &observation.input {
                ObservationInput::Vector(vector) => vector.operation.map(|VectorOperation::FirstOfRun| false),
                ObservationInput::Image(_) => None,
            },
            first: None,
            written: vec![None; observation.history.as_ref().map_or(0, |history| history.steps)],
        });
        let sampler = try_out(Sampler::new(bundle, environment, computing)?, bundle, limit)?;
        Ok(Self { inputs: inputs.collect(), tensors: ObservationTensors::new(bundle), sampler })
    }

    /// The median time of a chunk: the first one, which is slower, was that of the trial. The observation is empty: the work
    /// is the same.
    ///
    /// # Errors
    /// When onnxruntime fails.
    pub fn rehearse(&mut self) -> Result<Duration, PolicyError> {
        let mut chunk = vec![0.0; self.chunk_len()];
        let mut times = [Duration::ZERO; REHEARSALS];
        for time in &mut times {
            let begun = Instant::now();
            self.sampler.chunk(&self.tensors, 0, &mut chunk)?;
            *time = begun.elapsed();
        }
        times.sort_unstable();
        Ok(times[REHEARSALS / 2])
    }

    /// The tensors of the last observation.
    pub const fn tensors(&self) -> &ObservationTensors {
        &self.tensors
    }

    /// The noise of a seed: the first sample of a chunk, and that of each step that adds some.
    pub fn noise(&self, seed: u64) -> (Vec<f32>, Vec<Vec<f32>>) {
        self.sampler.noise(seed)
    }

    /// Values of a chunk.
    pub fn chunk_len(&self) -> usize {
        self.sampler.chunk_len()
    }

    /// The samples that became references since the last call, each with the position of its observation.
    pub fn take_firsts(&mut self) -> impl Iterator<Item = (usize, Cell)> {
        self.inputs.iter_mut().enumerate().filter_map(|(at, input)| Some((at, input.first.take()?)))
    }

    /// A new episode: the next sample of each modality is its first.
    pub fn reset(&mut self) {
        for input in &mut self.inputs {
            input.first = None;
            input.has_first = input.has_first.map(|_| false);
            // They were compared with the reference of the last episode.
            input.written.fill(None);
            if let Some(reference) = input.pictures.as_mut().and_then(Preprocessor::reference) {
                reference.reset();
            }
        }
    }

    /// Writes the chunk that answers `request` into `chunk`, action by action.
    ///
    /// # Errors
    /// When a sample cannot be used or onnxruntime fails.
    pub fn answer(&mut self, request: &Request, chunk: &mut [f32]) -> Result<(), AnswerError> {
        self.observe(request)?;
        Ok(self.sampler.chunk(&self.tensors, request.seed, chunk)?)
    }

    /// Fills the tensors.
    ///
    /// # Errors
    /// When a sample cannot be used.
    pub fn observe(&mut self, request: &Request) -> Result<&ObservationTensors, AnswerError> {
        for (at, input) in self.inputs.iter_mut().enumerate() {
            self.tensors.set_present(at, request.is_present(at));
            for step in 0..request.steps(at) {
                let written = match request.sample(at, step) {
                    sample if request.has_history(at) => {
                        let is_newest = step + 1 == request.steps(at);
                        input.write_history(sample, (at, step), is_newest, &mut self.tensors)
                    }
                    Some(cell) => input.write(cell, at, step, &mut self.tensors),
                    None => Ok(()),
                };
                written.map_err(|reason| AnswerError::Sample { modality: input.modality.clone(), reason })?;
            }
        }
        Ok(&self.tensors)
    }
}

/// Computes a chunk on a thread of its own: what does not even end when it is told to is left behind.
fn try_out(mut sampler: Sampler, bundle: &Bundle, limit: Duration) -> Result<Sampler, PolicyError> {
    let mut observation = ObservationTensors::new(bundle);
    for at in 0..bundle.observations.len() {
        observation.set_present(at, true);
        (0..observation.valid(at).len()).for_each(|step| observation.set_valid(at, step, true));
    }
    let trial = Trial::new()?;
    let (done, result) = sync_channel(1);
    let thread = std::thread::Builder::new().name("policy-trial".to_owned()).spawn({
        let trial = trial.clone();
        move || {
            let tried = sampler.try_out(&observation, &trial).map(|()| sampler);
            // Nobody waits any longer.
            let _ = done.send(tried);
        }
    })?;
    let endless = |name: &str| Err(GraphProblem::Endless(limit).in_graph(name).into());
    match result.recv_timeout(limit) {
        Ok(tried) => tried,
        Err(RecvTimeoutError::Disconnected) => match thread.join() {
            Err(panic) => std::panic::resume_unwind(panic),
            Ok(()) => endless(POLICY_FILE),
        },
        Err(RecvTimeoutError::Timeout) => {
            trial.end();
            match result.recv_timeout(GRACE) {
                Ok(Err(PolicyError::Graph(GraphError { name, what: GraphProblem::Run(_) }))) => endless(&name),
                Ok(tried) => tried,
                Err(_) => endless(POLICY_FILE),
            }
        }
    }
}

impl InputBuffer {
    /// Writes a step of a history, the oldest first: the first picture becomes the reference of the others. The newest
    /// must be usable, as that of any observation; an older one that is not is as good as none: it would end the policy's
    /// answers for as long as it is a step.
    fn write_history(
        &mut self,
        sample: Option<&Cell>,
        (at, step): (usize, usize),
        is_newest: bool,
        tensors: &mut ObservationTensors,
    ) -> Result<(), SampleError> {
        let which = sample.map(|cell| (cell.seq, cell.epoch, cell.capture_ns));
        let from = which.and_then(|_| self.written.iter().position(|written| *written == which));
        // In case that this one cannot be used.
        self.set_written(step, None);
        tensors.set_valid(at, step, sample.is_some());
        match (sample, from) {
            // The steps of the last request were others, mostly of the same pictures.
            (Some(_), Some(from)) => tensors.copy_step(at, from, step),
            (Some(cell), None) => match self.write(cell, at, step, tensors) {
                Ok(()) => {}
                Err(error) if is_newest => return Err(error),
                Err(_) => {
                    tensors.set_valid(at, step, false);
                    return Ok(());
                }
            },
            (None, _) => {}
        }
        self.set_written(step, which);
        Ok(())
    }

    fn set_written(&mut self, step: usize, which: Option<SampleId>) {
        if let Some(written) = self.written.get_mut(step) {
            *written = which;
        }
    }

    fn write(
        &mut self,
        cell: &Cell,
        at: usize,
        step: usize,
        tensors: &mut ObservationTensors,
    ) -> Result<(), SampleError> {
        let encoding = cell.encoding.ok_or(SampleError::Encoding)?;
        if let Some(pictures) = &mut self.pictures {
            let Some(place) = tensors.step_mut(at, step) else { return Ok(()) };
            let is_first = pictures.reference().is_some_and(|reference| !reference.is_taken());
            let picture = Picture { encoding, width: cell.width, height: cell.height, bytes: &cell.bytes };
            pictures.write(&picture, place)?;
            if is_first {
                self.first = Some(cell.clone());
            }
            return Ok(());
        }
        if self.has_first != Some(true) {
            let (numbers, rest) = cell.bytes.as_chunks::<8>();
            if encoding != Encoding::F64 || !rest.is_empty() {
                return Err(SampleError::Encoding);
            }
            self.numbers.clear();
            self.numbers.extend(numbers.iter().map(|number| f64::from_le_bytes(*number)));
        }
        tensors.write_vector(at, step, &self.numbers)?;
        // One that was refused is not the first.
        if self.has_first.is_some_and(|has_first| !has_first) {
            self.has_first = Some(true);
            self.first = Some(cell.clone());
        }
        Ok(())
    }
}
