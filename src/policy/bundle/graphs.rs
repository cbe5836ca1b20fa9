//! What a graph says of its own inputs and outputs.

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
    /// Its dimensions; `None` is one that the graph leaves open.
    pub dims: Vec<Option<u64>>,
}

/// The type of a tensor's elements.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Element {
    /// 32-bit floats.
    F32,
    /// 64-bit signed integers.
    I64,
    /// Any other, by a name for people: `f16`. No graph of a bundle has such inputs or outputs.
    Other(String),
}
