//! Policies whose actions are relative to a pose, from samples to what is executed: the network's answer is the same, what
//! is done follows from it and from where the arm is.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "what fails here fails a test")]

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use rapid_core::action::ActionSource;
use rapid_core::mask::PhysicalMask;
use rapid_core::rotation;
use rapid_core::sample::{Encoding, SampleHeader};
use rapid_core::time::Stamp;
use rapid_devices::driver::can::motors::effector::Effector;
use rapid_policy::bundle::Bundle;
use rapid_policy::compose::Composer;
use rapid_policy::horizon::{ChunkError, HoldReason, WithoutMask};
use rapid_policy::model::Model;
use rapid_policy::onnxruntime::Environment;
use rapid_policy::pilot::Pilot;
use rapid_policy::request::Request;
use rapid_policy::sampler::Computing;
use rapid_registry::Registry;

use crate::support::arm::{COMMANDED, SIX, apart, arm_of, sample};
use crate::support::given::{Given, next};
use crate::support::onnx::{Change, write_bundle};

const PERIOD: Duration = Duration::from_millis(100);
const ALL: PhysicalMask = PhysicalMask(0b111);
const RELATIVE: &str = r#""representation": "relative", "base": {"modality": "arm", "position": [0, 3]}"#;
const DELTA: &str = r#""representation": "delta", "base": {"modality": "arm", "position": [0, 3]}"#;

fn at(tick: u64) -> Stamp {
    Stamp(1_000_000_000).after(PERIOD * u32::try_from(tick).unwrap())
}

/// Where the arm is at a tick.
fn place(tick: u64) -> [f64; 4] {
    let far = tick as f64 / 100.0;
    [0.1 - far, 0.2 + far, 0.3 + 2.0 * far, 0.7]
}

/// Samples of the simulated task's rig, captured shortly before a tick.
fn push(pilot: &mut Pilot, registry: &Registry, tick: u64) {
    let captured = at(tick).0 - 5_000_000;
    for device in &registry.devices {
        let mut bytes = Vec::new();
        let (encoding, side) = if device.name == "arm" {
            bytes.extend(place(tick).into_iter().flat_map(f64::to_le_bytes));
            (Encoding::F64, 0)
        } else {
            let color = u8::try_from(40 + 20 * tick).unwrap();
            rapid_pictures::jpeg::encode(
                &vec![color; 3 * 96 * 96],
                [96; 2],
                rapid_pictures::jpeg::Values::Rgb,
                90,
                &mut bytes,
            )
            .unwrap();
            (Encoding::Mjpeg, 96)
        };
        let header = SampleHeader {
            seq: tick,
            capture_ns: captured,
            recv_ns: captured,
            epoch: 1,
            encoding: encoding as u32,
            width: side,
            height: side,
            ..SampleHeader::default()
        };
        pilot.observer.push(device.id, &header, &bytes);
    }
}

/// The network's answer at tick 3, what of it is to be executed, and what is executed at ticks 3, 4 and 5.
fn run(bundle: &Bundle) -> (Vec<f32>, Vec<f32>, Vec<Vec<f32>>) {
    let registry = Registry::task();
    bundle.check_registry(&registry).unwrap();
    bundle.check_actuators(&[("arm", 4)]).unwrap();
    let environment = Environment::open(None).expect("`make setup` fetches the library; then build again");
    let mut model = Model::load(bundle, &environment, Computing::default()).unwrap();
    let mut pilot = Pilot::new(bundle, &registry, WithoutMask::Hold, 0);
    pilot.mask = ALL;
    let mut request = Request::new(bundle);
    let mut output = vec![0.0; model.chunk_len()];
    let mut executed = Vec::new();
    for tick in 0..6 {
        push(&mut pilot, &registry, tick);
        let wants = pilot.observe(tick, at(tick), at(tick));
        if tick < 3 {
            pilot.queue.failed(tick);
            continue;
        }
        assert_eq!(wants, tick == 3);
        if wants {
            pilot.fill(tick, at(tick), &mut request);
            model.answer(&request, &mut output).unwrap();
            assert_eq!(pilot.answer(&request, &output), Ok(0));
        }
        executed.push(pilot.step(tick).action.expect("an action").to_vec());
    }
    (output, pilot.chunk().to_vec(), executed)
}

/// What is to be executed of `output`, in numbers of 64 bits.
fn expected(bundle: &Bundle, representation: &str, output: &[f32]) -> Vec<Vec<f64>> {
    let base = place(3);
    let mut before = base;
    let composed = output.chunks(4).enumerate().map(|(index, action)| {
        let mut target = [0, 1, 2, 3].map(|axis| f64::from(action[axis]));
        for axis in 0..3 {
            target[axis] += if representation == "delta" { before[axis] } else { base[axis] };
        }
        if representation == "delta" && index < bundle.action_start {
            target[..3].copy_from_slice(&base[..3]);
        }
        before = target;
        target.to_vec()
    });
    composed.collect()
}

