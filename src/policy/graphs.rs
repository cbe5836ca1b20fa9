//! Graphs: the networks of a bundle, loaded and run.
//!
//! [`LoadedGraph::load`] reads one, which declares its inputs and outputs ([`LoadedGraph::shape`]). Once
//! checked against its bundle, it is [bound](LoadedGraph::bind) to memory for one batch of every tensor, which every
//! later run reads and writes in place.
//!
//! Invariant: a run on bound memory allocates nothing on this side of the library.

use std::sync::Arc;
use std::time::Duration;

use ort::ep;
use ort::memory::Allocator;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::session::{HasSelectedOutputs, OutputSelector, RunOptions, Session, SessionInputValue};
use ort::value::{DynValue, Outlet, PrimitiveTensorElementType, Tensor, TensorElementType, ValueType};
use rapid_registry::{InferenceSpec, Provider};

use super::bundle::{Element, GraphShape, TensorShape};
use super::onnxruntime::Environment;

/// Why a graph cannot be loaded or run.
#[derive(Debug, thiserror::Error)]
#[error("{name}: {what}")]
pub struct GraphError {
    /// The graph's file.
    pub name: String,
    /// What is wrong.
    pub what: GraphProblem,
}

/// What is wrong with a graph.
#[derive(Debug, thiserror::Error)]
pub enum GraphProblem {
    /// The file is not a graph, or not one this onnxruntime can run; with its message.
    #[error("onnxruntime cannot load it: {0}")]
    Load(String),
    /// Its library does not compute on this provider.
    #[error(
        "--provider {provider}: {library} does not compute on it: {reason}; leave it out, or name a libonnxruntime.so with \
         it by --ort-lib (the Python package `onnxruntime-gpu` holds one, in its folder `capi`)"
    )]
    Provider {
        /// Its word.
        provider: &'static str,
        /// Where the library comes from.
        library: String,
        /// In onnxruntime's words.
        reason: String,
    },
    /// A tensor of this name has a type that no bundle uses.
    #[error("`{0}` is not a tensor of 32-bit floats or 64-bit integers with at most 2^31 elements")]
    Kind(String),
    /// The input of this name is missing.
    #[error("there is no input `{0}`")]
    NoInput(String),
    /// The data written to the input with this index does not match it.
    #[error("input {0} does not take what it is given")]
    Input(usize),
    /// A run failed, with onnxruntime's message.
    #[error("{0}")]
    Run(String),
    /// Its first run has not ended within this time.
    #[error(
        "its trial run has not ended after {0:?}: it has a loop without an end, or is far too slow for this machine; export \
         it again, or try fewer --denoising-steps or more --threads"
    )]
    Endless(Duration),
    /// A chunk of the trial is NaN or infinite.
    #[error(
        "its trial run gives NaN or infinity: all actions would be refused; export it again, from weights and statistics \
         that are finite"
    )]
    NotFinite,
}

impl GraphProblem {
    pub(super) fn in_graph(self, name: &str) -> GraphError {
        GraphError { name: name.to_owned(), what: self }
    }
}

/// A graph that has been loaded.
#[derive(Debug)]
pub struct LoadedGraph {
    name: String,
    session: Session,
}

impl LoadedGraph {
    /// Reads a graph from the bytes of the file called `name`, to be computed on `on`.
    ///
    /// # Errors
    /// When the bytes are not a graph that this onnxruntime can run, or it does not have the provider.
    pub fn load(environment: &Environment, name: &str, bytes: &[u8], on: InferenceSpec) -> Result<Self, GraphError> {
        let builder = Session::builder(&environment.ort).and_then(|builder| configure(builder, name, on.threads));
        let builder = builder.map_err(|error| GraphProblem::Load(error.to_string()).in_graph(name))?;
        let session = provided(builder, on.provider)
            .map_err(|error| {
                let (provider, library) = (on.provider.word(), environment.origin.to_string());
                GraphProblem::Provider { provider, library, reason: error.to_string() }.in_graph(name)
            })?
            .commit_from_memory(bytes)
            .map_err(|error| GraphProblem::Load(error.to_string()).in_graph(name))?;
        Ok(Self { name: name.to_owned(), session })
    }

    /// Its inputs and outputs.
    pub fn shape(&self) -> GraphShape {
        GraphShape {
            name: self.name.clone(),
            inputs: self.session.inputs().iter().map(tensor_shape).collect(),
            outputs: self.session.outputs().iter().map(tensor_shape).collect(),
        }
    }

    /// Allocates its inputs, filled with zeros, and its outputs. Open dimensions become 1.
    ///
    /// # Errors
    /// When it has tensors that no bundle uses, or memory is exhausted.
    pub fn bind(self) -> Result<BoundGraph, GraphError> {
        let Self { name, session } = self;
        let inputs = session
            .inputs()
            .iter()
            .map(|input| make_input(&name, &tensor_shape(input)).map(SessionInputValue::Owned))
            .collect::<Result<Vec<_>, _>>()?;
        let mut selector = OutputSelector::default();
        for output in session.outputs() {
            selector = selector.preallocate(output.name(), make_output(&name, &tensor_shape(output))?);
        }
        let options = RunOptions::new().map_err(|error| run_error(&name, &error))?.with_outputs(selector);
        Ok(BoundGraph { name, session, inputs, options, trial: None, is_finite: true })
    }
}

