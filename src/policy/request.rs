//! A request to a policy: the samples of the last ticks, as received from the devices.
//!
//! The control loop fills it, the computing thread reads it; it goes back and forth between them and is allocated once.
//!
//! Invariant: nothing here allocates once its cells have grown to the largest samples.

use rapid_core::mask::{PhysicalMask, SizedMask};
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;
use rapid_episode::ReferenceSample;
use rapid_status::{Chunk, EventKind, ObservedSamples};

use super::bundle::{Bundle, ObservationSpec};
use super::horizon::ChunkError;

/// The samples of the steps of each observation, and what was present at the last of them.
#[derive(Debug, Clone, Default)]
pub struct Request {
    /// Number of the last tick on the control grid.
    pub tick: u64,
    /// When it was.
    pub stamp: Stamp,
    /// What was present.
    pub mask: PhysicalMask,
    /// Of the noise.
    pub seed: u64,
    /// Of all steps of the first observation, then those of the next.
    cells: Vec<Cell>,
    observations: Vec<Observed>,
}

/// Where the cells of an observation are.
#[derive(Debug, Clone, Copy, Default)]
struct Observed {
    begin: usize,
    steps: usize,
    /// Each of its steps is with or without a sample.
    has_history: bool,
    /// Of one without a history.
    present: bool,
}

/// One sample.
#[derive(Debug, Clone, Default)]
pub struct Cell {
    /// Its number.
    pub seq: u64,
    /// Of which attachment of its device.
    pub epoch: u32,
    /// When it was captured.
    pub capture_ns: u64,
    /// How `bytes` are encoded.
    pub encoding: Option<Encoding>,
    /// Pixels, of a picture.
    pub width: u32,
    /// Pixels, of a picture.
    pub height: u32,
    /// The payload.
    pub bytes: Vec<u8>,
    /// There is one; of an observation without a history [`Request::is_present`] says so.
    valid: bool,
}

impl Cell {
    /// Copies this sample.
    pub fn set(&mut self, header: &SampleHeader, bytes: &[u8]) {
        self.valid = true;
        (self.seq, self.epoch, self.capture_ns) = (header.seq, header.epoch, header.capture_ns);
        self.encoding = Encoding::from_raw(header.encoding);
        (self.width, self.height) = (header.width, header.height);
        self.bytes.clear();
        self.bytes.extend_from_slice(bytes);
    }

    /// The sample, as the reference of an observation.
    pub fn into_reference(self, observation: &ObservationSpec) -> ReferenceSample {
        let header = SampleHeader {
            seq: self.seq,
            epoch: self.epoch,
            capture_ns: self.capture_ns,
            encoding: self.encoding.map_or(0, |encoding| encoding as u32),
            width: self.width,
            height: self.height,
            ..SampleHeader::default()
        };
        let (observation, modality) = (observation.key.clone(), observation.modality.clone());
        ReferenceSample { observation, modality, header, payload: self.bytes }
    }

    /// This step of a history has no sample. The memory is kept.
    pub const fn clear(&mut self) {
        self.valid = false;
    }
}

impl Request {
    /// Room for the observations of a bundle.
    pub fn new(bundle: &Bundle) -> Self {
        let mut cells = Vec::new();
        let observed = |observation: &ObservationSpec| {
            let (begin, steps) = (cells.len(), bundle.steps_of(observation));
            cells.resize_with(begin + steps, Cell::default);
            Observed { begin, steps, has_history: observation.history.is_some(), present: false }
        };
        let observations = bundle.observations.iter().map(observed).collect();
        Self { cells, observations, ..Self::default() }
    }

    /// The cell of step `step`, 0 the oldest, of observation `observation`. What it contains is of this request only if
    /// [`Self::sample`] gives it.
    pub fn cell(&self, observation: usize, step: usize) -> Option<&Cell> {
        self.cells.get(self.place(observation, step)?)
    }

    /// The same, to be filled.
    pub fn cell_mut(&mut self, observation: usize, step: usize) -> Option<&mut Cell> {
        let place = self.place(observation, step)?;
        self.cells.get_mut(place)
    }

    fn place(&self, observation: usize, step: usize) -> Option<usize> {
        let observed = self.observations.get(observation)?;
        (step < observed.steps).then_some(observed.begin + step)
    }

    /// The sample of a step; `None` if the modality of the observation is absent or, with a history, the step has none.
    pub fn sample(&self, observation: usize, step: usize) -> Option<&Cell> {
        let observed = self.observations.get(observation)?;
        self.cell(observation, step).filter(|cell| if observed.has_history { cell.valid } else { observed.present })
    }

    /// Has any step of an observation a sample?
    pub fn has_samples(&self, observation: usize) -> bool {
        (0..self.steps(observation)).any(|step| self.sample(observation, step).is_some())
    }

    /// Is the modality of an observation present, with samples for every step? With a history: is there a sample of its
    /// last step?
    pub fn is_present(&self, observation: usize) -> bool {
        let last = self.steps(observation).checked_sub(1);
        last.is_some_and(|last| self.sample(observation, last).is_some())
    }

    /// Sets whether it is. Of an observation with a history the cells alone say so.
    pub fn set_present(&mut self, observation: usize, present: bool) {
        if let Some(observed) = self.observations.get_mut(observation) {
            observed.present = present;
        }
    }

    /// Sets that an observation has no sample at all.
    fn set_empty(&mut self, observation: usize) {
        self.set_present(observation, false);
        for step in 0..self.steps(observation) {
            if let Some(cell) = self.cell_mut(observation, step) {
                cell.clear();
            }
        }
    }

    /// Sets that no observation has any sample.
    pub fn clear(&mut self) {
        for observation in 0..self.observations.len() {
            self.set_empty(observation);
        }
    }

    /// Steps of an observation.
    pub fn steps(&self, observation: usize) -> usize {
        self.observations.get(observation).map_or(0, |observed| observed.steps)
    }

    /// Whether each step of an observation is with or without a sample.
    pub fn has_history(&self, observation: usize) -> bool {
        self.observations.get(observation).is_some_and(|observed| observed.has_history)
    }

    /// The event that it was answered with `actions`. `devices` are registered; `answered` gives how many of the actions
    /// came too late, or why none is used.
    pub fn answered(
        &self,
        bundle: &Bundle,
        devices: usize,
        latency_ms: f64,
        answered: Result<u64, ChunkError>,
        actions: &[f32],
    ) -> EventKind {
        EventKind::Chunk(Box::new(Chunk {
            tick: self.tick,
            observed_ns: self.stamp.0,
            mask: SizedMask { mask: self.mask, devices },
            seed: self.seed,
            latency_ms,
            used: answered.is_ok(),
            skipped: answered.unwrap_or(0),
            samples: self.samples(bundle),
            actions: actions.to_vec(),
        }))
    }

    /// Which samples these are.
    pub fn samples(&self, bundle: &Bundle) -> Vec<ObservedSamples> {
        let samples = |(at, observation): (usize, &ObservationSpec)| {
            let shown = self.is_present(at) || self.has_history(at);
            let seqs = (0..self.steps(at)).filter(|_| shown).map(|step| Some(self.sample(at, step)?.seq));
            ObservedSamples { modality: observation.modality.clone(), seqs: seqs.collect() }
        };
        bundle.observations.iter().enumerate().map(samples).collect()
    }
}
