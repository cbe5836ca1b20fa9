//! Compares a bundle with its files, its rig and its graphs. The contents of the file are tested in
//! `tests/library/bundle.rs`.

use rapid_registry::Registry;

use super::*;
use crate::example::{POLICY, write, write_changed};

/// The smallest possible models: `ModelProto` with only a version.
const ONE: &[u8] = &[8, 1];
const TWO: &[u8] = &[8, 2];

fn bundle() -> Bundle {
    Bundle::parse(POLICY, "policy.json").unwrap_or_else(|errors| panic!("{errors}"))
}

fn problems<T: std::fmt::Debug>(result: Result<T, BundleErrors>) -> Vec<String> {
    result.unwrap_err().diagnostics.iter().map(|found| format!("{found}").replacen("policy.json: ", "", 1)).collect()
}

#[test]
fn a_bundle_is_read_with_its_graphs() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = write(folder.path(), ONE, TWO);
    assert_eq!(bundle.read_graph(Graph::Encoder).unwrap(), ONE);
    assert_eq!(bundle.read_graph(Graph::Denoiser).unwrap(), TWO);
    // printf '\x08\x01' | sha256sum
    assert_eq!(bundle.encoder.sha256, "fb8da7eb5b1b399e7321179dac9e9f65773d7331e1e30554e3911e4325e1ef19");
}

#[test]
fn the_hash_depends_on_the_file_and_on_the_graphs() {
    let [a, b, c, d] = std::array::from_fn(|_| tempfile::tempdir().unwrap());
    let first = write(a.path(), ONE, TWO).hash;
    assert_eq!(write(b.path(), ONE, TWO).hash, first);
    assert_ne!(write(c.path(), ONE, ONE).hash, first);
    assert_ne!(write_changed(d.path(), ONE, TWO, |policy| policy["training"]["seed"] = 1.into()).hash, first);
    assert_eq!(first.len(), 64);
}

#[test]
fn graphs_that_differ_from_those_of_the_file_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let bundle = write(folder.path(), ONE, TWO);
    std::fs::write(folder.path().join("encoder.onnx"), b"One").unwrap();
    std::fs::remove_file(folder.path().join("denoiser.onnx")).unwrap();
    let errors = problems(Bundle::load(folder.path()));
    assert_eq!(errors.len(), 2);
    assert!(errors[0].contains("[graphs.encoder] encoder.onnx has the SHA-256 "), "{}", errors[0]);
    assert!(errors[1].contains("[graphs.denoiser] denoiser.onnx cannot be read: No such file"), "{}", errors[1]);
    assert_eq!(problems(bundle.read_graph(Graph::Encoder)).len(), 1, "changed after it was loaded");
    // Only regular files are read: a pipe would block.
    std::fs::create_dir(folder.path().join("denoiser.onnx")).unwrap();
    assert!(problems(Bundle::load(folder.path()))[1].contains("it is not a file"));
}

#[test]
fn a_folder_without_a_bundle_is_an_error_with_its_fix() {
    let folder = tempfile::tempdir().unwrap();
    let errors = problems(Bundle::load(folder.path()));
    assert!(errors[0].contains("No such file"), "{}", errors[0]);
    assert!(errors[0].contains("fix: name the folder of a policy bundle"), "{}", errors[0]);
}

/// The rig of the example; `cam` and `arm` are appended to those entries.
fn registry(cam: &str, arm: &str) -> Registry {
    let text = format!(
        "[device.cam_wrist]\nvid = \"1\"\npid = \"1\"\nnode = \"camera\"\n[device.cam_wrist.camera]\n{cam}\n\
         [device.tactile_tip]\nvid = \"1\"\npid = \"2\"\nnode = \"camera\"\n\
         [device.tactile_tip.camera]\nwidth = 96\nheight = 96\n\
         [device.arm]\nvid = \"1\"\npid = \"3\"\n{arm}\n"
    );
    Registry::parse(&text, None).unwrap_or_else(|errors| panic!("{errors}")).registry
}

const CAM: &str = "width = 96\nheight = 96";
const ARM: &str = "node = \"serial\"\n[device.arm.tty]\nchannels = 4";

#[test]
fn a_matching_rig_is_accepted() {
    bundle().check_registry(&registry(CAM, ARM)).unwrap();
    // More numbers than the slice needs, and a picture that is resized or cropped, are accepted.
    let mut resized = bundle();
    let ObservationInput::Image(image) = &mut resized.observations[0].input else { panic!("an image") };
    image.resize = Some([96, 96]);
    let large = registry("width = 640\nheight = 480", "node = \"serial\"\n[device.arm.tty]\nchannels = 9");
    resized.check_registry(&large).unwrap();
    let ObservationInput::Image(image) = &mut resized.observations[0].input else { panic!("an image") };
    (image.resize, image.crop) = (None, Some([96, 96]));
    resized.check_registry(&large).unwrap();
}

