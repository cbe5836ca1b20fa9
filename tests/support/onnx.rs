//! Bundles small enough to compute by hand, written byte by byte, without any tool.
//!
//! The encoder returns one number per observation, the mean of its input; for one that is absent according to the mask
//! it returns 0, whatever the input. The denoiser's prediction is
//! `SAMPLE_SHARE * sample + CONDITION_SHARE * mean(global_cond) + TIMESTEP_SHARE * timestep`.
//!
//! Field and type numbers are those of `onnx.proto`.

#![allow(dead_code, reason = "each test binary uses its own part of this module")]
#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::fmt::Write as _;
use std::path::Path;

use sha2::{Digest as _, Sha256};

pub(crate) const SAMPLE_SHARE: f32 = 0.75;
pub(crate) const CONDITION_SHARE: f32 = 0.5;
pub(crate) const TIMESTEP_SHARE: f32 = 0.001;

/// Observation steps, actions per chunk, values per action.
pub(crate) const STEPS: usize = 2;
pub(crate) const HORIZON: usize = 16;
pub(crate) const ACTION: usize = 4;
/// Side of a picture.
pub(crate) const SIDE: usize = 8;

const FLOAT: u64 = 1;
const INT64: u64 = 7;
const BOOL: u64 = 9;

/// A change of the bundle: `with` replaces `what` in policy.json.
pub(crate) struct Change<'a> {
    pub(crate) what: &'a str,
    pub(crate) with: &'a str,
}

