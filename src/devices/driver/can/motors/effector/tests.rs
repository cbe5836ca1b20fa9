use std::sync::PoisonError;
use std::time::Instant;

use rapid_registry::{CanProtocol, CanSpec, NodeSpec, Registry};

use super::*;
use crate::given::{Given, next};
use crate::patience::PATIENCE;

/// The arm of the tests, as `tests/arm/devices.toml` declares it.
fn effector() -> Effector {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/arm");
    let registry = Registry::load(&folder.join("devices.toml")).unwrap_or_else(|error| panic!("{error}")).registry;
    let arm = registry.named("arm").expect("an arm");
    let NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) = &arm.node else { panic!("{arm:?}") };
    let arm = Arm::open(motors.effector.as_deref().expect("an effector"), &motors.motors).expect("it fits");
    Effector::new(arm, motors.motors.len())
}

/// Numbers of the motors at these positions.
fn sample(positions: &[f64]) -> Vec<f64> {
    positions.iter().flat_map(|position| [*position, 0.0, 0.0, 0.0, 0.0, 0.0]).collect()
}

/// The same at a pose with the tool downwards.
fn folded() -> Vec<f64> {
    sample(&[0.1, 0.8, 1.2, std::f64::consts::PI - 2.0, 0.3, 0.5])
}

#[test]
fn poses_become_targets_with_their_ticks_and_what_is_out_of_reach_none() {
    let mut effector = effector();
    let mut tip = [0.0; 8];
    assert_eq!(effector.update(&folded(), &mut tip), 8);
    let actions = Arc::<Given>::default();
    let targets = effector.follow(Arc::clone(&actions) as Arc<dyn ActionSource>).expect("a thread");
    let [x, y, z, ..] = tip;
    let pose = |by: f64| vec![x + by, y, z, 1.0];
    actions.add(Ok((pose(0.0), Stamp(7))));
    let (found, tick) = next(&targets).expect("a target");
    assert_eq!((found.len(), tick), (6, Stamp(7)));
    for (found, wanted) in found.iter().zip(folded().iter().step_by(MOTOR_CHANNELS)).take(4) {
        assert!((found - wanted).abs() < 0.01, "{found} {wanted}");
    }
    assert!((found[5] - 1.2).abs() < 1e-9, "open: {found:?}");
    // Nothing is given twice.
    assert!(matches!(targets.newest(&mut [0.0; MAX_ACTION]), Ok(None)));
    // What the arm does not reach: the far corner of its box.
    for (given, wanted) in [
        (Ok((vec![1.0, -1.0, 0.9, 1.0], Stamp(8))), NoAction::OutOfReach),
        (Ok((vec![0.0; 2], Stamp(8))), NoAction::Length),
        (Err(NoAction::Foreign), NoAction::Foreign),
        (Err(NoAction::NoNumbers), NoAction::NoNumbers),
    ] {
        actions.add(given);
        assert_eq!(next(&targets), Err(wanted));
    }
    actions.add(Ok((pose(0.02), Stamp(9))));
    assert_eq!(next(&targets).expect("a target").1, Stamp(9));
    // The motors are moved by hand: the next target is sought from where they are now.
    let mut moved = folded();
    moved[4 * MOTOR_CHANNELS] += 1.5;
    effector.update(&moved, &mut tip);
    actions.add(Ok((pose(0.0), Stamp(10))));
    let (found, _) = next(&targets).expect("a target");
    assert!((found[4] - moved[4 * MOTOR_CHANNELS]).abs() < 0.05, "{found:?}");
    assert!(!effector.has_ended());
    drop(effector);
}

/// Each joint is a little behind its target. If the next target began there, an arm that is to stay would turn away.
#[test]
fn an_arm_whose_gripper_holds_something_stays_as_it_is() {
    let mut effector = effector();
    let mut tip = [0.0; 8];
    effector.update(&folded(), &mut tip);
    let actions = Arc::<Given>::default();
    let targets = effector.follow(Arc::clone(&actions) as Arc<dyn ActionSource>).expect("a thread");
    let [x, y, z, ..] = tip;
    // The gripper is to close, and stays where it is.
    let pose = |tick| Ok((vec![x, y, z, 0.0], Stamp(tick)));
    actions.add(pose(1));
    let (first, _) = next(&targets).expect("a target");
    let mut behind = folded();
    behind[4 * MOTOR_CHANNELS] += 0.2;
    effector.update(&behind, &mut tip);
    actions.add(pose(2));
    let (second, _) = next(&targets).expect("a target");
    assert!((second[4] - first[4]).abs() < 0.01, "{first:?} {second:?}");
}

#[test]
fn actions_are_counted_by_what_became_of_them() {
    let mut effector = effector();
    assert_eq!(effector.stop(), None, "it does not run");
    let mut tip = [0.0; 8];
    effector.update(&folded(), &mut tip);
    let actions = Arc::<Given>::default();
    let targets = effector.follow(Arc::clone(&actions) as Arc<dyn ActionSource>).expect("a thread");
    let [x, y, z, ..] = tip;
    let far = || Ok((vec![1.0, -1.0, 0.9, 1.0], Stamp(2)));
    let near = || Ok((vec![x, y, z, 1.0], Stamp(1)));
    for given in [near(), far(), far(), near(), far(), Ok((vec![0.0; 2], Stamp(3))), Err(NoAction::Foreign), near()] {
        actions.add(given);
        // Each of them, before the next one takes its place.
        let _ = next(&targets);
    }
    let tally = effector.stop().expect("it ran");
    assert_eq!(tally, Tally { followed: 3, out_of_reach: 3, invalid: 2 });
    assert_eq!(tally.to_string(), "3 actions followed, 3 out of reach, 2 invalid");
}

#[test]
fn before_the_first_sample_there_is_no_target() {
    let mut effector = effector();
    let actions = Arc::<Given>::default();
    let targets = effector.follow(Arc::clone(&actions) as Arc<dyn ActionSource>).expect("a thread");
    actions.add(Ok((vec![0.4, 0.0, 0.4, 1.0], Stamp(1))));
    let begun = Instant::now();
    while !actions.0.lock().unwrap_or_else(PoisonError::into_inner).is_empty() {
        assert!(begun.elapsed() < PATIENCE, "it is not taken");
        std::thread::sleep(Duration::from_millis(1));
    }
    drop(effector);
    assert!(matches!(targets.newest(&mut [0.0; MAX_ACTION]), Ok(None)));
}

/// A reader never sees half of one target and half of another.
#[test]
fn a_target_is_read_whole_or_not_at_all() {
    let targets = Arc::new(Targets::new(6));
    let writer = std::thread::spawn({
        let targets = Arc::clone(&targets);
        move || {
            for round in 1..200_000_u32 {
                targets.give(Stamp(u64::from(round)), &[f64::from(round); 6]);
            }
        }
    });
    let mut last = 0.0;
    while !writer.is_finished() {
        let mut action = [0.0; MAX_ACTION];
        let Ok(Some((found, tick))) = targets.newest(&mut action) else { continue };
        assert!(found.iter().all(|number| number.to_bits() == found[0].to_bits()), "{found:?}");
        assert!(found[0] > last && (tick.0 as f64 - found[0]).abs() < 0.5, "{found:?} {tick:?}");
        last = found[0];
    }
    writer.join().expect("no panic");
}
