//! What of a dataset's folder is of `rapid export`, and may be replaced or removed.
//!
//! Of a dataset these are the files that its `meta/info.json` and `meta/episodes` name. Beside them are, after a kill, the
//! files of the episode that was being appended: each is known by its name and by what `rapid` writes into it.
//!
//! Invariant: nothing else is replaced, removed or written through, whatever it is: a file, a folder or a link. If it is
//! where a file of the dataset would have to be, the dataset is not opened.

use std::fs::{DirEntry, File, FileType};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde_json::Value;

use super::error::SetError;
use super::features::{IMAGES, MASK};
use super::files::{CHUNK, CREATOR, TEMPORARY, VIDEOS};

/// The comment in a video.
pub(super) const COMMENT: &str = "made by rapid export";
/// How much of a video's beginning and end is searched for it: it is in the index, which is at one of the two.
const INDEX: u64 = 4 << 20;
/// Bytes of a file in JSON, at most.
const LARGEST_JSON: u64 = 64 << 20;

/// What a path is in a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Folder,
    /// Rows or a video of the episode of this number.
    Episode(u64),
    /// Its facts.
    Facts(u64),
    /// A file about all episodes.
    About,
    /// A file without its name.
    Temporary,
    /// Nothing.
    Stranger,
}

/// Checks the dataset in `set`, which has so many episodes, or is not one yet (`None`), and removes what a program left
/// that was killed.
///
/// # Errors
/// When something else is in a place of the dataset, or in the way of a new one. Then nothing is removed.
pub(super) fn check(set: &Path, episodes: Option<u64>) -> Result<(), SetError> {
    let mut leftovers = Vec::new();
    walk(set, &mut Vec::new(), episodes, &mut leftovers)?;
    for left in leftovers {
        std::fs::remove_file(&left).map_err(|source| SetError::Io { path: left, source })?;
    }
    Ok(())
}

fn walk(
    folder: &Path,
    parts: &mut Vec<String>,
    episodes: Option<u64>,
    leftovers: &mut Vec<PathBuf>,
) -> Result<(), SetError> {
    let of_system = |source| SetError::Io { path: folder.to_owned(), source };
    let mut entries: Vec<DirEntry> = std::fs::read_dir(folder).and_then(Iterator::collect).map_err(of_system)?;
    // The message is about the same file each time.
    entries.sort_by_key(DirEntry::file_name);
    for entry in entries {
        let path = entry.path();
        let kind = entry.file_type().map_err(of_system)?;
        let foreign = |problem: &str| Err(SetError::Foreign { path: path.clone(), problem: problem.to_owned() });
        parts.push(entry.file_name().to_string_lossy().into_owned());
        let names: Vec<&str> = parts.iter().map(String::as_str).collect();
        match (place(&names), episodes) {
            (Place::Stranger, Some(_)) => {}
            (Place::Stranger, None) => return foreign("not of a dataset"),
            // Named by the facts: even a link is only read.
            (Place::Episode(number) | Place::Facts(number), Some(count)) if number < count => {}
            (_, _) if kind.is_symlink() => return foreign("a symbolic link, where the dataset has its own files"),
            (Place::Folder, _) if kind.is_dir() => walk(&path, parts, episodes, leftovers)?,
            (_, _) if !kind.is_file() => return foreign(other_kind(kind)),
            (Place::Folder, _) => return foreign("a file, where a dataset has a folder"),
            (Place::About, Some(_)) => {}
            (Place::Temporary, _) => leftovers.push(path),
            // What was being appended has the next number.
            (Place::Episode(number), Some(count)) if is_ours(&path) => {
                leftovers.extend((number == count).then_some(path));
            }
            (Place::Episode(0) | Place::Facts(0) | Place::About, None) if is_ours(&path) => leftovers.push(path),
            (Place::Episode(_) | Place::Facts(_) | Place::About, None) => {
                return foreign("of a dataset without its meta/info.json, or of another program");
            }
            (Place::Episode(_), Some(_)) => {
                return foreign("where the dataset would have a further episode, and not of it");
            }
            (Place::Facts(_), Some(_)) => {
                return foreign("facts of an episode, and those of one before it are missing");
            }
        }
        parts.pop();
    }
    Ok(())
}

fn other_kind(kind: FileType) -> &'static str {
    if kind.is_dir() { "a folder, where a dataset has a file" } else { "neither a file nor a folder" }
}

