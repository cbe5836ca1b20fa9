//! A request to a policy: the samples of the last ticks, as received from the devices.
//!
//! The control loop fills it, the computing thread reads it; it goes back and forth between them and is allocated once.
//!
//! Invariant: nothing here allocates once its cells have grown to the largest samples.

use super::bundle::{Bundle, ObservationSpec};
use super::horizon::ChunkError;
use crate::mask::{PhysicalMask, SizedMask};
use crate::sample::{Encoding, SampleHeader};
use crate::status::{Chunk, ObservedSamples, What};
use crate::time::Stamp;

/// The samples of `To` ticks, and what was present at the last of them.
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
    /// Steps of an observation.
    steps: usize,
    cells: Vec<Cell>,
    present: Vec<bool>,
}

/// One sample.
#[derive(Debug, Clone, Default)]
pub struct Cell {
    /// Its number.
    pub seq: u64,
    /// How `bytes` are encoded.
    pub encoding: Option<Encoding>,
    /// Pixels, of a picture.
    pub width: u32,
    /// Pixels, of a picture.
    pub height: u32,
    /// The payload.
    pub bytes: Vec<u8>,
}

impl Cell {
    /// Copies this sample.
    pub fn set(&mut self, header: &SampleHeader, bytes: &[u8]) {
        self.seq = header.seq;
        self.encoding = Encoding::from_raw(header.encoding);
        (self.width, self.height) = (header.width, header.height);
        self.bytes.clear();
        self.bytes.extend_from_slice(bytes);
    }
}

impl Request {
    /// Room for the observations of a bundle.
    pub fn new(bundle: &Bundle) -> Self {
        let mut cells = Vec::new();
        cells.resize_with(bundle.observations.len() * bundle.n_obs_steps, Cell::default);
        Self { steps: bundle.n_obs_steps, cells, present: vec![false; bundle.observations.len()], ..Self::default() }
    }

    /// The sample of step `step`, 0 the oldest, of observation `observation`.
    pub fn cell(&self, observation: usize, step: usize) -> Option<&Cell> {
        self.cells.get(observation * self.steps + step)
    }

    /// The same, to be filled.
    pub fn cell_mut(&mut self, observation: usize, step: usize) -> Option<&mut Cell> {
        self.cells.get_mut(observation * self.steps + step)
    }

    /// Is the modality of an observation present, with samples for every step?
    pub fn is_present(&self, observation: usize) -> bool {
        self.present.get(observation).copied().unwrap_or(false)
    }

    /// Sets whether it is.
    pub fn set_present(&mut self, observation: usize, present: bool) {
        if let Some(place) = self.present.get_mut(observation) {
            *place = present;
        }
    }

    /// Steps of an observation.
    pub const fn steps(&self) -> usize {
        self.steps
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
    ) -> What {
        What::Chunk(Box::new(Chunk {
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
            let seqs =
                (0..self.steps).filter(|_| self.is_present(at)).filter_map(|step| Some(self.cell(at, step)?.seq));
            ObservedSamples { modality: observation.modality.clone(), seqs: seqs.collect() }
        };
        bundle.observations.iter().enumerate().map(samples).collect()
    }
}
