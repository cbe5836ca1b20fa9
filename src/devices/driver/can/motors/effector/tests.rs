use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rapid_registry::{CanProtocol, CanSpec, NodeSpec, Registry};

use super::*;
use crate::patience::PATIENCE;

/// The arm of the tests, as `tests/arm/devices.toml` declares it.
fn effector() -> Effector {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/arm");
    let registry = Registry::load(&folder.join("devices.toml")).unwrap_or_else(|error| panic!("{error}")).registry;
    let arm = registry.named("arm").expect("an arm");
    let NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) = &arm.node else { panic!("{arm:?}") };
    let arm = Arm::open(motors.effector.as_deref().expect("an effector"), &motors.motors).expect("it fits");
    Effector::new(arm, motors.motors.len())
}

/// Actions in the order in which they are given; without a bell.
#[derive(Debug, Default)]
struct Given(Mutex<VecDeque<Taken>>);

type Taken = Result<(Vec<f64>, Stamp), NoAction>;

impl Given {
    fn add(&self, action: Taken) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push_back(action);
    }
}

impl ActionSource for Given {
    fn bell(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn newest<'a>(&self, action: &'a mut [f64; MAX_ACTION]) -> Result<Option<(&'a [f64], Stamp)>, NoAction> {
        let Some(given) = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop_front() else { return Ok(None) };
        let (numbers, tick) = given?;
        action[..numbers.len()].copy_from_slice(&numbers);
        Ok(Some((&action[..numbers.len()], tick)))
    }
}

/// The next target, or why there is none.
fn next(targets: &Arc<dyn ActionSource>) -> Taken {
    let begun = Instant::now();
    loop {
        let mut action = [0.0; MAX_ACTION];
        if let Some((found, tick)) = targets.newest(&mut action)? {
            return Ok((found.to_vec(), tick));
        }
        assert!(begun.elapsed() < PATIENCE, "no target");
        std::thread::sleep(Duration::from_millis(1));
    }
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
    assert_eq!(effector.look(&folded(), &mut tip), 8);
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
    effector.look(&moved, &mut tip);
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
    effector.look(&folded(), &mut tip);
    let actions = Arc::<Given>::default();
    let targets = effector.follow(Arc::clone(&actions) as Arc<dyn ActionSource>).expect("a thread");
    let [x, y, z, ..] = tip;
    // The gripper is to close, and stays where it is.
    let pose = |tick| Ok((vec![x, y, z, 0.0], Stamp(tick)));
    actions.add(pose(1));
    let (first, _) = next(&targets).expect("a target");
    let mut behind = folded();
    behind[4 * MOTOR_CHANNELS] += 0.2;
    effector.look(&behind, &mut tip);
    actions.add(pose(2));
    let (second, _) = next(&targets).expect("a target");
    assert!((second[4] - first[4]).abs() < 0.01, "{first:?} {second:?}");
}

#[test]
fn actions_are_counted_by_what_became_of_them() {
    let mut effector = effector();
    assert_eq!(effector.stop(), None, "it does not run");
    let mut tip = [0.0; 8];
    effector.look(&folded(), &mut tip);
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

/// From the answer of a network to the motors: relative poses with a rotation are composed onto the pose of the tip in the
/// sample of the motors, and the arm goes there.
#[cfg(feature = "policy")]
#[test]
#[expect(clippy::cast_possible_truncation, reason = "a network has 32 bits")]
fn relative_poses_of_a_policy_become_targets_that_lead_to_them() {
    use rapid_core::rotation;
    use rapid_core::sample::{Encoding, SampleHeader};

    use crate::kinematics::tests::{COMMANDED, SIX, apart, arm_of};
    use crate::policy::bundle::Bundle;
    use crate::policy::compose::Composer;
    use crate::policy::request::Request;

    const POLICY: &str = include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/bundle/valid/relative.json"));
    const MOTORS: usize = 7;
    const ACTIONS: usize = 16;
    // Behind the numbers of the motors: position, opening, quaternion.
    let policy =
        POLICY.replace("\"position\": [0, 3], \"rotation\": [3, 7]", "\"position\": [42, 45], \"rotation\": [46, 50]");
    assert_ne!(policy, POLICY);
    let bundle = Bundle::parse(&policy, "policy.json").unwrap_or_else(|errors| panic!("{errors}"));
    let arm = arm_of(&SIX, COMMANDED);
    let mut effector = Effector::new(arm.clone(), MOTORS);
    let pose = |positions: &[f64]| {
        let mut tip = [0.0; 8];
        arm.state(&sample(positions), &mut tip);
        tip
    };

    let start = [0.3, 0.2, 1.2, -0.4, 1.0, 0.5, 0.0];
    let mut numbers = sample(&start);
    let mut tip = [0.0; 8];
    effector.look(&numbers, &mut tip);
    numbers.extend(tip);
    let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
    let header = SampleHeader { encoding: Encoding::F64 as u32, ..SampleHeader::default() };
    let mut request = Request::new(&bundle);
    request.set_present(2, true);
    request.cell_mut(2, 1).expect("the newest step").set(&header, &bytes);

    // What the network answers by definition: poses that the arm has on a path of its joints, seen from where the tip is.
    let path = |step: usize| start.map(|position| position + 0.012 * step as f64);
    let [px, py, pz, _, qx, qy, qz, qw] = tip;
    let back = [-qx, -qy, -qz, qw];
    let mut output = Vec::new();
    for step in 0..ACTIONS {
        let [x, y, z, _, turned @ ..] = pose(&path(step));
        let far = rotation::turned(back, [x - px, y - py, z - pz]);
        let rows = rotation::rows(rotation::product(back, turned));
        output.extend(far.iter().chain(rows.as_flattened()).chain(&[0.75]).map(|number| *number as f32));
    }
    let composer = Composer::new(&bundle);
    let mut chunk = vec![0.0; composer.chunk_len()];
    composer.compose(&request, &output, &mut chunk).expect("poses");

    let actions = Arc::<Given>::default();
    let targets = effector.follow(Arc::clone(&actions) as Arc<dyn ActionSource>).expect("a thread");
    for (step, action) in chunk.chunks(chunk.len() / ACTIONS).enumerate() {
        actions.add(Ok((action.iter().map(|number| f64::from(*number)).collect(), Stamp(step as u64))));
        let (found, _) = next(&targets).unwrap_or_else(|refused| panic!("action {step}: {refused}"));
        let (found, wanted) = (pose(&found), pose(&path(step)));
        let [far, off] = apart(&found, &wanted, false);
        // Twice what the solver leaves: the network's numbers have 32 bits.
        assert!(far < 2e-4 && off < 2e-3, "action {step}: {far} m, {off} rad: {found:?} {wanted:?}");
        assert!((found[3] - 0.75).abs() < 1e-6, "action {step}: {found:?}");
    }
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
