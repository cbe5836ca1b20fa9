//! The files of a bundle: `policy.json` and the graphs, whose SHA-256 it contains. The program includes one bundle,
//! `models/tactile-id` of the repository at build time.
//!
//! Invariant: the hash of the included bundle equals that of its source folder, so that a recording names the same
//! policy either way.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_system::limited::{read_bytes, read_text};
use sha2::{Digest, Sha256};

use super::external::{self, GraphError};
use super::read::Problems;
use super::spec::{Bundle, BundleErrors, GraphFile};
use super::validate::parse;

/// The file that makes a folder a bundle.
pub const POLICY_FILE: &str = "policy.json";
/// It is a few kilobytes, provenance included.
const MAX_POLICY_BYTES: u64 = 4 << 20;
/// ONNX has no larger file: a message of protobuf ends there.
const MAX_GRAPH_BYTES: u64 = (2 << 30) - 1;

const POLICY: &str = include_str!("../../../models/tactile-id/policy.json");
static ENCODER: &[u8] = include_bytes!("../../../models/tactile-id/encoder.onnx");
static DENOISER: &[u8] = include_bytes!("../../../models/tactile-id/denoiser.onnx");
/// Its folder name, in messages and recordings.
const LABEL: &str = "inside rapid";

/// One of the two graphs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Graph {
    /// Observations to a condition.
    Encoder,
    /// A condition and noise to a prediction.
    Denoiser,
}

impl Graph {
    /// The key under `graphs`.
    pub const fn key(self) -> &'static str {
        match self {
            Self::Encoder => "encoder",
            Self::Denoiser => "denoiser",
        }
    }
}

impl Bundle {
    /// The bundle in `folder`, or without a folder the one [inside the program](Self::inside).
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn open(folder: Option<&Path>) -> Result<Self, BundleErrors> {
        folder.map_or_else(Self::inside, Self::load)
    }

    /// Reads the bundle in `folder` and checks that its graphs match byte for byte and contain all their tensors.
    ///
    /// # Errors
    /// All errors in `policy.json`, or otherwise those in the graphs' files.
    pub fn load(folder: &Path) -> Result<Self, BundleErrors> {
        let path = folder.join(POLICY_FILE);
        let label = path.display().to_string();
        let mut problems = Problems::new(&label);
        let text = match read_policy(&path) {
            Ok(text) => text,
            Err(error) => {
                let fix = format!("name the folder of a policy bundle: one with {POLICY_FILE} in it");
                problems.report("", error.to_string(), fix);
                String::new()
            }
        };
        problems.check()?;
        let mut bundle = Self::parse(&text, &label)?;
        folder.clone_into(&mut bundle.folder);
        bundle.with_verified_graphs(&label)
    }

    /// The policy inside the program.
    ///
    /// # Errors
    /// When the included policy is invalid.
    pub fn inside() -> Result<Self, BundleErrors> {
        let mut bundle = Self::parse(POLICY, LABEL)?;
        (bundle.folder, bundle.inside) = (PathBuf::from(LABEL), true);
        bundle.with_verified_graphs(LABEL)
    }

    fn with_verified_graphs(self, label: &str) -> Result<Self, BundleErrors> {
        let mut problems = Problems::new(label);
        for graph in [Graph::Encoder, Graph::Denoiser] {
            self.verified(graph, &mut problems);
        }
        problems.check()?;
        Ok(self)
    }

    /// Parses the text of a `policy.json`; messages name it `file`. The bundle's folder is empty, and no graph is read.
    ///
    /// # Errors
    /// All errors in it.
    pub fn parse(text: &str, file: &str) -> Result<Self, BundleErrors> {
        let mut bundle = parse(text, file)?;
        let mut hasher = Sha256::new();
        hasher.update(text.as_bytes());
        hasher.update(bundle.encoder.sha256.as_bytes());
        hasher.update(bundle.denoiser.sha256.as_bytes());
        bundle.hash = text::hexadecimal(&hasher.finalize());
        Ok(bundle)
    }

    /// The bytes of a graph: those that were hashed, even if the file has changed since the bundle was loaded.
    ///
    /// # Errors
    /// When it cannot be read or no longer matches `policy.json`.
    pub fn read_graph(&self, graph: Graph) -> Result<Vec<u8>, BundleErrors> {
        let mut problems = Problems::new(&self.label());
        let bytes = self.verified(graph, &mut problems);
        problems.check()?;
        Ok(bytes)
    }

    /// The bytes of a graph if their hash matches and all tensors are inside; otherwise empty.
    fn verified(&self, graph: Graph, problems: &mut Problems) -> Vec<u8> {
        let file = self.graph(graph);
        let mut bytes = Vec::new();
        let read = if self.inside {
            bytes.extend_from_slice(if graph == Graph::Encoder { ENCODER } else { DENOISER });
            Ok(bytes.len())
        } else {
            open(&self.folder.join(&file.file)).and_then(|open| {
                bytes = read_bytes(&open, MAX_GRAPH_BYTES)?;
                Ok(bytes.len())
            })
        };
        let wrong = match read {
            Err(error) => Some((
                format!("{} cannot be read: {error}", file.file),
                "copy the whole bundle again: the graph belongs beside policy.json".to_owned(),
            )),
            Ok(_) => wrong(file, &bytes),
        };
        let Some((message, fix)) = wrong else { return bytes };
        problems.report(&format!("graphs.{}", graph.key()), message, fix);
        Vec::new()
    }

    /// File name and hash of a graph.
    pub const fn graph(&self, graph: Graph) -> &GraphFile {
        match graph {
            Graph::Encoder => &self.encoder,
            Graph::Denoiser => &self.denoiser,
        }
    }

    /// The file's name in messages.
    pub(super) fn label(&self) -> String {
        self.folder.join(POLICY_FILE).display().to_string()
    }
}

fn read_policy(path: &Path) -> io::Result<String> {
    read_text(&open(path)?, MAX_POLICY_BYTES)
}

/// A regular file, or a link to one: model hubs store bundles as links. Nothing else: opening a pipe would block.
fn open(path: &Path) -> io::Result<File> {
    if !std::fs::metadata(path)?.is_file() {
        return Err(io::Error::other("it is not a file"));
    }
    File::open(path)
}

/// The error in the bytes of a graph, and its fix.
fn wrong(file: &GraphFile, bytes: &[u8]) -> Option<(String, String)> {
    let (name, found) = (&file.file, text::hexadecimal(&Sha256::digest(bytes)));
    if found != file.sha256 {
        let message = format!("{name} has the SHA-256 {found}, policy.json has {}", file.sha256);
        let fix = "copy the whole bundle again: this graph is not the one that belongs to it";
        return Some((message, fix.to_owned()));
    }
    let again = format!("then write the new SHA-256 of {name} here");
    match external::check(bytes).err()? {
        GraphError::NoModel => Some((
            format!("{name} is not an ONNX model"),
            format!("export it again, as ONNX and not in onnxruntime's own format; {again}"),
        )),
        GraphError::External { tensor, file } => Some((
            format!(
                "{name}: the numbers of tensor \"{tensor}\" lie in another file, \"{file}\", which no SHA-256 covers"
            ),
            format!("store them in the graph: onnx.save(onnx.load(\"{name}\"), \"{name}\") in Python; {again}"),
        )),
    }
}
