//! Graphs: the networks of a bundle, loaded and run.
//!
//! [`Graph::load`] reads one, which says of itself what it takes and gives ([`Graph::shape`]). Held
//! against its bundle, it is [bound](Graph::bind) to memory for one batch of every tensor, which every
//! later run reads and writes in place.
//!
//! Invariant: a run on bound memory allocates nothing on this side of the library.

use ort::memory::Allocator;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::session::{HasSelectedOutputs, OutputSelector, RunOptions, Session, SessionInputValue};
use ort::value::{DynValue, Outlet, Tensor, TensorElementType, ValueType};

use super::bundle::{Element, GraphShape, TensorShape};
use super::library::Environment;

/// Why a graph cannot be loaded or run.
#[derive(Debug, thiserror::Error)]
pub enum GraphError {
    /// The file is no graph, or one this onnxruntime cannot run.
    #[error("{name}: onnxruntime cannot load it: {error}")]
    Load {
        /// The graph's file.
        name: String,
        /// In onnxruntime's words.
        error: String,
    },
    /// A tensor of a kind that no bundle has.
    #[error("{name}: `{tensor}` is not a tensor of 32-bit floats or 64-bit integers with at most 2^31 elements")]
    Kind {
        /// The graph's file.
        name: String,
        /// The input or output.
        tensor: String,
    },
    /// A run failed.
    #[error("{name}: {error}")]
    Run {
        /// The graph's file.
        name: String,
        /// In onnxruntime's words.
        error: String,
    },
}

/// A graph that has been loaded.
#[derive(Debug)]
pub struct Graph {
    name: String,
    session: Session,
}

impl Graph {
    /// Reads a graph from the bytes of the file called `name`. It will run on `threads` threads, the
    /// calling one among them, at least 1.
    ///
    /// # Errors
    /// When the bytes are no graph that this onnxruntime can run.
    pub fn load(environment: &Environment, name: &str, bytes: &[u8], threads: usize) -> Result<Self, GraphError> {
        let session = Session::builder(environment.ort())
            .and_then(|builder| configure(builder, name, threads))
            .and_then(|mut builder| builder.commit_from_memory(bytes))
            .map_err(|error| GraphError::Load { name: name.to_owned(), error: error.to_string() })?;
        Ok(Self { name: name.to_owned(), session })
    }

    /// What it takes and gives.
    #[must_use]
    pub fn shape(&self) -> GraphShape {
        GraphShape {
            name: self.name.clone(),
            inputs: self.session.inputs().iter().map(tensor_shape).collect(),
            outputs: self.session.outputs().iter().map(tensor_shape).collect(),
        }
    }

    /// Makes the memory of its inputs, filled with zeros, and of its outputs. Dimensions that it
    /// leaves open become 1.
    ///
    /// # Errors
    /// When it has tensors that no bundle has, or there is no memory.
    pub fn bind(self) -> Result<BoundGraph, GraphError> {
        let Self { name, session } = self;
        let inputs = session
            .inputs()
            .iter()
            .map(|input| make_input(&name, &tensor_shape(input)).map(SessionInputValue::Owned))
            .collect::<Result<Vec<_>, _>>()?;
        let mut selector = OutputSelector::default();
        let mut output_lens = Vec::new();
        for output in session.outputs() {
            let (value, len) = make_output(&name, &tensor_shape(output))?;
            selector = selector.preallocate(output.name(), value);
            output_lens.push(len);
        }
        let options = RunOptions::new().map_err(|error| run_error(&name, &error))?.with_outputs(selector);
        Ok(BoundGraph { name, session, inputs, output_lens, options })
    }
}

/// A graph with memory for one batch of each of its tensors.
pub struct BoundGraph {
    name: String,
    session: Session,
    inputs: Vec<SessionInputValue<'static>>,
    output_lens: Vec<usize>,
    options: RunOptions<HasSelectedOutputs>,
}

impl BoundGraph {
    /// The place among the inputs of the one called `name`.
    #[must_use]
    pub fn input_index(&self, name: &str) -> Option<usize> {
        self.session.inputs().iter().position(|input| input.name() == name)
    }

    /// Numbers of the output with this place among the outputs.
    #[must_use]
    pub fn output_len(&self, index: usize) -> Option<usize> {
        self.output_lens.get(index).copied()
    }

    /// The numbers of an input, to be written.
    ///
    /// # Errors
    /// When there is no such input, or it has no floats.
    pub fn input(&mut self, index: usize) -> Result<&mut [f32], GraphError> {
        self.values(index)
    }

