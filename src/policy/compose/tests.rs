//! Against poses computed by training's own code (`tests/golden/poses.json`, written by `models/tests/test_composed.py`),
//! and against random poses from which an output is made.

use proptest::prelude::*;
use rapid_core::sample::SampleHeader;
use serde::Deserialize;
use serde_json::{Value, json};

use super::*;
use crate::example;

const HORIZON: usize = 16;
const START: usize = 1;

/// A bundle of these actions; where there is a base, its modality `arm` has position and quaternion in numbers 1 to 7.
fn bundle(representation: &str, rotation: Option<&str>) -> Bundle {
    let mut policy: Value = serde_json::from_str(example::POLICY).unwrap();
    let outputs = 4 + match rotation {
        None => 0,
        Some("quaternion") => 4,
        Some(_) => 6,
    };
    let executed = if rotation.is_some() { 8 } else { 4 };
    let mut action = json!({
        "actuator": "arm", "shape": [outputs], "representation": representation, "rotation": rotation,
        "names": vec!["n"; executed], "units": vec!["1"; executed],
        "limits": {"min": vec![-9; executed], "max": vec![9; executed]},
        "normalization": [{"slice": [0, outputs], "mode": "identity"}],
    });
    if representation != "absolute" {
        action["base"] = json!({"modality": "arm", "position": [1, 4]});
        if rotation.is_some() {
            action["base"]["rotation"] = json!([4, 8]);
        }
    }
    policy["action"] = action;
    policy["horizon"] = HORIZON.into();
    policy["action_start"] = START.into();
    Bundle::parse(&policy.to_string(), "policy.json").unwrap_or_else(|errors| panic!("{errors}"))
}

fn header() -> SampleHeader {
    SampleHeader { encoding: Encoding::F64 as u32, ..SampleHeader::default() }
}

/// A request whose newest sample of `arm` has this pose behind another number; the older one has none.
fn request(bundle: &Bundle, pose: &[f64]) -> Request {
    let mut request = Request::new(bundle);
    let numbers: Vec<u8> = std::iter::once(&7.0).chain(pose).flat_map(|number| number.to_le_bytes()).collect();
    request.set_present(2, true);
    request.cell_mut(2, 0).unwrap().set(&header(), &[]);
    request.cell_mut(2, 1).unwrap().set(&header(), &numbers);
    request
}

fn composed(bundle: &Bundle, pose: &[f64], output: &[f32]) -> Result<Vec<Vec<f32>>, ChunkError> {
    let composer = Composer::new(bundle);
    let mut actions = vec![7.0; composer.chunk_len()];
    composer.compose(&request(bundle, pose), output, &mut actions)?;
    Ok(actions.chunks(composer.executed).map(<[f32]>::to_vec).collect())
}

fn far(one: &[f32], other: &[f64]) -> f64 {
    assert_eq!(one.len(), other.len());
    one.iter().zip(other).map(|(one, other)| (f64::from(*one) - other).abs()).fold(0.0, f64::max)
}

#[derive(Deserialize)]
struct Golden {
    actions: Vec<Case>,
    /// Quaternions, and the six numbers that an observation has of them.
    observations: Vec<([f64; 4], [f64; 6])>,
}

#[derive(Deserialize)]
struct Case {
    representation: String,
    rotation: Option<String>,
    /// Position and quaternion at the tick of the newest observation.
    base: [f64; 7],
    output: Vec<Vec<f32>>,
    executed: Vec<Vec<f64>>,
}

fn golden() -> Golden {
    serde_json::from_str(include_str!("../../../tests/golden/poses.json")).unwrap()
}

#[test]
fn what_training_learns_from_a_path_leads_along_it() {
    let cases = golden().actions;
    assert_eq!(
        cases.len(),
        18,
        "three representations and three forms of a rotation, in the middle and at the beginning"
    );
    for case in cases {
        let bundle = bundle(&case.representation, case.rotation.as_deref());
        let found = composed(&bundle, &case.base, &case.output.concat()).unwrap();
        // What comes before a step from T0 is past: T0 stands there.
        let begin = if case.representation == "delta" { START } else { 0 };
        for (index, (found, expected)) in found.iter().zip(&case.executed).enumerate().skip(begin) {
            let far = far(found, expected);
            assert!(far < 2e-6, "{} {:?} at {index}: {far}", case.representation, case.rotation);
        }
    }
}

