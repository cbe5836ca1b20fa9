//! The simulated task: grasp a block, feel what it is, sort it. Its wrist camera, its tactile camera and
//! its arm are devices like all others; the arm is the actuator.
//!
//! Invariant: what its devices send is a function of the seed, the actions and the number of the step; when
//! and in which order they are read changes nothing.

mod expert;
mod looks;
mod world;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

pub use expert::Expert;
pub use looks::{Looks, SIDE, SIDE_PIXELS};
pub use world::{AXES, AXIS_COUNT, AXIS_NAMES, MAX_STEPS, Outcome, STEP_HZ, Texture, World};

use super::super::DriverError;
use crate::registry::scenario::{Scene, TaskPart};
use crate::sample::Encoding;

/// Nearly without loss, colours at full resolution: the texture is fine and coloured.
const JPEG_QUALITY: u8 = 95;
const SIDE_U16: u16 = 96;

/// How `part` encodes what it sends, with width and height of the header.
#[must_use]
pub const fn layout(part: TaskPart) -> (Encoding, u32, u32) {
    match part {
        TaskPart::Arm => (Encoding::F64, AXIS_COUNT, 0),
        TaskPart::Wrist | TaskPart::Tactile => (Encoding::Mjpeg, SIDE_PIXELS, SIDE_PIXELS),
    }
}

/// A trial in progress: the world and what it looks like.
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
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let world = World::new(seed);
        let looks = Looks::new(seed, world.texture);
        Self { before: world.clone(), world, looks, command: None, picture: Vec::with_capacity(SIDE * SIDE * 3) }
    }

    /// Sets the action that the actuator follows from the next step on.
    pub fn command(&mut self, target: [f64; AXES]) {
        self.command = Some(target);
    }

    /// Lets a tenth of a second pass. Without a command the arm stays where it is.
    pub fn step(&mut self, shake: f64) {
        let target = self.command.unwrap_or_else(|| self.world.state());
        self.before.clone_from(&self.world);
        self.world.step(target, shake);
    }

    /// Lets time pass until `steps` steps are done.
    pub fn advance_to(&mut self, steps: u32) {
        while self.world.steps() < steps {
            self.step(0.0);
        }
    }

    /// Writes what `part` sends now into `payload`: a JPEG picture, or the four numbers of the state.
    ///
    /// # Errors
    /// When the picture cannot be encoded.
    pub fn sample(&mut self, part: TaskPart, payload: &mut Vec<u8>) -> Result<(), DriverError> {
        self.sample_part_way(part, 1.0, payload)
    }

    /// The same after `share` of the last step, 0 to 1.
    ///
    /// # Errors
    /// When the picture cannot be encoded.
    pub fn sample_part_way(&mut self, part: TaskPart, share: f64, payload: &mut Vec<u8>) -> Result<(), DriverError> {
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
        encoder
            .encode(&self.picture, SIDE_U16, SIDE_U16, ColorType::Rgb)
            .map_err(|error| DriverError::Fatal(format!("a picture of the simulated task: {error}")))
    }
}

/// A trial whose parts are read by streams of their own.
#[derive(Debug, Clone)]
pub struct Shared(Arc<Mutex<Trial>>);

impl Shared {
    /// The trial of a scene, begun with the first of its parts that is opened.
    ///
    /// # Errors
    /// When the scene is of another task.
    pub fn of(scene: &Scene) -> Result<Self, DriverError> {
        let trial = scene.trial.get_or_init(|| Arc::new(Mutex::new(Trial::new(scene.seed))));
        let trial = Arc::clone(trial).downcast().map_err(|_| DriverError::Fatal("not a scene of this task".into()))?;
        Ok(Self(trial))
    }

    /// The trial. A poisoned lock guards numbers that are whole, each of them.
    pub fn trial(&self) -> MutexGuard<'_, Trial> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests;
