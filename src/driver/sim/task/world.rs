//! The grasp-and-sort task: a block on a table, a gripper, two bins, one step a tenth of a second.
//!
//! The block's texture decides which bin it belongs to: triangular to the left, hexagonal to the front. Only
//! the gel of the tactile fingertip shows the texture, and only while it is pressed on the block.
//!
//! Lengths are in metres, of a large table with a large block. Everything a world does follows from its
//! seed and the actions it is given.
//!
//! Invariant: what is drawn of the looks moves nothing of the dynamics, and the reverse: each has a stream
//! of its own.

use crate::random::Random;

/// Steps a second, which is also the rate of all its devices, Hz.
pub const STEP_HZ: u32 = 10;
/// Numbers of a state and of an action: x, y, z, grip.
pub const AXIS_COUNT: u32 = 4;
/// The same, to count with.
pub const AXES: usize = AXIS_COUNT as usize;
/// Their names.
pub const AXIS_NAMES: [&str; AXES] = ["x", "y", "z", "grip"];
/// A trial that takes longer has failed.
pub const MAX_STEPS: u32 = 260;
/// How near the middle of its bin the block must lie.
const TOLERANCE: f64 = 0.18;
/// Opening of the gripper at which it touches the block.
const BLOCK_WIDTH: f64 = 0.45;

const POSITION_MIN: [f64; 3] = [-1.1, -1.0, 0.03];
const POSITION_MAX: [f64; 3] = [1.0, 1.0, 0.9];
/// The furthest the gripper moves in one step, and how much of the way to its target it tries.
const STRIDE: f64 = 0.06;
const GAIN: f64 = 0.8;
/// The same of its fingers and of the pressure they build up.
const GRIP_STRIDE: f64 = 0.15;
const PRESS_STRIDE: f64 = 0.35;
/// Deviation of a step from where it should end.
const JITTER: f64 = 0.002;

/// What the block feels like.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Texture {
    /// Three families of ridges; belongs to the left.
    Triangular,
    /// Honeycomb; belongs to the front.
    Hexagonal,
}

impl Texture {
    /// Middle of the bin it belongs to.
    #[must_use]
    pub const fn bin(self) -> [f64; 2] {
        match self {
            Self::Triangular => [-0.8, -0.3],
            Self::Hexagonal => [0.0, 0.6],
        }
    }

    /// The other one.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::Triangular => Self::Hexagonal,
            Self::Hexagonal => Self::Triangular,
        }
    }
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The block lies in the bin of its texture.
    Success,
    /// It lies in the other one.
    WrongBin,
    /// It lies in neither.
    Incomplete,
}

/// The state of the task.
#[derive(Debug, Clone)]
pub struct World {
    /// What the block feels like.
    pub texture: Texture,
    /// Where the block lies.
    pub block: [f64; 2],
    /// How it is turned, radians.
    pub yaw: f64,
    /// Where the gripper is.
    pub position: [f64; 3],
    /// Opening of the gripper, 0 to 1.
    pub grip: f64,
    /// The block is between the fingers.
    pub held: bool,
    /// How hard the gel is pressed on it, 0 to 1.
    pub pressure: f64,
    released: bool,
    steps: u32,
    strongest: f64,
    noise: Random,
}

