//! Tensors of a graph stored in other files: refused in a bundle, because its SHA-256 would not cover them.
//!
//! A tensor can occur in many places of a model: as an initializer, sparse or not, of the graph or of a subgraph, in an
//! attribute of a node, in a function, in training data. All of them are checked. Field numbers are those of
//! [`onnx.proto`](https://github.com/onnx/onnx/blob/v1.20.0/onnx/onnx.proto).
//!
//! Invariant: a file that cannot be parsed to its end is refused: another parser might find more in it.
//! Invariant: the work grows with the number of fields; no nesting makes it recurse.

use rapid_episode::wire::{Proto, protobuf, whole_protobuf};

/// Largest field number; a parser with 32-bit keys would misread a larger one.
const LAST_FIELD: u64 = (1 << 29) - 1;
/// Offset and value of the mark in onnxruntime's own format, which is not protobuf.
const ORT_MARK: (usize, &[u8]) = (4, b"ORTM");

/// A message type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Model,
    Training,
    Function,
    Graph,
    Node,
    Attribute,
    Sparse,
    Tensor,
}

/// Nesting: a message, a field number, and the message in that field.
const PARTS: &[(Kind, u64, Kind)] = &[
    (Kind::Model, 7, Kind::Graph),
    (Kind::Model, 20, Kind::Training),
    (Kind::Model, 25, Kind::Function),
    (Kind::Training, 1, Kind::Graph),
    (Kind::Training, 2, Kind::Graph),
    (Kind::Function, 7, Kind::Node),
    (Kind::Function, 11, Kind::Attribute),
    (Kind::Graph, 1, Kind::Node),
    (Kind::Graph, 5, Kind::Tensor),
    (Kind::Graph, 15, Kind::Sparse),
    (Kind::Node, 5, Kind::Attribute),
    (Kind::Attribute, 5, Kind::Tensor),
    (Kind::Attribute, 6, Kind::Graph),
    (Kind::Attribute, 10, Kind::Tensor),
    (Kind::Attribute, 11, Kind::Graph),
    (Kind::Attribute, 22, Kind::Sparse),
    (Kind::Attribute, 23, Kind::Sparse),
    (Kind::Sparse, 1, Kind::Tensor),
    (Kind::Sparse, 2, Kind::Tensor),
];

/// Fields of `TensorProto`.
const NAME: u64 = 8;
const EXTERNAL_DATA: u64 = 13;
const DATA_LOCATION: u64 = 14;
/// The first output of a `NodeProto`, which names the tensor of a `Constant` node.
const OUTPUT: u64 = 2;

/// Why a graph is refused.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum GraphError {
    /// It is not an ONNX model from start to end.
    NoModel,
    /// The values of a tensor are in another file.
    External {
        /// The name of the tensor, or of the node that contains it.
        tensor: String,
        /// The file, as the graph names it.
        file: String,
    },
}

/// Checks that the model contains all of its tensors' values.
pub(super) fn check(model: &[u8]) -> Result<(), GraphError> {
    let (at, mark) = ORT_MARK;
    if model.get(at..).is_some_and(|rest| rest.starts_with(mark)) {
        return Err(GraphError::NoModel);
    }
    let mut left: Vec<(Kind, &[u8], &[u8])> = vec![(Kind::Model, model, b"")];
    while let Some((kind, message, node)) = left.pop() {
        let node = if kind == Kind::Node { last(message, OUTPUT) } else { node };
        for field in whole_protobuf(message) {
            let Some((number @ 1..=LAST_FIELD, value)) = field else { return Err(GraphError::NoModel) };
            let inside = PARTS.iter().find(|(whole, part, _)| (*whole, *part) == (kind, number));
            match (inside, value) {
                (Some((_, _, part)), Proto::Bytes(bytes)) => left.push((*part, bytes, node)),
                (None, value) if kind == Kind::Tensor && is_external(number, value) => {
                    return Err(external(message, node));
                }
                _ => {}
            }
        }
    }
    Ok(())
}

/// Either the flag or a file name is sufficient.
fn is_external(number: u64, value: Proto<'_>) -> bool {
    number == EXTERNAL_DATA || (number == DATA_LOCATION && value.number() != 0)
}

fn external(tensor: &[u8], node: &[u8]) -> GraphError {
    let name = last(tensor, NAME);
    let name = if name.is_empty() { node } else { name };
    // `StringStringEntryProto`: key 1, value 2.
    let entries = protobuf(tensor).filter(|(number, _)| *number == EXTERNAL_DATA).map(|(_, entry)| entry.bytes());
    let location = entries.filter(|entry| last(entry, 1) == b"location").last().map(|entry| last(entry, 2));
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    GraphError::External { tensor: text(name), file: text(location.unwrap_or_default()) }
}

/// The bytes of the last field of this number.
fn last(message: &[u8], number: u64) -> &[u8] {
    protobuf(message).filter(|(found, _)| *found == number).last().map(|(_, value)| value.bytes()).unwrap_or_default()
}
