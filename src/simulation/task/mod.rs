//! The simulated task: grasp a block, feel its texture, sort it. Its wrist camera, its tactile camera and its arm are
//! devices like all others; the arm is the actuator.
//!
//! Invariant: the samples of its devices are a function of the seed, the actions and the number of the step; the time
//! and order of reads have no effect.

mod expert;
mod looks;
mod world;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use jpeg_encoder::{ColorType, Encoder, EncodingError, SamplingFactor};

pub use expert::Expert;
pub use looks::{Looks, SIDE, SIDE_PIXELS};
pub use world::{AXES, AXIS_COUNT, MAX_STEPS, Outcome, STEP_HZ, Texture, World};

use super::TaskPart;
use crate::sample::Encoding;

/// Nearly lossless, colours at full resolution: the texture is fine and coloured.
const JPEG_QUALITY: u8 = 95;
const SIDE_U16: u16 = 96;

/// A picture of the task cannot be encoded.
#[derive(Debug, thiserror::Error)]
#[error("a picture of the simulated task: {0}")]
pub struct PictureError(#[from] EncodingError);

/// Encoding of the samples of `part`, with width and height of the header.
pub const fn layout(part: TaskPart) -> (Encoding, u32, u32) {
    match part {
        TaskPart::Arm => (Encoding::F64, AXIS_COUNT, 0),
        TaskPart::Wrist | TaskPart::Tactile => (Encoding::Mjpeg, SIDE_PIXELS, SIDE_PIXELS),
    }
}

/// A trial in progress: the world and its appearance.
#[derive(Debug)]
pub struct Trial {
    /// The world.
    pub world: World,
    /// The same one step earlier.
    before: World,
    looks: Looks,
    /// The last action.
    command: Option<[f64; AXES]>,
    picture: Vec<u8>,
}

impl Trial {
    /// The beginning of trial `seed`.
    pub fn new(seed: u64) -> Self {
        let world = World::new(seed);
        let looks = Looks::new(seed, world.texture);
        Self { before: world.clone(), world, looks, command: None, picture: Vec::with_capacity(SIDE * SIDE * 3) }
    }

    /// Sets the action that the actuator follows from the next step on.
    pub fn command(&mut self, target: [f64; AXES]) {
        self.command = Some(target);
    }

    /// Advances a tenth of a second. Without a command the arm stays in place.
    pub fn step(&mut self, shake: f64) {
        let target = self.command.unwrap_or_else(|| self.world.state());
        self.before.clone_from(&self.world);
        self.world.step(target, shake);
    }

    /// Advances until `steps` steps are done.
    pub fn advance_to(&mut self, steps: u32) {
        while self.world.steps() < steps {
            self.step(0.0);
        }
    }

    /// Writes the current sample of `part` into `payload`: a JPEG picture, or the four numbers of the state.
    ///
    /// # Errors
    /// When the picture cannot be encoded.
    pub fn sample(&mut self, part: TaskPart, payload: &mut Vec<u8>) -> Result<(), PictureError> {
        self.sample_part_way(part, 1.0, payload)
    }

    /// The same after `share` of the last step, 0 to 1.
    ///
    /// # Errors
    /// When the picture cannot be encoded.
    pub fn sample_part_way(&mut self, part: TaskPart, share: f64, payload: &mut Vec<u8>) -> Result<(), PictureError> {
        payload.clear();
        let between = (share < 1.0).then(|| self.world.part_way_from(&self.before, share));
        let world = between.as_ref().unwrap_or(&self.world);
        match part {
            TaskPart::Wrist => self.looks.wrist(world, &mut self.picture),
            TaskPart::Tactile => self.looks.tactile(world, &mut self.picture),
            TaskPart::Arm => {
                payload.extend(world.state().into_iter().flat_map(f64::to_le_bytes));
                return Ok(());
            }
        }
        let mut encoder = Encoder::new(payload, JPEG_QUALITY);
        encoder.set_sampling_factor(SamplingFactor::F_1_1);
        Ok(encoder.encode(&self.picture, SIDE_U16, SIDE_U16, ColorType::Rgb)?)
    }
}

/// A trial whose parts are read by separate streams.
#[derive(Debug, Clone)]
pub struct SharedTrial {
    seed: u64,
    trial: Arc<Mutex<Trial>>,
}

impl SharedTrial {
    /// The beginning of trial `seed`.
    pub fn new(seed: u64) -> Self {
        Self { seed, trial: Arc::new(Mutex::new(Trial::new(seed))) }
    }

    /// Exclusive access to the trial. A poisoned lock guards numbers that are each complete.
    pub fn lock(&self) -> MutexGuard<'_, Trial> {
        self.trial.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PartialEq for SharedTrial {
    fn eq(&self, other: &Self) -> bool {
        self.seed == other.seed
    }
}

#[cfg(test)]
mod tests;