fn place(parts: &[&str]) -> Place {
    let is_chunk = |name: &str| number(name, "chunk-", "").is_some();
    match parts {
        ["data" | "meta" | VIDEOS] | ["meta", "episodes"] => Place::Folder,
        ["data", chunk] | ["meta", "episodes", chunk] if is_chunk(chunk) => Place::Folder,
        [VIDEOS, key] if key.starts_with(IMAGES) => Place::Folder,
        [VIDEOS, key, chunk] if key.starts_with(IMAGES) && is_chunk(chunk) => Place::Folder,
        [VIDEOS, key, name] if key.starts_with(IMAGES) && is_temporary(name) => Place::Temporary,
        ["meta", "info.json" | "stats.json" | "tasks.parquet"] => Place::About,
        ["meta", name] if is_temporary(name) => Place::Temporary,
        ["data", chunk, name] => of_episode(Place::Episode, chunk, name, ".parquet"),
        ["meta", "episodes", chunk, name] => of_episode(Place::Facts, chunk, name, ".parquet"),
        [VIDEOS, key, chunk, name] if key.starts_with(IMAGES) => of_episode(Place::Episode, chunk, name, ".mp4"),
        _ => Place::Stranger,
    }
}

fn of_episode(place: fn(u64) -> Place, chunk: &str, name: &str, extension: &str) -> Place {
    match (number(chunk, "chunk-", ""), number(name, "file-", extension)) {
        (Some(chunk), Some(file)) => place(chunk.saturating_mul(CHUNK).saturating_add(file)),
        (Some(_), None) if is_temporary(name) => Place::Temporary,
        _ => Place::Stranger,
    }
}

/// The number in a name, which has three digits or more.
fn number(name: &str, before: &str, after: &str) -> Option<u64> {
    let digits = name.strip_prefix(before)?.strip_suffix(after)?;
    let is_number = digits.len() >= 3 && digits.bytes().all(|byte| byte.is_ascii_digit());
    digits.parse().ok().filter(|_| is_number)
}

/// Whether a file that is not complete is called so: `.file-000.parquet.tmp`, by its episode's hash `.0a1b.mp4.tmp`, and
/// with the number of a process `.info.json.123.tmp`.
fn is_temporary(name: &str) -> bool {
    let Some(name) = name.strip_prefix('.').and_then(|name| name.strip_suffix(TEMPORARY)) else { return false };
    let name = name.trim_end_matches(|letter: char| letter.is_ascii_digit() || letter == '.');
    let is_hash = |stem: &str| !stem.is_empty() && stem.bytes().all(|byte| byte.is_ascii_hexdigit());
    let is_numbered = |stem: &str| number(stem, "file-", "").is_some();
    match name.rsplit_once('.') {
        // The digit of `mp4` is trimmed as well.
        Some((stem, "mp")) => is_hash(stem) || is_numbered(stem),
        Some((stem, "parquet")) => is_numbered(stem) || stem == "tasks",
        Some((stem, "json")) => matches!(stem, "info" | "stats"),
        _ => false,
    }
}

/// Whether a file, whatever it is called, was written by `rapid export`.
pub(super) fn is_ours(path: &Path) -> bool {
    let has_mark = match path.extension().and_then(|extension| extension.to_str()) {
        Some("parquet") => of_parquet(path),
        Some("mp4") => of_video(path).ok(),
        Some("json") => of_json(path),
        _ => None,
    };
    has_mark == Some(true)
}

fn of_parquet(path: &Path) -> Option<bool> {
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(path).ok()?).ok()?;
    Some(reader.metadata().file_metadata().created_by()?.starts_with(CREATOR))
}

fn of_video(path: &Path) -> io::Result<bool> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    let mut part = Vec::new();
    (&file).take(INDEX).read_to_end(&mut part)?;
    file.seek(SeekFrom::Start(length.saturating_sub(INDEX)))?;
    (&file).take(INDEX).read_to_end(&mut part)?;
    Ok(part.windows(COMMENT.len()).any(|bytes| bytes == COMMENT.as_bytes()))
}

fn of_json(path: &Path) -> Option<bool> {
    let text = rapid_system::folder::read_text(path, LARGEST_JSON).ok()?;
    Some(serde_json::from_str::<Value>(&text).ok()?.get(MASK).is_some())
}