#[track_caller]
fn close(found: &[f32], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    for (at, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((f64::from(*found) - expected).abs() < 1e-4, "at {at}: {found}, expected {expected}");
    }
}

/// The bundle of `folder` and one of these files whose policy.json differs.
fn check(absolute: &Bundle, other: &Bundle, representation: &str) {
    let (plain, chunk, _) = run(absolute);
    assert_eq!(chunk, plain, "of absolute actions nothing is made");
    let (output, chunk, executed) = run(other);
    assert_eq!(output, plain, "the network answers the same");
    let expected = expected(other, representation, &output);
    close(&chunk, &expected.concat());
    for (index, action) in executed.iter().enumerate() {
        let limits = other.action.min.iter().zip(&other.action.max);
        let wanted = expected[other.action_start + index].iter().zip(limits);
        let wanted: Vec<f64> = wanted.map(|(v, (min, max))| v.clamp(f64::from(*min), f64::from(*max))).collect();
        close(action, &wanted);
    }
    assert_ne!(chunk, output);
}

#[test]
fn the_shipped_policy_made_relative_moves_from_where_the_arm_is() {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/tactile-id");
    let absolute = Bundle::load(&shipped).unwrap();
    let text = std::fs::read_to_string(shipped.join("policy.json")).unwrap();
    for (representation, with) in [("relative", RELATIVE), ("delta", DELTA)] {
        let folder = tempfile::tempdir().unwrap();
        for graph in ["encoder.onnx", "denoiser.onnx"] {
            std::fs::copy(shipped.join(graph), folder.path().join(graph)).unwrap();
        }
        let changed = text.replace(r#""representation": "absolute""#, with);
        assert_ne!(changed, text);
        std::fs::write(folder.path().join("policy.json"), changed).unwrap();
        check(&absolute, &Bundle::load(folder.path()).unwrap(), representation);
    }
}

#[test]
fn a_policy_worked_out_by_hand_moves_from_where_the_arm_is() {
    let folders: [tempfile::TempDir; 3] = std::array::from_fn(|_| tempfile::tempdir().unwrap());
    write_bundle(folders[0].path(), &[]);
    let absolute = Bundle::load(folders[0].path()).unwrap();
    for (folder, representation, with) in [(&folders[1], "relative", RELATIVE), (&folders[2], "delta", DELTA)] {
        write_bundle(folder.path(), &[Change { what: r#""representation": "absolute""#, with }]);
        check(&absolute, &Bundle::load(folder.path()).unwrap(), representation);
    }
}

/// An answer from which no pose follows is counted and not executed.
#[test]
fn an_answer_without_a_rotation_is_not_executed() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/bundle/valid/relative.json");
    let bundle = Bundle::parse(&std::fs::read_to_string(path).unwrap(), "policy.json").unwrap();
    let registry = Registry::task();
    let mut pilot = Pilot::new(&bundle, &registry, WithoutMask::Hold, 0);
    pilot.mask = ALL;
    let mut request = Request::new(&bundle);
    let mut output = vec![0.0; bundle.horizon * bundle.action.outputs()];
    for (tick, expected) in [(0, ChunkError::NoBase), (1, ChunkError::NotFinite)] {
        push(&mut pilot, &registry, tick);
        assert!(pilot.observe(tick, at(tick), at(tick)));
        pilot.fill(tick, at(tick), &mut request);
        // The arm of the task has four numbers, and no rotation.
        let refused = pilot.answer(&request, &output);
        assert_eq!(refused, Err(expected));
        assert!(pilot.chunk().iter().all(|value| value.is_nan()));
        assert_eq!(pilot.step(tick).hold, Some(HoldReason::Unusable));
        output[7] = f32::NAN;
    }
    let counts = pilot.queue.counts();
    assert_eq!((counts.no_pose_chunks, counts.not_finite_chunks, counts.chunks), (1, 1, 0));
}

/// From the answer of a network to the motors: relative poses with a rotation are composed onto the pose of the tip in the
/// sample of the motors, and the arm goes there.
#[test]
#[expect(clippy::cast_possible_truncation, reason = "a network has 32 bits")]
fn relative_poses_of_a_policy_become_targets_that_lead_to_them() {
    const POLICY: &str = include_str!("../bundle/valid/relative.json");
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
    effector.update(&numbers, &mut tip);
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