#[test]
fn six_numbers_of_an_observation_are_those_of_training() {
    for (quaternion, six) in golden().observations {
        let found = rotation::rows(rotation::normalized(quaternion).unwrap());
        assert!(found.as_flattened().iter().zip(six).all(|(one, other)| (one - other).abs() < 1e-9), "{quaternion:?}");
    }
}

#[test]
fn actions_that_are_no_poses_pass_unchanged() {
    let bundle = bundle("absolute", None);
    let output: Vec<f32> = (0..64_u8).map(f32::from).collect();
    assert_eq!(composed(&bundle, &[], &output).unwrap().concat(), output);
}

/// Poses from numbers: x, y, z and a quaternion of a length.
fn pose() -> impl Strategy<Value = [f64; 7]> {
    prop::array::uniform7(-1.0..1.0).prop_filter_map("of a length", |mut pose: [f64; 7]| {
        let rotation = split(pose).rotation;
        let is_long = rotation.iter().any(|part| part.abs() > 0.1);
        pose[3..].copy_from_slice(&rotation::normalized(rotation).filter(|_| is_long)?);
        Some(pose)
    })
}

fn split(pose: [f64; 7]) -> Pose {
    Pose { position: [0, 1, 2].map(|at| pose[at]), rotation: [3, 4, 5, 6].map(|at| pose[at]) }
}

fn inverse([x, y, z, w]: Quaternion) -> Quaternion {
    [-x, -y, -z, w]
}

/// By definition what the network would answer for the target `pose`, seen from `from`.
#[expect(clippy::cast_possible_truncation, reason = "as a network has it")]
fn answer(representation: &str, rotation: Option<&str>, from: Pose, pose: Pose) -> Vec<f32> {
    let step = [0, 1, 2].map(|axis| pose.position[axis] - from.position[axis]);
    let (position, turn) = match (representation, rotation) {
        ("absolute", _) => (pose.position, pose.rotation),
        ("relative", Some(_)) => {
            (rotation::turned(inverse(from.rotation), step), rotation::product(inverse(from.rotation), pose.rotation))
        }
        _ => (step, rotation::product(pose.rotation, inverse(from.rotation))),
    };
    let mut numbers = position.to_vec();
    match rotation {
        None => {}
        Some("quaternion") => numbers.extend(turn.map(|part| 2.0 * part)),
        Some(_) => numbers.extend_from_slice(rotation::rows(turn).as_flattened()),
    }
    numbers.push(0.25);
    numbers.into_iter().map(|number| number as f32).collect()
}

proptest! {
    #[test]
    fn poses_come_back(base in pose(), targets in prop::collection::vec(pose(), HORIZON)) {
        for representation in ["absolute", "relative", "delta"] {
            for rotation in [None, Some("rotation_6d"), Some("quaternion")] {
                let (mut before, mut output) = (split(base), Vec::new());
                for (index, target) in targets.iter().enumerate() {
                    output.extend(answer(representation, rotation, before, split(*target)));
                    if representation == "delta" && index >= START {
                        before = split(*target);
                    }
                }
                let found = composed(&bundle(representation, rotation), &base, &output).unwrap();
                let mut near = if representation == "absolute" { rotation::NONE } else { split(base).rotation };
                for (index, (action, target)) in found.iter().zip(&targets).enumerate() {
                    let target = if representation == "delta" && index < START { &base } else { target };
                    let mut wanted = target[..3].to_vec();
                    if rotation.is_some() {
                        let turn = split(*target).rotation;
                        // Either sign is right where both are as near.
                        let is_even = turn.iter().zip(near).map(|(a, b)| a * b).sum::<f64>().abs() < 1e-4;
                        near = rotation::nearer(turn, near);
                        if is_even {
                            near = rotation::nearer(near, [3, 4, 5, 6].map(|at| f64::from(action[at])));
                        }
                        wanted.extend(near);
                    }
                    wanted.push(0.25);
                    prop_assert!(far(action, &wanted) < 1e-5, "{representation} {rotation:?} {index}: {action:?} {wanted:?}");
                }
            }
        }
    }

    #[test]
    fn no_numbers_cause_a_panic_or_a_half_chunk(
        representation in prop::sample::select(vec!["absolute", "relative", "delta"]),
        rotation in prop::sample::select(vec![None, Some("rotation_6d"), Some("quaternion")]),
        base in prop::collection::vec(prop_oneof![4 => -1e9..1e9_f64, 1 => any::<f64>(), 1 => Just(0.0)], 0..9),
        numbers in prop::collection::vec(prop_oneof![9 => -2.0..2.0_f32, 1 => any::<f32>(), 1 => Just(0.0)], 160),
    ) {
        let bundle = bundle(representation, rotation);
        let composer = Composer::new(&bundle);
        let mut actions = vec![7.0; composer.chunk_len()];
        let output = &numbers[..HORIZON * bundle.action.outputs()];
        match composer.compose(&request(&bundle, &base), output, &mut actions) {
            Ok(()) if rotation.is_some() && actions.iter().all(|value| value.is_finite()) => {
                for action in actions.chunks(8) {
                    let length: f32 = action[3..7].iter().map(|part| part * part).sum();
                    prop_assert!((length - 1.0).abs() < 1e-5, "{action:?}");
                }
            }
            Ok(()) => {}
            Err(error) => {
                prop_assert!([ChunkError::NoRotation, ChunkError::NoBase].contains(&error));
                prop_assert!(actions.iter().all(|value| value.is_nan()));
            }
        }
    }
}