/// Writes the bundle: pictures `wrist` and `tactile`, numbers `state`; the mask has the pictures.
pub(crate) fn write_bundle(folder: &Path, changes: &[Change<'_>]) {
    write_graphs(folder, &encoder(), changes);
}

/// The same with another encoder.
pub(crate) fn write_graphs(folder: &Path, encoder: &[u8], changes: &[Change<'_>]) {
    write_both(folder, encoder, &denoiser(), changes);
}

/// The same with these graphs.
pub(crate) fn write_both(folder: &Path, encoder: &[u8], denoiser: &[u8], changes: &[Change<'_>]) {
    std::fs::create_dir_all(folder).expect("folder of the bundle");
    std::fs::write(folder.join("encoder.onnx"), encoder).expect("encoder");
    std::fs::write(folder.join("denoiser.onnx"), denoiser).expect("denoiser");
    let mut policy = POLICY.replace("ENCODER", &sum(encoder)).replace("DENOISER", &sum(denoiser));
    for Change { what, with } in changes {
        assert!(policy.contains(what), "{what} is not in policy.json");
        policy = policy.replace(what, with);
    }
    std::fs::write(folder.join("policy.json"), policy).expect("policy.json");
}

pub(crate) const POLICY: &str = r#"{
  "format": "rapid-policy/1", "name": "by-hand", "mask_aware": true,
  "n_obs_steps": 2, "horizon": 16, "n_action_steps": 8, "action_start": 1,
  "control_hz": 10.0, "max_observation_age_ms": 300,
  "observations": [
    {"key": "wrist", "kind": "image", "modality": "cam_wrist", "required": true, "shape": [3, 8, 8], "color": "rgb",
     "resize": [8, 8], "crop": null, "operation": null,
     "normalization": {"mode": "min_max", "min": [0, 0, 0], "max": [1, 1, 1]}},
    {"key": "tactile", "kind": "image", "modality": "tactile_tip", "required": false, "shape": [3, 8, 8], "color": "rgb",
     "resize": [8, 8], "crop": null, "operation": "diff_to_reference",
     "normalization": {"mode": "min_max", "min": [0, 0, 0], "max": [1, 1, 1]}},
    {"key": "state", "kind": "vector", "modality": "arm", "required": true, "shape": [4], "slice": [0, 4],
     "normalization": {"mode": "min_max", "min": [0, 0, 0, 0], "max": [2, 2, 2, 2]}}
  ],
  "mask": {"input": "mask", "order": ["cam_wrist", "tactile_tip"], "absent": "zero_embedding"},
  "action": {
    "actuator": "arm", "shape": [4], "names": ["x", "y", "z", "grip"], "units": ["m", "m", "m", "1"],
    "representation": "absolute", "limits": {"min": [-9, -9, -9, -9], "max": [9, 9, 9, 9]},
    "normalization": [{"slice": [0, 3], "mode": "min_max", "min": [-1, 0, 2], "max": [1, 4, 3]},
                      {"slice": [3, 4], "mode": "mean_std", "mean": [0.5], "std": [0.25]}]
  },
  "scheduler": {"type": "DDIM", "num_train_timesteps": 100, "beta_schedule": "linear", "beta_start": 0.0001,
    "beta_end": 0.02, "prediction_type": "epsilon", "clip_sample": false, "clip_sample_range": 1.0,
    "set_alpha_to_one": true, "steps_offset": 0, "timestep_spacing": "leading", "num_inference_steps": 10},
  "graphs": {"encoder": {"file": "encoder.onnx", "sha256": "ENCODER"},
             "denoiser": {"file": "denoiser.onnx", "sha256": "DENOISER"}},
  "training": {}
}"#;

fn sum(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

pub(crate) fn encoder() -> Vec<u8> {
    encoder_of(None)
}

/// The encoder where `tactile` is a history of `steps` steps: its number is the mean of the pictures and the mean of
/// `tactile_valid`, added, whatever the mask says.
pub(crate) fn encoder_of_history(steps: usize) -> Vec<u8> {
    encoder_of(Some(steps))
}

/// The change of `policy.json` for it: four steps, three ticks from one to the next.
pub(crate) const HISTORY: Change<'static> = Change {
    what: r#""modality": "tactile_tip", "required": false,"#,
    with: r#""modality": "tactile_tip", "required": false, "down_sample_steps": 3,
     "history": {"steps": 4, "valid": "tactile_valid"},"#,
};
/// Its steps.
pub(crate) const HISTORY_STEPS: usize = 4;

fn encoder_of(history: Option<usize>) -> Vec<u8> {
    let mut graph = Message::default();
    let images = |steps: usize| [0, steps as u64, 3, SIDE as u64, SIDE as u64];
    let (wrist, tactile) = (images(STEPS), images(history.unwrap_or(STEPS)));
    let inputs: [(&str, &[u64], Option<i64>); 3] = [
        ("wrist", &wrist, Some(0)),
        ("tactile", &tactile, Some(1)),
        ("state", &[0, STEPS as u64, ACTION as u64], None),
    ];
    let mut conditions = Vec::new();
    graph.message(5, &floats("zero", &[1, 1], &[0.0]));
    for (name, dims, place) in inputs {
        let named = |part: &str| format!("{name}_{part}");
        graph.message(11, &tensor(name, FLOAT, dims));
        graph.message(1, &node("Flatten", &[name], &named("flat"), &[integer("axis", 1)]));
        graph.message(1, &node("ReduceMean", &[&named("flat")], &named("mean"), &[integers("axes", &[1])]));
        if let Some(steps) = history.filter(|_| name == "tactile") {
            graph.message(11, &tensor("tactile_valid", FLOAT, &[0, steps as u64]));
            graph.message(1, &node("ReduceMean", &["tactile_valid"], "valid_mean", &[integers("axes", &[1])]));
            graph.message(1, &node("Add", &[&named("mean"), "valid_mean"], "felt", &[]));
            conditions.push("felt".to_owned());
            continue;
        }
        let Some(place) = place else {
            conditions.push(named("mean"));
            continue;
        };
        graph.message(5, &whole_numbers(&named("place"), &[1], &[place]));
        graph.message(1, &node("Gather", &["mask", &named("place")], &named("share"), &[integer("axis", 1)]));
        graph.message(1, &node("Cast", &[&named("share")], &named("there"), &[integer("to", BOOL)]));
        let parts = [&*named("there"), &*named("mean"), "zero"];
        graph.message(1, &node("Where", &parts, &named("or_zero"), &[]));
        conditions.push(named("or_zero"));
    }
    graph.message(11, &tensor("mask", FLOAT, &[0, 2]));
    let conditions: Vec<&str> = conditions.iter().map(String::as_str).collect();
    graph.message(1, &node("Concat", &conditions, "global_cond", &[integer("axis", 1)]));
    graph.message(12, &tensor("global_cond", FLOAT, &[0, conditions.len() as u64]));
    model(graph)
}

pub(crate) fn denoiser() -> Vec<u8> {
    denoiser_of(SAMPLE_SHARE, false)
}

/// The denoiser with another share of the sample; if it `loops`, it adds up something without an end.
pub(crate) fn denoiser_of(sample_share: f32, loops: bool) -> Vec<u8> {
    let mut graph = Message::default();
    let sample = [0, HORIZON as u64, ACTION as u64];
    graph.message(11, &tensor("sample", FLOAT, &sample));
    graph.message(11, &tensor("timestep", INT64, &[0]));
    graph.message(11, &tensor("global_cond", FLOAT, &[0, 3]));
    for (name, share) in [("a", sample_share), ("b", CONDITION_SHARE), ("c", TIMESTEP_SHARE)] {
        graph.message(5, &floats(name, &[1], &[share]));
    }
    graph.message(5, &whole_numbers("column", &[3], &[-1, 1, 1]));
    graph.message(1, &node("ReduceMean", &["global_cond"], "mean", &[integers("axes", &[1])]));
    graph.message(1, &node("Cast", &["timestep"], "time", &[integer("to", FLOAT)]));
    for (from, share, to) in [("sample", "a", "x"), ("mean", "b", "y_flat"), ("time", "c", "t_flat")] {
        graph.message(1, &node("Mul", &[from, share], to, &[]));
    }
    graph.message(1, &node("Reshape", &["y_flat", "column"], "y", &[]));
    graph.message(1, &node("Reshape", &["t_flat", "column"], "t", &[]));
    graph.message(1, &node("Add", &["x", "y"], "xy", &[]));
    if loops {
        graph.message(5, &whole_numbers("most", &[], &[i64::MAX]));
        graph.message(5, &constant("goes_on", BOOL, &[], &[1]));
        graph.message(1, &node("Loop", &["most", "goes_on", "xy"], "xyz", &[subgraph("body", &endless_body(&sample))]));
    }
    let sum = if loops { "xyz" } else { "xy" };
    graph.message(1, &node("Add", &[sum, "t"], "prediction", &[]));
    graph.message(12, &tensor("prediction", FLOAT, &sample));
    model(graph)
}

/// The body of a loop that adds a number to what it carries, each time.
fn endless_body(carried: &[u64]) -> Message {
    let mut body = Message::default();
    body.bytes(2, b"body");
    body.message(11, &tensor("turn", INT64, &[])).message(11, &tensor("again", BOOL, &[]));
    body.message(11, &tensor("in", FLOAT, carried));
    body.message(5, &floats("little", &[1], &[0.001]));
    body.message(1, &node("Identity", &["again"], "once_more", &[]));
    body.message(1, &node("Add", &["in", "little"], "out", &[]));
    body.message(12, &tensor("once_more", BOOL, &[])).message(12, &tensor("out", FLOAT, carried));
    body
}

/// The encoder with an additional field in the model (`field` of `ModelProto`).
pub(crate) fn encoder_with(field: u64, more: &Message) -> Vec<u8> {
    let mut model = Message(encoder());
    model.message(field, more);
    model.0
}

/// `TensorProto` whose four floats are in the file `weights.bin`.
pub(crate) fn external(name: &str) -> Message {
    let mut entry = Message::default();
    entry.bytes(1, b"location").bytes(2, b"weights.bin");
    let mut tensor = Message::default();
    tensor.number(1, 4).number(2, FLOAT).bytes(8, name.as_bytes()).message(13, &entry).number(14, 1);
    tensor
}

/// A message with one message in it.
pub(crate) fn within(field: u64, inside: &Message) -> Message {
    let mut message = Message::default();
    message.message(field, inside);
    message
}

/// An encoded protobuf message: its fields in order.
#[derive(Default)]
pub(crate) struct Message(Vec<u8>);

impl Message {
    pub(crate) fn number(&mut self, field: u64, value: u64) -> &mut Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    pub(crate) fn bytes(&mut self, field: u64, bytes: &[u8]) -> &mut Self {
        self.varint(field << 3 | 2);
        self.varint(bytes.len() as u64);
        self.0.extend_from_slice(bytes);
        self
    }

    pub(crate) fn message(&mut self, field: u64, message: &Self) -> &mut Self {
        self.bytes(field, &message.0)
    }

    fn varint(&mut self, mut value: u64) {
        loop {
            let low = value.to_le_bytes()[0] & 0x7f;
            value >>= 7;
            self.0.push(if value == 0 { low } else { low | 0x80 });
            if value == 0 {
                return;
            }
        }
    }
}

/// `ModelProto` of operator set 13.
fn model(mut graph: Message) -> Vec<u8> {
    graph.bytes(2, b"by hand");
    let mut operators = Message::default();
    operators.bytes(1, b"").number(2, 13);
    let mut model = Message::default();
    model.number(1, 8).message(7, &graph).message(8, &operators);
    model.0
}

/// `NodeProto`.
fn node(operator: &str, inputs: &[&str], output: &str, attributes: &[Message]) -> Message {
    let mut node = Message::default();
    for input in inputs {
        node.bytes(1, input.as_bytes());
    }
    node.bytes(2, output.as_bytes()).bytes(4, operator.as_bytes());
    for attribute in attributes {
        node.message(5, attribute);
    }
    node
}

/// `AttributeProto` of one integer.
fn integer(name: &str, value: u64) -> Message {
    let mut attribute = Message::default();
    attribute.bytes(1, name.as_bytes()).number(3, value).number(20, 2);
    attribute
}

/// `AttributeProto` of a graph.
fn subgraph(name: &str, graph: &Message) -> Message {
    let mut attribute = Message::default();
    attribute.bytes(1, name.as_bytes()).message(6, graph).number(20, 5);
    attribute
}

/// `AttributeProto` of integers.
fn integers(name: &str, values: &[u64]) -> Message {
    let mut attribute = Message::default();
    attribute.bytes(1, name.as_bytes());
    for value in values {
        attribute.number(8, *value);
    }
    attribute.number(20, 7);
    attribute
}

/// `TensorProto` of floats.
fn floats(name: &str, dims: &[u64], values: &[f32]) -> Message {
    let raw: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    constant(name, FLOAT, dims, &raw)
}

/// `TensorProto` of integers.
fn whole_numbers(name: &str, dims: &[u64], values: &[i64]) -> Message {
    let raw: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    constant(name, INT64, dims, &raw)
}

fn constant(name: &str, element: u64, dims: &[u64], raw: &[u8]) -> Message {
    let mut tensor = Message::default();
    for dim in dims {
        tensor.number(1, *dim);
    }
    tensor.number(2, element).bytes(8, name.as_bytes()).bytes(9, raw);
    tensor
}

/// `ValueInfoProto`; dimension 0 is the open one, "B".
fn tensor(name: &str, element: u64, dims: &[u64]) -> Message {
    let mut shape = Message::default();
    for dim in dims {
        let mut dimension = Message::default();
        match dim {
            0 => dimension.bytes(2, b"B"),
            known => dimension.number(1, *known),
        };
        shape.message(1, &dimension);
    }
    let mut kind = Message::default();
    kind.number(1, element).message(2, &shape);
    let mut of_tensor = Message::default();
    of_tensor.message(1, &kind);
    let mut info = Message::default();
    info.bytes(1, name.as_bytes()).message(2, &of_tensor);
    info
}
