use super::*;
use TaskPart::{Arm, Tactile, Wrist};

/// A demonstration of `seed` as it is recorded, with 8 additional steps.
fn demonstrate(seed: u64, shake: f64) -> Trial {
    let (mut trial, mut expert) = (Trial::new(seed), Expert::new(seed));
    while !trial.world.is_done() {
        let target = expert.act(&trial.world);
        trial.command(target);
        trial.step(shake);
    }
    trial
}

#[test]
fn the_expert_succeeds_at_both_textures_and_sizes() {
    let mut seen = [0; 4];
    for seed in 0..200 {
        let trial = demonstrate(seed, 0.006);
        assert_eq!(trial.world.outcome(), Outcome::Success, "seed {seed}");
        assert!((60..200).contains(&trial.world.steps()), "seed {seed}: {} steps", trial.world.steps());
        seen[2 * usize::from(trial.world.texture == Texture::Hexagonal)
            + usize::from(trial.world.size == Size::Small)] += 1;
    }
    assert!(seen.into_iter().all(|count| count > 35), "{seen:?}");
}

/// The widest opening at which a block is held, and the pressure on it of a gripper that closes wholly.
fn grasp(size: Size) -> (f64, f64) {
    let (mut trial, mut expert) = (Trial::new(5), Expert::new(5));
    trial.world.size = size;
    while !trial.world.held {
        let target = expert.act(&trial.world);
        trial.command(target);
        trial.step(0.0);
    }
    let opening = trial.world.grip;
    for _ in 0..5 {
        let [x, y, z] = trial.world.position;
        trial.command([x, y, z, 0.0]);
        trial.step(0.0);
    }
    (opening, trial.world.pressure)
}

#[test]
fn a_small_block_is_narrower_and_feels_the_same() {
    let ((big, hard), (small, same)) = (grasp(Size::Big), grasp(Size::Small));
    assert!((big, small) == (0.45, 0.3) && (hard - same).abs() < 0.05, "{big} {hard}, {small} {same}");
}

#[test]
fn who_goes_to_the_other_bin_is_told_so_and_who_does_nothing_runs_out_of_time() {
    let (mut trial, mut expert) = (Trial::new(5), Expert::new(5));
    trial.world.texture = trial.world.texture.other();
    let truth = trial.world.texture.other();
    while !trial.world.is_done() {
        let target = expert.act(&trial.world);
        trial.command(target);
        trial.step(0.0);
    }
    trial.world.texture = truth;
    assert_eq!(trial.world.outcome(), Outcome::WrongBin);

    let mut idle = Trial::new(5);
    idle.advance_to(MAX_STEPS);
    assert!(idle.world.is_done());
    assert_eq!(idle.world.outcome(), Outcome::Incomplete);
}

#[test]
fn the_same_seed_gives_the_same_bytes_in_whatever_order_its_parts_are_read() {
    let read = |order: [TaskPart; 3]| {
        let mut trial = demonstrate(11, 0.0);
        let mut read: Vec<_> = order
            .into_iter()
            .map(|part| {
                let mut payload = Vec::new();
                trial.sample(part, &mut payload).unwrap();
                (part, payload)
            })
            .collect();
        read.sort_by_key(|(part, _)| *part as u8);
        read.into_iter().map(|(_, payload)| payload).collect::<Vec<_>>()
    };
    assert_eq!(read([Wrist, Tactile, Arm]), read([Arm, Tactile, Wrist]));
}

/// Only the tactile picture shows the texture, and only while the block is held.
#[test]
fn only_the_tactile_camera_shows_the_texture() {
    let looks = |texture| {
        let mut world = World::new(3);
        let mut looks = Looks::new(3, texture);
        let (mut wrist, mut gel, mut pressed) = (Vec::new(), Vec::new(), Vec::new());
        looks.wrist(&world, &mut wrist);
        looks.tactile(&world, &mut gel);
        (world.held, world.pressure) = (true, 0.8);
        looks.tactile(&world, &mut pressed);
        (wrist, gel, pressed)
    };
    let (triangular, hexagonal) = (looks(Texture::Triangular), looks(Texture::Hexagonal));
    assert_eq!(triangular.0.len(), SIDE * SIDE * 3);
    assert_eq!((&triangular.0, &triangular.1), (&hexagonal.0, &hexagonal.1));
    // Beyond four standard deviations of the noise of two pictures.
    let far = |a: &[u8], b: &[u8]| a.iter().zip(b).filter(|(a, b)| a.abs_diff(**b) > 25).count();
    assert!(far(&triangular.2, &hexagonal.2) > 1000);
    assert!(far(&triangular.1, &triangular.2) > 1000);
}

#[test]
fn pictures_are_jpeg_and_states_are_four_numbers() {
    let mut trial = Trial::new(1);
    let mut payload = Vec::new();
    for part in [TaskPart::Wrist, TaskPart::Tactile] {
        trial.sample(part, &mut payload).unwrap();
        assert_eq!((&payload[..2], &payload[payload.len() - 2..]), (&[0xff, 0xd8][..], &[0xff, 0xd9][..]));
    }
    trial.sample(TaskPart::Arm, &mut payload).unwrap();
    let values: Vec<f64> = payload.chunks(8).map(|value| f64::from_le_bytes(value.try_into().unwrap())).collect();
    assert_eq!(values, trial.world.state());
}
