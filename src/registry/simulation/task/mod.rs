//! The simulated task: grasp a block, feel its texture, sort it. Its wrist camera, its tactile camera and its arm are
//! devices like all others; the arm is the actuator. With the gripper in a hand, a phone and the gripper itself are in place of
//! the arm.
//!
//! Invariant: the samples of its devices are a function of the seed, the actions and the number of the step; the time
//! and order of reads have no effect.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rapid_pictures::jpeg::{EncodeError, Values};

pub use rapid_world::{
    AXES, AXIS_COUNT, Expert, Looks, MAX_STEPS, Outcome, SIDE, SIDE_PIXELS, STEP_HZ, Size, Texture, Touch,
    UNSEEN_PERIOD, World,
};

use rapid_core::sample::Encoding;

use super::TaskPart;

/// Nearly lossless, colours at full resolution: the texture is fine and coloured.
const JPEG_QUALITY: u8 = 95;
const SIDE_U16: u16 = 96;

/// A picture of the task cannot be encoded.
#[derive(Debug, thiserror::Error)]
#[error("a picture of the simulated task: {0}")]
pub struct PictureError(#[from] EncodeError);

/// Encoding of the samples of `part`, with width and height of the header.
pub const fn layout(part: TaskPart) -> (Encoding, u32, u32) {
    match part.numbers() {
        Some(count) => (Encoding::F64, count, 0),
        None => (Encoding::Mjpeg, SIDE_PIXELS, SIDE_PIXELS),
    }
}

/// Steps before the arm follows actions again after the next block was put on the table: the policy sees it first.
const REST: u32 = 20;

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ended {
    /// Its seed.
    pub seed: u64,
    /// Where the block is.
    pub outcome: Outcome,
    /// Steps that it took.
    pub steps: u32,
}

/// A trial in progress: the world and its appearance. In real time it is followed by the next one ([`Self::advance_to`]).
#[derive(Debug)]
pub struct Trial {
    seed: u64,
    /// Steps of the trials before it.
    earlier: u32,
    /// Steps in which the arm follows no action.
    rest: u32,
    ended: Vec<Ended>,
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
        Self {
            seed,
            earlier: 0,
            rest: 0,
            ended: Vec::new(),
            before: world.clone(),
            world,
            looks,
            command: None,
            picture: Vec::with_capacity(SIDE * SIDE * 3),
        }
    }

    /// Sets the action that the actuator follows from the next step on.
    pub fn command(&mut self, target: [f64; AXES]) {
        if self.world.steps() >= self.rest {
            self.command = Some(target);
        }
    }

    /// Advances a tenth of a second. Without a command the arm stays in place.
    pub fn step(&mut self, shake: f64) {
        let target = self.command.unwrap_or_else(|| self.world.state());
        self.before.clone_from(&self.world);
        self.world.step(target, shake);
    }

    /// Advances until `steps` steps are done. When the block is in a bin, or time is up, the next trial begins: with the next
    /// seed, the arm back at a start, and the gel that it has.
    pub fn advance_to(&mut self, steps: u32) {
        while self.earlier + self.world.steps() < steps {
            self.step(0.0);
            // An arm without a policy rests, and nothing ends.
            if self.command.is_some() && self.world.is_done() {
                self.next();
            }
        }
    }

    fn next(&mut self) {
        let (outcome, steps) = (self.world.outcome(), self.world.steps());
        self.ended.push(Ended { seed: self.seed, outcome, steps });
        self.earlier += steps;
        self.seed = self.seed.wrapping_add(1);
        self.world = World::new(self.seed);
        self.before.clone_from(&self.world);
        self.looks.next(self.seed, self.world.texture);
        self.command = None;
        self.rest = REST;
    }

    /// The trials that have ended since the last call.
    pub fn ended(&mut self) -> Vec<Ended> {
        std::mem::take(&mut self.ended)
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
            TaskPart::Arm => put(payload, world.state()),
            TaskPart::Gripper => put(payload, [world.grip]),
            TaskPart::Phone => {
                let [x, y, z] = world.position;
                // It is not turned: its frame is the gripper's, column by column.
                let columns = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [x, y, z, 1.0]];
                put(payload, columns.into_iter().flatten());
            }
        }
        if part.numbers().is_some() {
            return Ok(());
        }
        Ok(rapid_pictures::jpeg::encode(&self.picture, [SIDE_U16; 2], Values::Rgb, JPEG_QUALITY, payload)?)
    }
}

fn put(payload: &mut Vec<u8>, numbers: impl IntoIterator<Item = f64>) {
    payload.extend(numbers.into_iter().flat_map(f64::to_le_bytes));
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
