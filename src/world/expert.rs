//! The expert: a script that knows the block's position and texture, and demonstrates the task.

use rapid_core::random::Random;

use super::world::{AXES, World, stream};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Approach,
    Descend,
    Close,
    Lift,
    Transport,
    Lower,
    Open,
    Retract,
}

/// Height of travel, height of the grasp, and the tolerance for reaching them.
const TRAVEL: f64 = 0.6;
const GRASP: f64 = 0.06;
/// Steps for which it holds the block before lifting it: long enough to feel it.
const DWELL: u32 = 3;

/// A demonstrator for the trial of one seed.
#[derive(Debug, Clone)]
pub struct Expert {
    phase: Phase,
    /// Distance per step.
    stride: f64,
    dwelt: u32,
}

impl Expert {
    /// The demonstrator of trial `seed`.
    pub fn new(seed: u64) -> Self {
        let stride = 0.027 * Random::new(seed, stream::EXPERT).uniform(0.9, 1.25);
        Self { phase: Phase::Approach, stride, dwelt: 0 }
    }

    /// Its next action: targets of x, y, z, grip.
    pub fn act(&mut self, world: &World) -> [f64; AXES] {
        let [x, y, z] = world.position;
        let bin = world.texture.bin();
        let near = |place: [f64; 2], limit: f64| (x - place[0]).hypot(y - place[1]) < limit;
        loop {
            let (arrived, target, grip, next) = match self.phase {
                Phase::Approach => (near(world.block, 0.03), at(world.block, TRAVEL), 1.0, Phase::Descend),
                Phase::Descend => (z < 0.09, at(world.block, GRASP), 1.0, Phase::Close),
                Phase::Close => {
                    self.dwelt += u32::from(world.held);
                    let place = if world.held { [x, y] } else { world.block };
                    (self.dwelt > DWELL, at(place, GRASP), 0.0, Phase::Lift)
                }
                Phase::Lift => (z > 0.5, at([x, y], TRAVEL), 0.0, Phase::Transport),
                Phase::Transport => (near(bin, 0.05), at(bin, TRAVEL), 0.0, Phase::Lower),
                Phase::Lower => (z < 0.1, at(bin, GRASP), 0.0, Phase::Open),
                Phase::Open => (world.grip > 0.95, at([x, y], GRASP), 1.0, Phase::Retract),
                Phase::Retract => (false, at([x, y], TRAVEL), 1.0, Phase::Retract),
            };
            if !arrived {
                return self.towards([x, y, z], target, grip);
            }
            self.phase = next;
        }
    }

    /// A target such that the gripper, which covers 0.8 of the distance to a target, moves at most one step of its
    /// speed.
    fn towards(&self, from: [f64; 3], target: [f64; 3], grip: f64) -> [f64; AXES] {
        let way = [target[0] - from[0], target[1] - from[1], target[2] - from[2]];
        let length = way.iter().map(|part| part * part).sum::<f64>().sqrt();
        let share = (self.stride / length.max(1e-6)).min(1.0) / 0.8;
        [from[0] + way[0] * share, from[1] + way[1] * share, from[2] + way[2] * share, grip]
    }
}

const fn at(place: [f64; 2], height: f64) -> [f64; 3] {
    [place[0], place[1], height]
}
