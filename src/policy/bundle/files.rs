//! The files of a bundle: `policy.json` and the graphs, whose bytes are what it says they are.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use sha2::{Digest, Sha256};

use super::parse::parse;
use super::read::Problems;
use super::spec::{Bundle, BundleErrors, GraphFile};

/// The file that makes a folder a bundle.
pub const POLICY_FILE: &str = "policy.json";
/// It is a few kilobytes, provenance included.
const MAX_POLICY_BYTES: u64 = 4 << 20;
/// Read at once for a hash.
const CHUNK: usize = 64 << 10;

/// Which of the two graphs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Graph {
    /// Observations to a condition.
    Encoder,
    /// A condition and noise to a prediction.
    Denoiser,
}

impl Graph {
    /// The key under `graphs`.
    #[must_use]
    pub const fn key(self) -> &'static str {
        match self {
            Self::Encoder => "encoder",
            Self::Denoiser => "denoiser",
        }
    }
}

impl Bundle {
    /// Reads the bundle in `folder` and checks that its graphs are there, byte for byte.
    ///
    /// # Errors
    /// Everything that is wrong with `policy.json`, or else with the graphs' files.
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
        let mut problems = Problems::new(&label);
        for graph in [Graph::Encoder, Graph::Denoiser] {
            let file = bundle.graph(graph);
            let found = open(&folder.join(&file.file)).and_then(|mut file| hash(&mut file));
            verify(graph, file, found, &mut problems);
        }
        problems.check()?;
        Ok(bundle)
    }

    /// Reads the text of a `policy.json`; `file` is how it is named in messages. The bundle's folder
    /// is empty, and no graph is looked at.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn parse(text: &str, file: &str) -> Result<Self, BundleErrors> {
        let mut bundle = parse(text, file)?;
        let mut hasher = Sha256::new();
        hasher.update(text.as_bytes());
        hasher.update(bundle.encoder.sha256.as_bytes());
        hasher.update(bundle.denoiser.sha256.as_bytes());
        bundle.hash = hexadecimal(&hasher.finalize());
        Ok(bundle)
    }

    /// The bytes of a graph: those that were hashed, whatever has become of the file since the
    /// bundle was loaded.
    ///
    /// # Errors
    /// When it cannot be read or is no longer the one that `policy.json` means.
    pub fn read_graph(&self, graph: Graph) -> Result<Vec<u8>, BundleErrors> {
        let file = self.graph(graph);
        let mut bytes = Vec::new();
        let read = open(&self.folder.join(&file.file)).and_then(|mut open| open.read_to_end(&mut bytes));
        let mut problems = Problems::new(&self.label());
        verify(graph, file, read.and_then(|_| hash(&mut bytes.as_slice())), &mut problems);
        problems.check()?;
        Ok(bytes)
    }

    /// Where a graph lies and what its bytes are.
    #[must_use]
    pub const fn graph(&self, graph: Graph) -> &GraphFile {
        match graph {
            Graph::Encoder => &self.encoder,
            Graph::Denoiser => &self.denoiser,
        }
    }

    /// How the file is named in messages.
    pub(super) fn label(&self) -> String {
        self.folder.join(POLICY_FILE).display().to_string()
    }
}

fn read_policy(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    open(path)?.take(MAX_POLICY_BYTES + 1).read_to_string(&mut text)?;
    if text.len() as u64 > MAX_POLICY_BYTES {
        return Err(io::Error::other(format!("it is larger than {} MiB", MAX_POLICY_BYTES >> 20)));
    }
    Ok(text)
}

/// An ordinary file, or a link to one: model hubs keep bundles as links. Nothing else: a pipe would
/// have us wait.
fn open(path: &Path) -> io::Result<File> {
    if !std::fs::metadata(path)?.is_file() {
        return Err(io::Error::other("it is not a file"));
    }
    File::open(path)
}

fn hash(from: &mut impl Read) -> io::Result<String> {
    let mut hasher = Sha256::new();
    let mut chunk = vec![0; CHUNK];
    loop {
        match from.read(&mut chunk) {
            Ok(0) => return Ok(hexadecimal(&hasher.finalize())),
            Ok(length) => hasher.update(&chunk[..length]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

fn verify(graph: Graph, file: &GraphFile, found: io::Result<String>, problems: &mut Problems) {
    let entry = format!("graphs.{}", graph.key());
    match found {
        Ok(found) if found == file.sha256 => {}
        Ok(found) => {
            let message = format!("{} has the SHA-256 {found}, policy.json says {}", file.file, file.sha256);
            problems.report(
                &entry,
                message,
                "copy the whole bundle again: this graph is not the one that belongs to it",
            );
        }
        Err(error) => {
            let message = format!("{} cannot be read: {error}", file.file);
            problems.report(&entry, message, "copy the whole bundle again: the graph belongs beside policy.json");
        }
    }
}

pub(super) fn hexadecimal(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a String does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}
