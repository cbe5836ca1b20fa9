//! Many episodes at a glance: one line each.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_status::palette::Palette;
use serde::Serialize;

use super::render::clean;
use super::{FileEnd, Inspection, Judgement, ReadError, inspect};
use crate::partial::PARTIAL;

/// An episode of a list. As JSON, one object a line.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Listed {
    /// The file.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// The verdict.
    #[serde(flatten)]
    pub verdict: Judgement,
    /// Length in seconds.
    pub seconds: f64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Samples and other messages.
    pub messages: u64,
    /// The task in the user's words.
    pub task: String,
    /// Tags of the user.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub tags: BTreeMap<String, String>,
    /// Beginning, ns since 1970; 0 if unknown.
    pub begin_ns: u64,
    /// The modalities with at least one sample.
    pub recorded: Vec<String>,
    /// How the file ends.
    pub end: Option<FileEnd>,
    /// Why it could not be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

/// The episodes that are meant, each once: a file is itself, a folder those in it (`.mcap`, `.mcap.partial`), by
/// name.
///
/// # Errors
/// When a folder cannot be read.
pub fn episodes(paths: &[PathBuf]) -> Result<Vec<PathBuf>, ReadError> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let io = |source| ReadError::Io { path: path.clone(), source };
        let mut inside = Vec::new();
        for entry in std::fs::read_dir(path).map_err(io)? {
            let entry = entry.map_err(io)?.path();
            if is_episode(&entry) {
                inside.push(entry);
            }
        }
        inside.sort();
        files.extend(inside);
    }
    let mut seen = BTreeSet::new();
    // What does not exist is reported by whoever opens it.
    files.retain(|file| file.canonicalize().map_or(true, |place| seen.insert(place)));
    Ok(files)
}

fn is_episode(path: &Path) -> bool {
    let name = match path.extension() {
        Some(extension) if extension == PARTIAL => path.with_extension(""),
        _ => path.to_owned(),
    };
    name.extension().is_some_and(|extension| extension == "mcap")
}

/// One episode of a list.
pub fn list(file: &Path) -> Listed {
    match inspect(file) {
        Ok(Inspection { file, bytes, end, verdict, task, tags, begin_ns, seconds, messages, modalities, .. }) => {
            let recorded = modalities.into_iter().filter(|modality| modality.topic.messages > 0);
            let recorded = recorded.map(|modality| modality.name).collect();
            Listed {
                file,
                verdict,
                seconds,
                bytes,
                messages,
                task,
                tags,
                begin_ns,
                recorded,
                end: Some(end),
                error: None,
            }
        }
        Err(error) => {
            // The file is named beside it.
            let text = error.to_string();
            let text = text.strip_prefix(&format!("{}: ", file.display())).unwrap_or(&text).to_owned();
            Listed {
                file: file.to_owned(),
                verdict: Judgement::Unreadable(text.clone()),
                seconds: 0.0,
                bytes: 0,
                messages: 0,
                task: String::new(),
                tags: BTreeMap::new(),
                begin_ns: 0,
                recorded: Vec::new(),
                end: None,
                error: Some(text),
            }
        }
    }
}

/// The episode, called `name`, in a line without its end; `columns` are those of the longest name.
pub fn render_list(listed: &Listed, name: &str, columns: usize, palette: Palette) -> String {
    let name = text::left(&clean(name), columns, "...");
    let mut line = format!("{}  {name}", listed.verdict.column(palette));
    if let Judgement::Episode(verdict) = &listed.verdict {
        let _ =
            write!(line, "  {:>8.1} s  {:>8}  {}", listed.seconds, text::size(listed.bytes), clean(&verdict.remarks()));
    }
    let reasons = listed.verdict.reasons();
    if let Some(first) = reasons.first() {
        let _ = write!(line, "  {}", clean(first));
    }
    if reasons.len() > 1 {
        let _ = write!(line, " (and {} more)", reasons.len() - 1);
    }
    line.truncate(line.trim_end().len());
    line
}
