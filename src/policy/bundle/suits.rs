//! Compares a bundle with its rig, and with the inputs and outputs that its graphs declare.

use std::fmt;

use rapid_core::modality::ModalityKind;
use rapid_registry::{Registry, did_you_mean};

use super::files::Graph;
use super::read::Problems;
use super::spec::{BasePose, Bundle, BundleErrors, ImageSpec, ObservationInput, VectorSpec};

/// Channels of a picture.
const CHANNELS: usize = 3;

/// The interface of a graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GraphShape {
    /// The file's name, for messages: `encoder.onnx`.
    pub name: String,
    /// Its inputs, in the graph's order.
    pub inputs: Vec<TensorShape>,
    /// Its outputs, in the graph's order.
    pub outputs: Vec<TensorShape>,
}

/// One input or output of a graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorShape {
    /// Its name in the graph.
    pub name: String,
    /// The type of its elements.
    pub element: Element,
    /// Its dimensions; `None` is a dimension that the graph leaves open.
    pub dims: Vec<Option<u64>>,
}

/// The type of a tensor's elements.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Element {
    /// 32-bit floats.
    F32,
    /// 64-bit signed integers.
    I64,
    /// Any other, by a name for people: `f16`. No graph of a bundle may have such inputs or outputs.
    Other(String),
}

impl fmt::Display for Element {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::F32 => f.write_str("f32"),
            Self::I64 => f.write_str("i64"),
            Self::Other(name) => f.write_str(name),
        }
    }
}

/// What a tensor of a bundle's graph must be.
struct Wanted<'a> {
    /// `None` accepts any name.
    name: Option<&'a str>,
    element: Element,
    /// Without the batch dimension; `None` is a dimension that the file does not specify.
    dims: Vec<Option<u64>>,
}

impl<'a> Wanted<'a> {
    fn new(name: &'a str, element: Element, dims: &[usize]) -> Self {
        Self { name: Some(name), element, dims: dims.iter().map(|dim| Some(*dim as u64)).collect() }
    }

    fn shape(&self) -> String {
        let batch = std::iter::once("B".to_owned());
        let dims = batch.chain(self.dims.iter().map(|dim| shown(*dim)));
        format!("{} [{}]", self.element, dims.collect::<Vec<_>>().join(", "))
    }

    /// A batch of one must be possible; an open dimension matches.
    fn fits(&self, found: &TensorShape) -> bool {
        let batch = std::iter::once(Some(1));
        let wanted = batch.chain(self.dims.iter().copied());
        self.element == found.element
            && self.dims.len() + 1 == found.dims.len()
            && wanted.zip(&found.dims).all(|pair| !matches!(pair, (Some(a), Some(b)) if a != *b))
    }
}

impl Bundle {
    /// Checks that all observed modalities are in the registry, with the expected kind and size.
    ///
    /// # Errors
    /// Every observation that does not match.
    pub fn check_registry(&self, registry: &Registry) -> Result<(), BundleErrors> {
        let mut problems = Problems::new(&self.label());
        let known: Vec<&str> = registry.devices.iter().map(|device| device.name.as_str()).collect();
        for (at, observation) in self.observations.iter().enumerate() {
            let entry = format!("observations[{at}]");
            let name = &observation.modality;
            let Some(device) = registry.named(name) else {
                let message = format!("modality \"{name}\" is not in devices.toml");
                problems.report(&entry, message, did_you_mean(name, &known, "the modalities of this rig are"));
                continue;
            };
            let modality = device.modality();
            match (&observation.input, modality.kind) {
                (ObservationInput::Image(image), ModalityKind::Image) => {
                    picture(&entry, name, image, &modality.shape, &mut problems);
                }
                (ObservationInput::Vector(vector), ModalityKind::Scalars) => {
                    let channels = modality.shape.first().map_or(0, |channels| *channels as usize);
                    numbers(&entry, name, vector, channels, &mut problems);
                }
                (input, kind) => {
                    let wanted = match input {
                        ObservationInput::Image(_) => "images",
                        ObservationInput::Vector(_) => "values",
                    };
                    let given = match kind {
                        ModalityKind::Image => "images",
                        ModalityKind::Depth => "depth images",
                        ModalityKind::Scalars => "values",
                        ModalityKind::Bytes => "bytes without a known structure",
                    };
                    let message = format!("wants {wanted}, but the device \"{name}\" gives {given}");
                    let fix = format!("give [device.{name}] in devices.toml a device that gives {wanted}");
                    problems.report(&entry, message, fix);
                }
            }
        }
        if let Some(base) = self.action.representation.base()
            && let Some(device) = registry.named(&base.modality)
        {
            let modality = device.modality();
            let channels = modality.shape.first().map_or(0, |channels| *channels as usize);
            if modality.kind == ModalityKind::Scalars {
                pose(base, channels, &mut problems);
            }
        }
        problems.check()
    }

