//! The policy that the program carries: `models/tactile-id` of the repository, as it was when the program was built.
//!
//! Invariant: its hash is that of the folder it was made from, so that a recording names the same policy either way.

use std::path::PathBuf;

use super::files::Graph;
use super::read::Problems;
use super::spec::{Bundle, BundleErrors};

const POLICY: &str = include_str!("../../../models/tactile-id/policy.json");
static ENCODER: &[u8] = include_bytes!("../../../models/tactile-id/encoder.onnx");
static DENOISER: &[u8] = include_bytes!("../../../models/tactile-id/denoiser.onnx");
/// What stands for its folder in messages and recordings.
const LABEL: &str = "inside rapid";

impl Bundle {
    /// The policy inside the program.
    ///
    /// # Errors
    /// When the program was built with a policy that is none.
    pub fn inside() -> Result<Self, BundleErrors> {
        let label = PathBuf::from(LABEL);
        let mut bundle = Self::parse(POLICY, LABEL)?;
        (bundle.folder, bundle.inside) = (label, true);
        let mut problems = Problems::new(LABEL);
        for graph in [Graph::Encoder, Graph::Denoiser] {
            bundle.verified(graph, &mut problems);
        }
        problems.check()?;
        Ok(bundle)
    }
}

/// The bytes of a graph.
pub(super) const fn graph(graph: Graph) -> &'static [u8] {
    match graph {
        Graph::Encoder => ENCODER,
        Graph::Denoiser => DENOISER,
    }
}
