//! Demonstrations of the simulated task: the expert acts, the recorder records.

use std::sync::Arc;

use rapid_core::time::{Stamp, WallClock};
use rapid_episode::record::stepped::Stepped;
use rapid_episode::record::{EpisodeRequest, RecordError};
use rapid_registry::Registry;
use rapid_registry::scenario::Scenario;
use rapid_registry::simulation::task::{Expert, Outcome, Size, Texture, Touch, UNSEEN_PERIOD, World};
use rapid_status::{Board, EpisodeReport};

use super::{Lockstep, TrialError};

/// How far the gripper misses during a demonstration, so that demonstrations show corrections.
const SHAKE: f64 = 0.006;
/// Steps in which all devices are plugged in and observed, before an episode begins.
const SETTLE: u32 = 3;
/// Steps recorded after the block is in its bin: what to do then belongs to the task.
const TAIL: u32 = 8;

/// A recorded demonstration.
#[derive(Debug)]
pub struct Demonstration {
    /// Seed of its trial.
    pub seed: u64,
    /// Texture of the block.
    pub texture: Texture,
    /// Size of the block.
    pub size: Size,
    /// Steps recorded.
    pub steps: u32,
    /// The file.
    pub report: EpisodeReport,
}

/// The seeds of `count` demonstrations from `first` on, the same number of each texture, and of each of these the same
/// number of each size; what does not divide is made up by those that come first. Seeds whose demonstration would fail are
/// skipped, and those whose lattice has the period that is left for evaluation.
pub fn seeds(first: u64, count: usize) -> impl Iterator<Item = u64> {
    let half = count.div_ceil(2);
    // Of each texture: all, and each size.
    let mut left = [(half, [half.div_ceil(2); 2]); 2];
    let wanted = move |seed: &u64| {
        let world = World::new(*seed);
        let (all, sizes) = &mut left[usize::from(world.texture == Texture::Hexagonal)];
        let same = &mut sizes[usize::from(world.size == Size::Small)];
        let wanted = *all > 0 && *same > 0 && Touch::new(*seed).period != UNSEEN_PERIOD;
        let taken = wanted && succeeds(world, *seed);
        *all -= usize::from(taken);
        *same -= usize::from(taken);
        taken
    };
    (first..).filter(wanted).take(count)
}

fn succeeds(mut world: World, seed: u64) -> bool {
    let mut expert = Expert::new(seed);
    while !world.is_done() {
        let action = expert.act(&world);
        world.step(action, SHAKE);
    }
    world.outcome() == Outcome::Success
}

/// Records the demonstration of trial `seed`.
///
/// # Errors
/// When its file cannot be written.
pub fn demonstrate(
    registry: &Arc<Registry>,
    board: &Arc<Board>,
    request: &EpisodeRequest,
    seed: u64,
) -> Result<Demonstration, TrialError> {
    let begun = Stamp::now();
    let mut recorder = Stepped::new(Arc::clone(registry), Arc::clone(board), WallClock::now());
    let mut rig = Lockstep::new(registry, Scenario::task(registry, seed), begun, &[])?;
    let mut expert = Expert::new(seed);
    let (texture, size) = {
        let trial = rig.trial().lock();
        (trial.world.texture, trial.world.size)
    };
    for _ in 0..SETTLE {
        rig.deliver(&mut recorder)?;
        rig.rest(&mut recorder)?;
    }
    let mut request = request.clone();
    let tags = [("seed", seed.to_string()), ("texture", texture.word().to_owned()), ("size", size.word().to_owned())];
    request.tags.extend(tags.map(|(key, value)| (key.to_owned(), value)));
    recorder.begin(&request, rig.now())?;
    let (mut steps, mut tail) = (0_u32, TAIL);
    while tail > 0 {
        rig.deliver(&mut recorder)?;
        let (action, done) = {
            let trial = rig.trial().lock();
            (expert.act(&trial.world), trial.world.is_done())
        };
        rig.act(steps.into(), action, &mut recorder);
        rig.step(SHAKE, &mut recorder)?;
        recorder.advance(rig.now());
        steps += 1;
        tail -= u32::from(done);
    }
    let report = recorder.finish(rig.now()).ok_or(RecordError::Idle)?;
    Ok(Demonstration { seed, texture, size, steps, report })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn demonstrations_are_of_both_textures_and_sizes_alike() {
        for count in (1..=9).chain([40]) {
            let worlds: Vec<World> = seeds(1000, count).map(World::new).collect();
            assert_eq!(worlds.len(), count);
            let of = |texture: Texture, size: Size| {
                worlds.iter().filter(|world| world.texture == texture && world.size == size).count()
            };
            let [triangular, hexagonal] = [Texture::Triangular, Texture::Hexagonal]
                .map(|texture| [Size::Big, Size::Small].map(|size| of(texture, size)));
            let all = |sizes: [usize; 2]| sizes[0] + sizes[1];
            assert!(all(triangular).abs_diff(all(hexagonal)) <= 1, "{count}: {triangular:?}, {hexagonal:?}");
            // Each may lack what the last texture did not divide.
            for [big, small] in [triangular, hexagonal] {
                assert!(big.abs_diff(small) <= 2, "{count}: {triangular:?}, {hexagonal:?}");
            }
        }
        let seeds: Vec<u64> = seeds(1000, 40).collect();
        assert!(seeds.is_sorted() && seeds.iter().all(|seed| Touch::new(*seed).period != UNSEEN_PERIOD));
    }
}