    /// Checks that its actuator is one of `actuators`, which are given with the number of values of an executed action.
    ///
    /// # Errors
    /// When it is not, or its actions have another length.
    pub fn check_actuators(&self, actuators: &[(&str, usize)]) -> Result<(), BundleErrors> {
        let mut problems = Problems::new(&self.label());
        let (wanted, len) = (self.action.actuator.as_str(), self.action.len());
        match actuators.iter().find(|(name, _)| *name == wanted) {
            Some((_, values)) if *values == len => {}
            Some((_, values)) => {
                let message = format!("has {len} values, but \"{wanted}\" takes {values}");
                let fix = format!("correct [device.{wanted}.action] in devices.toml, or take another bundle");
                problems.report("action", message, fix);
            }
            None => {
                let names: Vec<&str> = actuators.iter().map(|(name, _)| *name).collect();
                let fix = if names.is_empty() {
                    format!(
                        "no device there takes actions: add motors behind a CAN adapter, or a program that moves \
                         \"{wanted}\" and has the table [device.{wanted}.action]"
                    )
                } else {
                    did_you_mean(wanted, &names, "devices that take actions are")
                };
                problems.report("action", format!("actuator \"{wanted}\" takes no actions in devices.toml"), fix);
            }
        }
        problems.check()
    }

    /// Checks that the graphs' inputs and outputs are those that this bundle describes. The batch dimension is open or
    /// 1; any length of `global_cond` is accepted if the graphs agree on it.
    ///
    /// # Errors
    /// Every input and output that is missing, superfluous, or of another type or shape.
    pub fn check_graphs(&self, encoder: &GraphShape, denoiser: &GraphShape) -> Result<(), BundleErrors> {
        let mut problems = Problems::new(&self.label());
        let mut inputs: Vec<Wanted> = Vec::new();
        for observation in &self.observations {
            let steps = self.steps_of(observation);
            inputs.push(match &observation.input {
                ObservationInput::Image(image) => {
                    Wanted::new(&observation.key, Element::F32, &[steps, CHANNELS, image.height, image.width])
                }
                ObservationInput::Vector(vector) => Wanted::new(&observation.key, Element::F32, &[steps, vector.len]),
            });
            inputs.extend(observation.history.iter().map(|one| Wanted::new(&one.valid, Element::F32, &[steps])));
        }
        if let Some(mask) = &self.mask {
            inputs.push(Wanted::new(&mask.input, Element::F32, &[mask.order.len()]));
        }
        let condition = |len| Wanted { name: Some("global_cond"), element: Element::F32, dims: vec![len] };
        let actions = [self.horizon, self.action.outputs()];
        compare(Graph::Encoder, encoder, "input", &inputs, &mut problems);
        compare(Graph::Encoder, encoder, "output", &[condition(None)], &mut problems);
        let given = encoder.outputs.iter().find(|output| output.name == "global_cond");
        let given = given.and_then(|output| output.dims.get(1).copied().flatten());
        let inputs = [
            Wanted::new("sample", Element::F32, &actions),
            Wanted { name: Some("timestep"), element: Element::I64, dims: Vec::new() },
            condition(given),
        ];
        compare(Graph::Denoiser, denoiser, "input", &inputs, &mut problems);
        let prediction = Wanted { name: None, ..Wanted::new("", Element::F32, &actions) };
        compare(Graph::Denoiser, denoiser, "output", &[prediction], &mut problems);
        problems.check()
    }
}