impl World {
    /// The beginning of the trial `seed`.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let mut random = Random::new(seed, stream::LAYOUT);
        let texture = if random.below(2) == 0 { Texture::Triangular } else { Texture::Hexagonal };
        let block = [random.uniform(-0.35, 0.35), random.uniform(-0.5, -0.1)];
        let yaw = random.uniform(-0.25, 0.25);
        let position =
            [random.uniform(-0.15, 0.15), -0.3 + random.uniform(-0.15, 0.15), 0.6 + random.uniform(-0.05, 0.05)];
        Self {
            texture,
            block,
            yaw,
            position,
            grip: 1.0,
            held: false,
            pressure: 0.0,
            released: false,
            steps: 0,
            strongest: random.uniform(0.6, 1.0),
            noise: Random::new(seed, stream::DYNAMICS),
        }
    }

    /// x, y, z, grip.
    #[must_use]
    pub const fn state(&self) -> [f64; AXES] {
        let [x, y, z] = self.position;
        [x, y, z, self.grip]
    }

    /// Steps done.
    #[must_use]
    pub const fn steps(&self) -> u32 {
        self.steps
    }

    /// Moves towards the target `action` (x, y, z, grip) for a tenth of a second. `shake` is the deviation
    /// by which the gripper misses, beside its own: demonstrations are given some, so that there is
    /// something to correct in them.
    pub fn step(&mut self, action: [f64; AXES], shake: f64) {
        for (axis, target) in action.into_iter().take(3).enumerate() {
            let way = (GAIN * (target - self.position[axis])).clamp(-STRIDE, STRIDE);
            let miss = f64::from(self.noise.normal()) * (JITTER + shake);
            self.position[axis] = (self.position[axis] + way + miss).clamp(POSITION_MIN[axis], POSITION_MAX[axis]);
        }
        let [x, y, z] = self.position;
        let wish = action[3].clamp(0.0, 1.0);
        let mut grip = self.grip + (wish - self.grip).clamp(-GRIP_STRIDE, GRIP_STRIDE);
        if self.held {
            if grip > BLOCK_WIDTH + 0.1 {
                (self.held, self.released, self.pressure) = (false, true, 0.0);
                self.block = [x, y];
            } else if wish < BLOCK_WIDTH {
                grip = grip.max(BLOCK_WIDTH);
            }
        } else if (self.block[0] - x).abs() < 0.09 && (self.block[1] - y).abs() < 0.09 && z < 0.16 && grip < BLOCK_WIDTH
        {
            (self.held, self.released) = (true, false);
            grip = BLOCK_WIDTH;
        }
        // Drawn at every step, so that what is drawn later does not depend on when the block was held.
        let flutter = f64::from(self.noise.normal()) * 0.01;
        if self.held {
            let wanted = self.strongest * ((BLOCK_WIDTH - wish) / 0.4).clamp(0.0, 1.0);
            let towards = (wanted - self.pressure).clamp(-PRESS_STRIDE, PRESS_STRIDE);
            self.pressure = (self.pressure + towards + flutter).max(0.0);
            self.block = [x, y];
        }
        self.grip = grip.clamp(0.0, 1.0);
        self.steps += 1;
    }

    /// The world on its way here from `before`, one step earlier, after `share` of that step (0 to 1): what moves
    /// is in between, and what was grasped or let go of was so in the middle of the step.
    #[must_use]
    pub fn part_way_from(&self, before: &Self, share: f64) -> Self {
        let between = |from: f64, to: f64| from + (to - from) * share;
        let mut world = if share < 0.5 { before.clone() } else { self.clone() };
        for (place, (from, to)) in world.position.iter_mut().zip(before.position.iter().zip(self.position)) {
            *place = between(*from, to);
        }
        for (place, (from, to)) in world.block.iter_mut().zip(before.block.iter().zip(self.block)) {
            *place = between(*from, to);
        }
        world.grip = between(before.grip, self.grip);
        world.pressure = between(before.pressure, self.pressure);
        world
    }

    /// Is the trial over? The block is put down in a bin and the gripper up again, or time is up.
    #[must_use]
    pub fn is_done(&self) -> bool {
        let placed = self.is_in(self.texture) || self.is_in(self.texture.other());
        placed && self.position[2] > 0.3 || self.steps >= MAX_STEPS
    }

    /// How the trial ended, if it ended now.
    #[must_use]
    pub fn outcome(&self) -> Outcome {
        if self.is_in(self.texture) {
            Outcome::Success
        } else if self.is_in(self.texture.other()) {
            Outcome::WrongBin
        } else {
            Outcome::Incomplete
        }
    }

    fn is_in(&self, bin: Texture) -> bool {
        let [x, y] = bin.bin();
        !self.held && self.released && (self.block[0] - x).hypot(self.block[1] - y) < TOLERANCE
    }
}

/// Streams of one seed.
pub(super) mod stream {
    pub(in super::super) const LAYOUT: u64 = 0;
    pub(in super::super) const DYNAMICS: u64 = 1;
    pub(in super::super) const LOOKS: u64 = 2;
    pub(in super::super) const WRIST_NOISE: u64 = 3;
    pub(in super::super) const TACTILE_NOISE: u64 = 4;
    pub(in super::super) const EXPERT: u64 = 5;
}