    /// The whole numbers of an input, to be written.
    ///
    /// # Errors
    /// When there is no such input, or it has no 64-bit integers.
    pub fn input_integers(&mut self, index: usize) -> Result<&mut [i64], GraphError> {
        self.values(index)
    }

    fn values<T: ort::value::PrimitiveTensorElementType>(&mut self, index: usize) -> Result<&mut [T], GraphError> {
        let wrong = |error: String| GraphError::Run { name: self.name.clone(), error };
        match self.inputs.get_mut(index) {
            Some(SessionInputValue::Owned(value)) => {
                value.try_extract_tensor_mut().map(|(_, values)| values).map_err(|error| wrong(error.to_string()))
            }
            _ => Err(wrong(format!("there is no input {index}"))),
        }
    }

    /// Runs the graph on what its inputs hold, and hands over its first output.
    ///
    /// # Errors
    /// When onnxruntime says so.
    pub fn run<T>(&mut self, read: impl FnOnce(&[f32]) -> T) -> Result<T, GraphError> {
        let outputs = self.session.run_with_options(self.inputs.as_slice(), &self.options);
        outputs
            .and_then(|outputs| match outputs.values().next() {
                Some(output) => output.try_extract_tensor().map(|(_, values)| read(values)),
                None => Err(ort::Error::new("the graph has no output")),
            })
            .map_err(|error| run_error(&self.name, &error))
    }
}

impl std::fmt::Debug for BoundGraph {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BoundGraph").field("name", &self.name).finish_non_exhaustive()
    }
}

/// One node after the other, on as few threads as were asked for, none of which burns time while it
/// has nothing to do: the rig's other tasks want the processor too.
fn configure(builder: SessionBuilder, name: &str, threads: usize) -> ort::Result<SessionBuilder> {
    Ok(builder
        .with_intra_threads(threads.max(1))?
        .with_inter_threads(1)?
        .with_parallel_execution(false)?
        .with_intra_op_spinning(false)?
        .with_inter_op_spinning(false)?
        .with_optimization_level(GraphOptimizationLevel::All)?
        .with_log_level(ort::logging::LogLevel::Warning)?
        .with_log_id(name)?)
}

fn tensor_shape(outlet: &Outlet) -> TensorShape {
    let (element, dims) = match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => {
            let element = match ty {
                TensorElementType::Float32 => Element::F32,
                TensorElementType::Int64 => Element::I64,
                other => Element::Other(other.to_string()),
            };
            (element, shape.iter().map(|dim| u64::try_from(*dim).ok()).collect())
        }
        other => (Element::Other(other.to_string()), Vec::new()),
    };
    TensorShape { name: outlet.name().to_owned(), element, dims }
}

/// The shape of a tensor's memory, and how many elements that is.
fn dims(graph: &str, shape: &TensorShape) -> Result<(Vec<i64>, usize), GraphError> {
    const MOST: usize = 1 << 31;
    let mut dims = Vec::with_capacity(shape.dims.len());
    let mut len = Some(1_usize);
    for dim in &shape.dims {
        let dim = dim.unwrap_or(1);
        dims.push(i64::try_from(dim).unwrap_or(i64::MAX));
        len = usize::try_from(dim).ok().and_then(|dim| len?.checked_mul(dim));
    }
    match len {
        Some(len @ 1..=MOST) => Ok((dims, len)),
        _ => Err(kind(graph, shape)),
    }
}

fn make_input(graph: &str, shape: &TensorShape) -> Result<DynValue, GraphError> {
    let (dims, len) = dims(graph, shape)?;
    let value = match shape.element {
        Element::F32 => Tensor::from_array((dims, vec![0_f32; len])).map(Tensor::into_dyn),
        Element::I64 => Tensor::from_array((dims, vec![0_i64; len])).map(Tensor::into_dyn),
        Element::Other(_) => return Err(kind(graph, shape)),
    };
    value.map_err(|error| run_error(graph, &error))
}

/// Memory that a run writes before anybody reads it, and how many elements it has.
fn make_output(graph: &str, shape: &TensorShape) -> Result<(DynValue, usize), GraphError> {
    let (dims, len) = dims(graph, shape)?;
    if shape.element != Element::F32 {
        return Err(kind(graph, shape));
    }
    let value = Tensor::<f32>::new(&Allocator::default(), dims).map_err(|error| run_error(graph, &error))?;
    Ok((value.into_dyn(), len))
}

fn kind(graph: &str, shape: &TensorShape) -> GraphError {
    GraphError::Kind { name: graph.to_owned(), tensor: shape.name.clone() }
}

fn run_error(graph: &str, error: &ort::Error) -> GraphError {
    GraphError::Run { name: graph.to_owned(), error: error.to_string() }
}