#[test]
fn every_difference_from_the_rig_is_reported() {
    let mut strange = bundle();
    strange.observations[1].modality = "tactile_tpi".to_owned();
    let serial = "node = \"serial\"\n[device.arm.tty]\nchannels = 3";
    assert_eq!(
        problems(strange.check_registry(&registry("width = 640\nheight = 480", serial))),
        [
            "[observations[0]] wants images of 96x96 (height x width), but \"cam_wrist\" gives 480x640\n    \
             fix: set width = 96 and height = 96 in devices.toml, or \"resize\": [96, 96] here",
            "[observations[1]] modality \"tactile_tpi\" is not in devices.toml\n    fix: did you mean \"tactile_tip\"?",
            "[observations[2]] slice ends at 4, but \"arm\" gives 3 values\n    \
             fix: correct the slice, or channels of \"arm\" in devices.toml",
        ]
    );
    let mut whole = bundle();
    whole.observations[0].modality = "arm".to_owned();
    let ObservationInput::Vector(vector) = &mut whole.observations[2].input else { panic!("a vector") };
    vector.slice = None;
    let raw = "node = \"serial\"\n[device.arm.tty]\nparse = \"raw\"";
    let raw = problems(whole.check_registry(&registry(CAM, raw)));
    assert_eq!(
        raw,
        [
            "[observations[0]] wants images, but the device \"arm\" gives bytes without a known structure\n    \
             fix: give [device.arm] in devices.toml a device that gives images",
            "[observations[2]] wants values, but the device \"arm\" gives bytes without a known structure\n    \
             fix: give [device.arm] in devices.toml a device that gives values",
        ]
    );
    let five = "node = \"serial\"\n[device.arm.tty]\nchannels = 5";
    let five = problems(whole.check_registry(&registry(CAM, five)));
    assert!(five[1].starts_with("[observations[2]] wants 4 values, but \"arm\" gives 5"), "{}", five[1]);
}

/// The bundle of relative actions with a rotation; the arm has position and quaternion in its first 7 values.
const RELATIVE: &str = include_str!("../../../tests/bundle/valid/relative.json");

#[test]
fn a_base_beyond_the_samples_of_its_device_is_reported() {
    let relative = Bundle::parse(RELATIVE, "policy.json").unwrap_or_else(|errors| panic!("{errors}"));
    let seven = "node = \"serial\"\n[device.arm.tty]\nchannels = 7";
    relative.check_registry(&registry(CAM, seven)).unwrap();
    let two = "node = \"serial\"\n[device.arm.tty]\nchannels = 2";
    let found = problems(relative.check_registry(&registry(CAM, two)));
    assert_eq!(
        found[1..],
        [
            "[action.base.position] ends at 3, but \"arm\" gives 2 values\n    \
             fix: correct it, or channels of \"arm\" in devices.toml",
            "[action.base.rotation] ends at 7, but \"arm\" gives 2 values\n    \
             fix: correct it, or channels of \"arm\" in devices.toml",
        ]
    );
}

#[test]
fn the_actuator_takes_what_is_executed_and_the_graphs_give_what_was_learned() {
    let relative = Bundle::parse(RELATIVE, "policy.json").unwrap_or_else(|errors| panic!("{errors}"));
    assert_eq!((relative.action.len(), relative.action.outputs()), (8, 10));
    relative.check_actuators(&[("arm", 8)]).unwrap();
    let refused = problems(relative.check_actuators(&[("arm", 10)]));
    assert!(refused[0].starts_with("[action] has 8 values, but \"arm\" takes 10"), "{}", refused[0]);
    let (mut encoder, mut denoiser) = graphs();
    encoder.inputs[1].dims = vec![None, Some(2), Some(6)];
    assert_eq!(problems(relative.check_graphs(&encoder, &denoiser)).len(), 2);
    for tensor in [&mut denoiser.inputs[0], &mut denoiser.outputs[0]] {
        tensor.dims = vec![None, Some(16), Some(10)];
    }
    relative.check_graphs(&encoder, &denoiser).unwrap();
}

#[test]
fn the_actuator_must_exist_and_take_the_same_number_of_values() {
    bundle().check_actuators(&[("other", 2), ("arm", 4)]).unwrap();
    let one = |actuators| problems(bundle().check_actuators(actuators)).remove(0);
    assert!(one(&[("arm", 6)]).starts_with("[action] has 4 values, but \"arm\" takes 6"));
    assert!(one(&[("arn", 4)]).ends_with("fix: did you mean \"arn\"?"));
    assert!(one(&[]).contains("fix: no device there takes actions: add motors behind a CAN adapter"));
}

fn tensor(name: &str, element: Element, dims: &[u64]) -> TensorShape {
    // 0 represents an open dimension.
    let dims = dims.iter().map(|dim| (*dim > 0).then_some(*dim)).collect();
    TensorShape { name: name.to_owned(), element, dims }
}