/// Reports where the inputs or outputs (`what`) of a graph differ from those `wanted`.
fn compare(graph: Graph, shape: &GraphShape, what: &str, wanted: &[Wanted], problems: &mut Problems) {
    let entry = format!("graphs.{}", graph.key());
    let (name, found) = (&shape.name, if what == "input" { &shape.inputs } else { &shape.outputs });
    let names: Vec<&str> = found.iter().map(|tensor| tensor.name.as_str()).collect();
    for wanted in wanted {
        let tensor = match wanted.name {
            Some(wanted) => found.iter().find(|tensor| tensor.name == wanted),
            None => found.first(),
        };
        let label = wanted.name.map_or_else(|| what.to_owned(), |wanted| format!("{what} \"{wanted}\""));
        let Some(tensor) = tensor else {
            let fix = wanted.name.map_or_else(
                || "export the graph again".to_owned(),
                |wanted| did_you_mean(wanted, &names, &format!("its {what}s are")),
            );
            problems.report(&entry, format!("{name} has no {label}, {} is expected", wanted.shape()), fix);
            continue;
        };
        if !wanted.fits(tensor) {
            let dims: Vec<String> = tensor.dims.iter().map(|dim| shown(*dim)).collect();
            let is = format!("{} [{}]", tensor.element, dims.join(", "));
            let message = format!("{name}: {label} is {is}, by policy.json it is {}", wanted.shape());
            problems.report(&entry, message, "export the graph again, or correct policy.json: B is open or 1");
        }
    }
    let superfluous =
        |tensor: &&TensorShape| wanted.iter().all(|wanted| wanted.name.is_some_and(|name| name != tensor.name));
    // The only output of a denoiser is the first one, whatever its name.
    let unnamed = usize::from(wanted.iter().any(|wanted| wanted.name.is_none()));
    let others = found.iter().skip(unnamed).filter(|tensor| unnamed == 1 || superfluous(tensor));
    for tensor in others {
        let message = format!("{name} has the {what} \"{}\", which policy.json does not know", tensor.name);
        problems.report(&entry, message, "export the graph again, or add what is missing to policy.json");
    }
}

fn shown(dim: Option<u64>) -> String {
    dim.map_or_else(|| "?".to_owned(), |dim| dim.to_string())
}

fn picture(entry: &str, name: &str, image: &ImageSpec, shape: &[u32], problems: &mut Problems) {
    // If it is resized, any size is accepted.
    let (None, [height, width]) = (image.resize, shape) else { return };
    let (height, width) = (*height as usize, *width as usize);
    let wanted = image.crop.unwrap_or([image.height, image.width]);
    let fits = match image.crop {
        Some(crop) => crop[0] <= height && crop[1] <= width,
        None => wanted == [height, width],
    };
    if !fits {
        let than = if image.crop.is_some() { "at least " } else { "" };
        let message = format!(
            "wants images of {than}{}x{} (height x width), but \"{name}\" gives {height}x{width}",
            wanted[0], wanted[1]
        );
        let fix = format!(
            "set width = {} and height = {} in devices.toml, or \"resize\": [{}, {}] here",
            wanted[1], wanted[0], wanted[0], wanted[1]
        );
        problems.report(entry, message, fix);
    }
}

/// The pose that actions are relative to, in samples of `channels` numbers.
fn pose(base: &BasePose, channels: usize, problems: &mut Problems) {
    for (key, range) in [("position", Some(&base.position)), ("rotation", base.rotation.as_ref())] {
        if let Some(range) = range.filter(|range| range.end > channels) {
            let name = &base.modality;
            let message = format!("ends at {}, but \"{name}\" gives {channels} values", range.end);
            let fix = format!("correct it, or channels of \"{name}\" in devices.toml");
            problems.report(&format!("action.base.{key}"), message, fix);
        }
    }
}

fn numbers(entry: &str, name: &str, vector: &VectorSpec, channels: usize, problems: &mut Problems) {
    match &vector.slice {
        Some(slice) if slice.end > channels => {
            let message = format!("slice ends at {}, but \"{name}\" gives {channels} values", slice.end);
            problems.report(entry, message, format!("correct the slice, or channels of \"{name}\" in devices.toml"));
        }
        None if vector.len != channels => {
            let message = format!("wants {} values, but \"{name}\" gives {channels}", vector.len);
            let fix = format!("write \"slice\": [begin, end], or correct channels of \"{name}\" in devices.toml");
            problems.report(entry, message, fix);
        }
        _ => {}
    }
}