/// Ends the runs of graphs that are [on trial](BoundGraph::set_trial), from another thread.
#[derive(Clone)]
pub struct Trial(Arc<RunOptions>);

impl Trial {
    /// A new one.
    ///
    /// # Errors
    /// When onnxruntime has no memory.
    pub fn new() -> Result<Self, GraphError> {
        RunOptions::new().map(|options| Self(Arc::new(options))).map_err(|error| run_error("onnxruntime", &error))
    }

    /// Ends them, after the node that each of them computes: they are errors then.
    pub fn end(&self) {
        // It fails for null only.
        let _ = self.0.terminate();
    }
}

/// A graph with memory for one batch of each of its tensors.
pub struct BoundGraph {
    name: String,
    session: Session,
    inputs: Vec<SessionInputValue<'static>>,
    options: RunOptions<HasSelectedOutputs>,
    trial: Option<Trial>,
    /// All numbers of its trial's runs are finite.
    is_finite: bool,
}

impl BoundGraph {
    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Puts it on trial, or ends that: until then, its runs can be ended, and allocate.
    pub fn set_trial(&mut self, trial: Option<Trial>) {
        if trial.is_some() {
            self.is_finite = true;
        }
        self.trial = trial;
    }

    /// Whether all numbers of its last trial are finite.
    pub const fn is_finite(&self) -> bool {
        self.is_finite
    }

    /// The index of the input called `name`.
    ///
    /// # Errors
    /// When there is none.
    pub fn input_index(&self, name: &str) -> Result<usize, GraphError> {
        let place = self.session.inputs().iter().position(|input| input.name() == name);
        place.ok_or_else(|| GraphProblem::NoInput(name.to_owned()).in_graph(&self.name))
    }

    /// Writes the numbers of an input.
    ///
    /// # Errors
    /// When there is no such input, or its type or length differs.
    pub fn write(&mut self, index: usize, values: &[f32]) -> Result<(), GraphError> {
        self.fill(index, |place: &mut [f32]| {
            let fits = place.len() == values.len();
            if fits {
                place.copy_from_slice(values);
            }
            fits
        })
    }

    /// Fills an input with one integer.
    ///
    /// # Errors
    /// When there is no such input, or its type differs.
    pub fn write_integer(&mut self, index: usize, value: i64) -> Result<(), GraphError> {
        self.fill(index, |place: &mut [i64]| {
            place.fill(value);
            true
        })
    }

    fn fill<T: PrimitiveTensorElementType>(
        &mut self,
        index: usize,
        fill: impl FnOnce(&mut [T]) -> bool,
    ) -> Result<(), GraphError> {
        let filled = match self.inputs.get_mut(index) {
            Some(SessionInputValue::Owned(value)) => value.try_extract_tensor_mut().map(|(_, place)| fill(place)),
            _ => Ok(false),
        };
        match filled {
            Ok(true) => Ok(()),
            Ok(false) => Err(GraphProblem::Input(index).in_graph(&self.name)),
            Err(error) => Err(run_error(&self.name, &error)),
        }
    }

    /// Runs the graph on its inputs, and passes on its first output.
    ///
    /// # Errors
    /// When onnxruntime reports an error.
    pub fn run<T>(&mut self, read: impl FnOnce(&[f32]) -> T) -> Result<T, GraphError> {
        let (inputs, is_trial) = (self.inputs.as_slice(), self.trial.is_some());
        let outputs = match &self.trial {
            // Options with memory for the outputs belong to one thread.
            Some(Trial(options)) => self.session.run_with_options(inputs, &**options),
            None => self.session.run_with_options(inputs, &self.options),
        };
        outputs
            .and_then(|outputs| match outputs.values().next() {
                Some(output) => output.try_extract_tensor().map(|(_, values)| {
                    self.is_finite &= !is_trial || values.iter().all(|value: &f32| value.is_finite());
                    read(values)
                }),
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

/// Executes one node after another, on the requested number of threads, none of which spins while idle: the rig's other
/// tasks need the processor too.
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

/// Computes on this provider, or not at all: onnxruntime would go back to the processor without a word.
fn provided(builder: SessionBuilder, provider: Provider) -> ort::Result<SessionBuilder> {
    let cuda = || ep::CUDA::default().build().error_on_failure();
    Ok(match provider {
        Provider::Cpu => builder,
        Provider::Cuda => builder.with_execution_providers([cuda()])?,
        Provider::TensorRt => {
            builder.with_execution_providers([ep::TensorRT::default().build().error_on_failure(), cuda()])?
        }
    })
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

/// The shape of a tensor's memory, and its number of elements.
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

/// Memory that a run writes before it is read.
fn make_output(graph: &str, shape: &TensorShape) -> Result<DynValue, GraphError> {
    let (dims, _) = dims(graph, shape)?;
    if shape.element != Element::F32 {
        return Err(kind(graph, shape));
    }
    let value = Tensor::<f32>::new(&Allocator::default(), dims).map_err(|error| run_error(graph, &error))?;
    Ok(value.into_dyn())
}

fn kind(graph: &str, shape: &TensorShape) -> GraphError {
    GraphProblem::Kind(shape.name.clone()).in_graph(graph)
}

fn run_error(graph: &str, error: &ort::Error) -> GraphError {
    GraphProblem::Run(error.to_string()).in_graph(graph)
}
