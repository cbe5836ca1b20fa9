//! The grasp-and-sort task: a block on a table, a gripper, two bins, one step per tenth of a second.
//!
//! The block's texture determines its bin: triangular to the left, hexagonal to the front. Only the gel of the tactile
//! fingertip shows the texture, and only while it is pressed on the block. Blocks are big or small, whatever their texture
//! (paper, ablation: demonstrations with cubes of one size, or of both).
//!
//! Lengths are in metres, for a large table and blocks of its scale. A world's behaviour follows entirely from its seed and
//! its actions.
//!
//! Invariant: random numbers for the appearance do not affect the dynamics, and the reverse: each has its own stream.

use rapid_core::random::Random;

/// Steps per second, which is also the rate of all its devices, Hz.
pub const STEP_HZ: u32 = 10;
/// Length of a state and of an action: x, y, z, grip.
pub const AXIS_COUNT: u32 = 4;
/// The same as `usize`.
pub const AXES: usize = AXIS_COUNT as usize;
/// A trial that takes longer has failed.
pub const MAX_STEPS: u32 = 260;
/// Maximum distance of the block from the middle of its bin.
const TOLERANCE: f64 = 0.18;
/// Further closing of the gripper at which it presses its hardest, as a share of the block's width.
const FULL_PRESS: f64 = 8.0 / 9.0;

const POSITION_MIN: [f64; 3] = [-1.1, -1.0, 0.03];
const POSITION_MAX: [f64; 3] = [1.0, 1.0, 0.9];
/// Maximum distance of the gripper per step, and the share of the distance to its target that it attempts.
const STRIDE: f64 = 0.06;
const GAIN: f64 = 0.8;
/// The same for its fingers and for the pressure they build up.
const GRIP_STRIDE: f64 = 0.15;
const PRESS_STRIDE: f64 = 0.35;
/// Deviation of a step from its intended end.
const JITTER: f64 = 0.002;

/// The texture of the block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Texture {
    /// Three families of ridges; belongs to the left bin.
    Triangular,
    /// Honeycomb; belongs to the front bin.
    Hexagonal,
}

impl Texture {
    /// Its word in tags and output.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Triangular => "triangular",
            Self::Hexagonal => "hexagonal",
        }
    }

    /// Middle of the bin it belongs to.
    pub const fn bin(self) -> [f64; 2] {
        match self {
            Self::Triangular => [-0.8, -0.3],
            Self::Hexagonal => [0.0, 0.6],
        }
    }

    /// The other texture.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::Triangular => Self::Hexagonal,
            Self::Hexagonal => Self::Triangular,
        }
    }
}

/// The size of the block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Size {
    /// As wide as the gripper opens by 0.45.
    Big,
    /// Two thirds of it.
    Small,
}

impl Size {
    /// Its word in tags and output.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Big => "big",
            Self::Small => "small",
        }
    }

    /// Opening of the gripper at which it touches the block.
    const fn width(self) -> f64 {
        match self {
            Self::Big => 0.45,
            Self::Small => 0.3,
        }
    }

    /// Half of its edge, m.
    pub(super) const fn half_edge(self) -> f64 {
        match self {
            Self::Big => 0.12,
            Self::Small => 0.08,
        }
    }
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The block is in the bin of its texture.
    Success,
    /// It is in the other bin.
    WrongBin,
    /// It is in neither.
    Incomplete,
}

/// The state of the task.
#[derive(Debug, Clone)]
pub struct World {
    /// Texture of the block.
    pub texture: Texture,
    /// Size of the block.
    pub size: Size,
    /// Position of the block.
    pub block: [f64; 2],
    /// Rotation of the block, radians.
    pub yaw: f64,
    /// Position of the gripper.
    pub position: [f64; 3],
    /// Opening of the gripper, 0 to 1.
    pub grip: f64,
    /// The block is between the fingers.
    pub held: bool,
    /// Pressure of the gel on the block, 0 to 1.
    pub pressure: f64,
    released: bool,
    steps: u32,
    strongest: f64,
    noise: Random,
}

