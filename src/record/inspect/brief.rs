//! What an episode says of itself, without reading its data: of a finished file the metadata records,
//! found through the index at its end.
//!
//! Format: <https://mcap.dev/spec>.
//!
//! Invariant: no file makes this panic, or read more than [`LARGEST`] at once.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use super::super::configuration::KEY;
use super::judge::recorded_verdict;
use super::{InspectError, inspect};
use crate::episode_format::walk::{MAGIC, op};
use crate::episode_format::wire::Fields;
use crate::episode_format::{ABOUT, OpenError, SUMMARY, open};
use crate::status::Grade;

/// A summary or a metadata record larger than this is not one of ours.
const LARGEST: u64 = 16 << 20;
/// `MetadataIndex`.
const METADATA_INDEX: u8 = 0x0d;
/// The footer's record and the magic number behind it, bytes.
const TAIL: u64 = 9 + 20 + 8;

/// What an episode says of itself.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Brief {
    /// The task in the user's words.
    pub task: String,
    /// Tags of the user and of the modules.
    pub tags: BTreeMap<String, String>,
    /// Modules that were mounted.
    pub modules: Vec<String>,
    /// Modalities that were present when it began; unknown in a file that is not an episode of ours.
    pub present: Option<BTreeSet<String>>,
    /// What it is worth.
    pub grade: Grade,
}

/// Reads it from the file at `path`: of one that was not finished, all of it.
///
/// # Errors
/// When it cannot be read or is no MCAP file.
pub fn brief(path: &Path) -> Result<Brief, InspectError> {
    let (mut file, size) = open(path).map_err(|error| match error {
        OpenError::Io { path, source } => InspectError::Io { path, source },
        OpenError::NotFile(path) => InspectError::NotFile(path),
    })?;
    if let Some((about, summary)) = records(&mut file, size)
        && let Some(verdict) = recorded_verdict(&summary)
    {
        return Ok(Brief { grade: verdict.grade, ..of(&about) });
    }
    let whole = inspect(path)?;
    let first = whole.mask.first().and_then(|edge| u64::from_str_radix(edge.mask.strip_prefix("0x")?, 16).ok());
    let is_set = |bit: u8| first.is_some_and(|mask| mask.checked_shr(bit.into()).is_some_and(|rest| rest & 1 == 1));
    let present = whole.modalities.iter().filter(|modality| is_set(modality.bit)).map(|modality| modality.name.clone());
    Ok(Brief {
        task: whole.task,
        tags: whole.tags,
        modules: Vec::new(),
        present: first.map(|_| present.collect()),
        grade: whole.verdict.grade,
    })
}

fn of(about: &BTreeMap<String, String>) -> Brief {
    #[derive(Default, serde::Deserialize)]
    struct Configuration {
        modules: Vec<String>,
        present: BTreeSet<String>,
    }
    let json = |key: &str| about.get(key).map(String::as_str).unwrap_or_default();
    let configuration = serde_json::from_str::<Configuration>(json(KEY)).ok();
    // Written before there were configurations: what was attached.
    let attached =
        || Some(serde_json::from_str::<BTreeMap<String, Option<String>>>(json("serials")).ok()?.into_keys().collect());
    Brief {
        task: json("task").to_owned(),
        tags: serde_json::from_str(json("tags")).unwrap_or_default(),
        present: configuration.as_ref().map(|known| known.present.clone()).or_else(attached),
        modules: configuration.map(|known| known.modules).unwrap_or_default(),
        grade: Grade::default(),
    }
}

type Pairs = BTreeMap<String, String>;

/// The records at the beginning and at the end of an episode, if the file is finished and has an index.
fn records(file: &mut File, size: u64) -> Option<(Pairs, Pairs)> {
    let mut tail = Fields(&[]);
    let bytes = at(file, size.checked_sub(TAIL)?, TAIL).ok()?;
    tail.0 = &bytes;
    let (opcode, length, summary) = (tail.u8()?, tail.u64()?, tail.u64()?);
    if (opcode, length) != (op::FOOTER, 20) || !bytes.ends_with(&MAGIC) || summary == 0 {
        return None;
    }
    let bytes = at(file, summary, size.checked_sub(TAIL)?.checked_sub(summary)?).ok()?;
    let mut index = Fields(&bytes);
    let (mut about, mut summary) = (None, None);
    while let Some(opcode) = index.u8() {
        let length = index.u64()?;
        let mut record = Fields(index.bytes(length)?);
        if opcode != METADATA_INDEX {
            continue;
        }
        let (offset, length, name) = (record.u64()?, record.u64()?, record.string()?);
        let found = match name {
            ABOUT => &mut about,
            SUMMARY => &mut summary,
            _ => continue,
        };
        let bytes = at(file, offset, length).ok()?;
        let mut record = Fields(&bytes);
        let (opcode, _, own) = (record.u8()?, record.u64()?, record.string()?);
        if opcode != op::METADATA || own != name {
            return None;
        }
        *found = Some(record.map()?);
    }
    about.zip(summary)
}

fn at(file: &mut File, offset: u64, length: u64) -> io::Result<Vec<u8>> {
    if length > LARGEST {
        return Err(io::ErrorKind::InvalidData.into());
    }
    file.seek(SeekFrom::Start(offset))?;
    let mut bytes = Vec::new();
    file.take(length).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == length { Ok(bytes) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
}