fn graphs() -> (GraphShape, GraphShape) {
    let encoder = GraphShape {
        name: "encoder.onnx".to_owned(),
        inputs: vec![
            tensor("mask", Element::F32, &[0, 2]),
            tensor("state", Element::F32, &[0, 2, 4]),
            tensor("tactile", Element::F32, &[1, 2, 3, 96, 96]),
            tensor("wrist", Element::F32, &[0, 2, 3, 96, 96]),
        ],
        outputs: vec![tensor("global_cond", Element::F32, &[0, 264])],
    };
    let denoiser = GraphShape {
        name: "denoiser.onnx".to_owned(),
        inputs: vec![
            tensor("sample", Element::F32, &[0, 16, 4]),
            tensor("timestep", Element::I64, &[0]),
            tensor("global_cond", Element::F32, &[0, 264]),
        ],
        outputs: vec![tensor("whatever", Element::F32, &[0, 16, 4])],
    };
    (encoder, denoiser)
}

#[test]
fn graphs_as_described_are_accepted() {
    let (encoder, mut denoiser) = graphs();
    bundle().check_graphs(&encoder, &denoiser).unwrap();
    denoiser.outputs[0].dims = vec![None, None, None];
    bundle().check_graphs(&encoder, &denoiser).unwrap();
}

#[test]
fn a_history_has_two_inputs_of_its_own_length() {
    let text = include_str!("../../../tests/bundle/valid/history.json");
    let bundle = Bundle::parse(text, "policy.json").unwrap_or_else(|errors| panic!("{errors}"));
    let (mut encoder, denoiser) = graphs();
    let missing = problems(bundle.check_graphs(&encoder, &denoiser));
    assert_eq!(missing.len(), 2, "{missing:?}");
    assert!(missing[0].contains("has no input \"touched\", f32 [B, 12, 3, 96, 96] is expected"), "{missing:?}");
    assert!(missing[1].contains("has no input \"touched_valid\", f32 [B, 12] is expected"), "{missing:?}");
    encoder.inputs.push(tensor("touched", Element::F32, &[0, 12, 3, 96, 96]));
    encoder.inputs.push(tensor("touched_valid", Element::F32, &[0, 12]));
    bundle.check_graphs(&encoder, &denoiser).unwrap();
    encoder.inputs[4].dims = vec![None, Some(2), Some(3), Some(96), Some(96)];
    encoder.inputs[5].element = Element::I64;
    let wrong = problems(bundle.check_graphs(&encoder, &denoiser));
    assert_eq!(wrong.len(), 2, "{wrong:?}");
    assert!(wrong[1].contains("\"touched_valid\" is i64 [?, 12], by policy.json it is f32 [B, 12]"), "{wrong:?}");
}

#[test]
fn every_difference_from_the_graphs_is_reported() {
    let (mut encoder, mut denoiser) = graphs();
    encoder.inputs[0].dims = vec![None, Some(3)];
    encoder.inputs[1].name = "stat".to_owned();
    encoder.inputs[2].dims = vec![Some(8), Some(2), Some(3), Some(64), Some(96)];
    encoder.inputs[3].element = Element::Other("f16".to_owned());
    denoiser.inputs[1].element = Element::F32;
    denoiser.inputs[2].dims = vec![None, Some(200)];
    denoiser.outputs.push(tensor("extra", Element::F32, &[1]));
    let first_lines: Vec<String> = problems(bundle().check_graphs(&encoder, &denoiser))
        .iter()
        .map(|problem| problem.lines().next().unwrap_or_default().to_owned())
        .collect();
    assert_eq!(
        first_lines,
        [
            "[graphs.encoder] encoder.onnx: input \"wrist\" is f16 [?, 2, 3, 96, 96], \
             by policy.json it is f32 [B, 2, 3, 96, 96]",
            "[graphs.encoder] encoder.onnx: input \"tactile\" is f32 [8, 2, 3, 64, 96], \
             by policy.json it is f32 [B, 2, 3, 96, 96]",
            "[graphs.encoder] encoder.onnx has no input \"state\", f32 [B, 2, 4] is expected",
            "[graphs.encoder] encoder.onnx: input \"mask\" is f32 [?, 3], by policy.json it is f32 [B, 2]",
            "[graphs.encoder] encoder.onnx has the input \"stat\", which policy.json does not know",
            "[graphs.denoiser] denoiser.onnx: input \"timestep\" is f32 [?], by policy.json it is i64 [B]",
            "[graphs.denoiser] denoiser.onnx: input \"global_cond\" is f32 [?, 200], by policy.json it is f32 [B, 264]",
            "[graphs.denoiser] denoiser.onnx has the output \"extra\", which policy.json does not know",
        ]
    );
    denoiser.outputs.clear();
    let found = problems(bundle().check_graphs(&graphs().0, &denoiser));
    assert!(found.last().unwrap().contains("denoiser.onnx has no output, f32 [B, 16, 4] is expected"), "{found:?}");
}