const SOME: [f64; 7] = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];

#[test]
fn a_rotation_that_is_none_makes_the_chunk_unusable() {
    let six = bundle("relative", Some("rotation_6d"));
    let action = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.5];
    let mut output = action.repeat(HORIZON);
    assert!(composed(&six, &SOME, &output).is_ok());
    // In the last action, parallel rows, then a zero one.
    for second in [[-2.0, 0.0, 0.0], [0.0; 3]] {
        output[156..159].copy_from_slice(&second);
        assert_eq!(composed(&six, &SOME, &output), Err(ChunkError::NoRotation), "{second:?}");
    }
    let four = bundle("absolute", Some("quaternion"));
    let output = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5].repeat(HORIZON);
    assert_eq!(composed(&four, &[], &output), Err(ChunkError::NoRotation));
}

#[test]
fn a_base_that_is_none_makes_the_chunk_unusable() {
    let output = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5].repeat(HORIZON);
    let turned = bundle("delta", Some("quaternion"));
    let with = |at: usize, number: f64| {
        let mut pose = SOME;
        pose[at] = number;
        pose
    };
    for pose in [&SOME[..6], &[], &with(1, f64::NAN), &with(4, f64::INFINITY), &with(6, 0.0)] {
        assert_eq!(composed(&turned, pose, &output), Err(ChunkError::NoBase), "{pose:?}");
    }
    assert!(composed(&turned, &SOME, &output).is_ok());
    let composer = Composer::new(&turned);
    let mut actions = vec![0.0; composer.chunk_len()];
    let mut request = request(&turned, &SOME);
    request.cell_mut(2, 1).unwrap().encoding = Some(Encoding::Grey);
    assert_eq!(composer.compose(&request, &output, &mut actions), Err(ChunkError::NoBase), "bytes of a picture");
    request.cell_mut(2, 1).unwrap().encoding = Some(Encoding::F64);
    request.set_present(2, false);
    assert_eq!(composer.compose(&request, &output, &mut actions), Err(ChunkError::NoBase), "absent");
    // Without a rotation the base needs none.
    let straight = bundle("relative", None);
    let output = [0.5, 0.0, 0.0, 0.0].repeat(HORIZON);
    assert_eq!(composed(&straight, &SOME[..3], &output).unwrap()[0], [0.6, 0.2, 0.3, 0.0]);
    assert_eq!(composed(&straight, &SOME[..2], &output), Err(ChunkError::NoBase));
}

#[test]
fn what_is_not_finite_is_left_to_the_queue_and_a_wrong_length_is_refused() {
    let relative = bundle("relative", None);
    let mut output = [0.5, 0.0, 0.0, 0.0].repeat(HORIZON);
    output[63] = f32::NAN;
    assert!(composed(&relative, &SOME, &output).unwrap().concat().iter().all(|value| value.is_nan()));
    assert_eq!(composed(&relative, &SOME, &output[..60]), Err(ChunkError::Length));
}