impl World {
    /// The beginning of trial `seed`.
    pub fn new(seed: u64) -> Self {
        let mut random = Random::new(seed, stream::LAYOUT);
        let texture = if random.below(2) == 0 { Texture::Triangular } else { Texture::Hexagonal };
        let size = if Random::new(seed, stream::SIZE).below(2) == 0 { Size::Big } else { Size::Small };
        let block = [random.uniform(-0.35, 0.35), random.uniform(-0.5, -0.1)];
        let yaw = random.uniform(-0.25, 0.25);
        let position =
            [random.uniform(-0.15, 0.15), -0.3 + random.uniform(-0.15, 0.15), 0.6 + random.uniform(-0.05, 0.05)];
        Self {
            texture,
            size,
            block,
            yaw,
            position,
            grip: 1.0,
            held: false,
            pressure: 0.0,
            released: false,
            steps: 0,
            strongest: random.uniform(0.5, 1.0),
            noise: Random::new(seed, stream::DYNAMICS),
        }
    }

    /// x, y, z, grip.
    pub const fn state(&self) -> [f64; AXES] {
        let [x, y, z] = self.position;
        [x, y, z, self.grip]
    }

    /// Steps done.
    pub const fn steps(&self) -> u32 {
        self.steps
    }

    /// Moves towards the target `action` (x, y, z, grip) for a tenth of a second. `shake` is an additional deviation of
    /// the gripper: demonstrations have some, so that they contain corrections.
    pub fn step(&mut self, action: [f64; AXES], shake: f64) {
        for (axis, target) in action.into_iter().take(3).enumerate() {
            let way = (GAIN * (target - self.position[axis])).clamp(-STRIDE, STRIDE);
            let miss = f64::from(self.noise.normal()) * (JITTER + shake);
            self.position[axis] = (self.position[axis] + way + miss).clamp(POSITION_MIN[axis], POSITION_MAX[axis]);
        }
        let [x, y, z] = self.position;
        let (wish, width) = (action[3].clamp(0.0, 1.0), self.size.width());
        let mut grip = self.grip + (wish - self.grip).clamp(-GRIP_STRIDE, GRIP_STRIDE);
        if self.held {
            if grip > width + 0.1 {
                (self.held, self.released, self.pressure) = (false, true, 0.0);
                self.block = [x, y];
            } else if wish < width {
                grip = grip.max(width);
            }
        } else if (self.block[0] - x).abs() < 0.09 && (self.block[1] - y).abs() < 0.09 && z < 0.16 && grip < width {
            (self.held, self.released) = (true, false);
            grip = width;
        }
        // Drawn at every step, so that later draws do not depend on when the block was held.
        let flutter = f64::from(self.noise.normal()) * 0.01;
        if self.held {
            let wanted = self.strongest * ((width - wish) / (FULL_PRESS * width)).clamp(0.0, 1.0);
            let towards = (wanted - self.pressure).clamp(-PRESS_STRIDE, PRESS_STRIDE);
            self.pressure = (self.pressure + towards + flutter).max(0.0);
            self.block = [x, y];
        }
        self.grip = grip.clamp(0.0, 1.0);
        self.steps += 1;
    }

    /// The world between `before`, one step earlier, and this one, after `share` of that step (0 to 1): positions are
    /// interpolated, and a grasp or release happens in the middle of the step.
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

    /// Whether the trial is over: the block was put down in a bin and the gripper is up again, or time is up.
    pub fn is_done(&self) -> bool {
        let placed = self.is_in(self.texture) || self.is_in(self.texture.other());
        placed && self.position[2] > 0.3 || self.steps >= MAX_STEPS
    }

    /// The outcome if the trial ended now.
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

/// Random streams of one seed.
pub(super) mod stream {
    pub(crate) const LAYOUT: u64 = 0;
    pub(crate) const DYNAMICS: u64 = 1;
    pub(crate) const LOOKS: u64 = 2;
    pub(crate) const WRIST_NOISE: u64 = 3;
    pub(crate) const TACTILE_NOISE: u64 = 4;
    pub(crate) const EXPERT: u64 = 5;
    pub(crate) const TOUCH: u64 = 6;
    pub(crate) const SIZE: u64 = 7;
}
