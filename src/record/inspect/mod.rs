//! What a recorded file holds: counts, rates, gaps, lateness and presence of every modality, and the
//! verdict on it, by the same code as the recorder's. Every command that has to know what an episode is worth
//! asks [`inspect`].
//!
//! Reads any file the recorder wrote, finished or not, from its beginning to where it ends.
//!
//! Invariant: GOOD is proven: see [`judge`]. What cannot be read or judged is never GOOD.
//! Invariant: no file makes this panic, and memory does not grow with what it holds.

mod channel;
mod collect;
mod doubts;
mod judge;
mod judgement;
mod list;
mod policy;
mod registered;
mod render;
mod state;
#[cfg(test)]
mod tests;
mod units;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::quality::{Quality, Spread};
use super::walk::{Walked, walk};
use crate::episode_format::{self, Failed, OpenError, ReadAt};
use crate::status::Verdict;
use crate::text;
use collect::Collected;

pub use super::walk::{FileEnd, LeftOut};
pub use judgement::Judgement;
pub use list::{Listed, episodes, list, render_list};
pub use policy::{HoldReport, PolicyReport};
pub use render::{Paint, render};

/// Why a file cannot be inspected.
#[derive(Debug, thiserror::Error)]
pub enum InspectError {
    /// It cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// It is a folder, a pipe or a device.
    #[error("{}: not a file; name an episode, a file that ends in .mcap or .mcap.partial", .0.display())]
    NotFile(PathBuf),
    /// It does not begin as an MCAP file does.
    #[error("{}: not an MCAP file", .0.display())]
    NotMcap(PathBuf),
}

/// What a file holds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Inspection {
    /// The file.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// Its size in bytes.
    pub bytes: u64,
    /// How it ends.
    pub end: FileEnd,
    /// What it is worth, by what it holds.
    #[serde(flatten)]
    pub verdict: Judgement,
    /// What the recorder said when it was finished.
    pub recorded_verdict: Option<Verdict>,
    /// Bytes of it that could not be understood.
    pub unread_bytes: u64,
    /// Chunks whose content is not what was written; nothing of them is counted below.
    pub damaged_chunks: u64,
    /// What else of the file is left out.
    #[serde(flatten)]
    pub left_out: LeftOut,
    /// Messages of a chunk that the end of the file cuts, taken without a check value because they were written since this
    /// machine was started.
    pub ordered_messages: u64,
    /// What a repair said of this file when it made it: the metadata `rapid/recovered`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub recovered: BTreeMap<String, String>,
    /// The program that wrote it, with its version.
    pub software: String,
    /// The commit it was built from; empty if that was not known.
    pub commit: String,
    /// The computer it ran on.
    pub host: String,
    /// Release of that computer's kernel.
    pub kernel: String,
    /// Name of the rig.
    pub rig: String,
    /// The task in the user's words.
    pub task: String,
    /// Tags of the user.
    pub tags: BTreeMap<String, String>,
    /// Modules that were mounted.
    pub modules: Vec<String>,
    /// Modalities that were present when it began; unknown in a file that does not say so.
    pub present_at_begin: Option<BTreeSet<String>>,
    /// Beginning, ns since 1970.
    pub begin_ns: u64,
    /// Length in seconds: what the recorder says, else up to the last message.
    pub seconds: f64,
    /// Messages on all topics.
    pub messages: u64,
    /// Samples lost on the way to the file, and those missing in it since; unknown in an unfinished file.
    pub dropped: Option<u64>,
    /// Samples that the devices lost themselves, by the recorder's count; unknown in an unfinished file. Where samples are missing
    /// that it wrote, it is not known which were whose: all are `dropped`.
    pub lost: Option<u64>,
    /// Samples the drivers called damaged; unknown in an unfinished file.
    pub damaged: Option<u64>,
    /// Ticks of the frame index.
    pub frames: u64,
    /// Between the earliest and the latest sample of a frame, ms.
    pub skew: Option<Spread>,
    /// The modalities, ascending by bit.
    pub modalities: Vec<ModalityReport>,
    /// By modality, the unit behind each epoch and what was agreed with it, as recorded.
    pub units: BTreeMap<String, Vec<serde_json::Value>>,
    /// What the policy did that was at the controls, if one was.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub policy: Option<PolicyReport>,
    /// The other topics.
    pub topics: Vec<TopicReport>,
    /// Values of the mask over time: the first one and every change.
    pub mask: Vec<MaskEdge>,
    /// Events, the first ten thousand.
    pub events: Vec<EventReport>,
}

/// One modality.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModalityReport {
    /// Name.
    pub name: String,
    /// Bit in the mask.
    pub bit: u8,
    /// What was recorded of it.
    #[serde(flatten)]
    pub topic: TopicReport,
    /// Share of the episode in which it was present, 0 to 1; unknown in a file without the mask.
    pub presence: Option<f64>,
    /// When it was present: begin and end in seconds from the beginning.
    pub present: Vec<(f64, f64)>,
    /// Frames in which a sample of it lies within the window.
    pub frames_valid: u64,
    /// Frames in which it is present without such a sample.
    pub frames_stale: u64,
    /// What was measured for the verdict; absent in a file that is not an episode of ours.
    pub quality: Option<Quality>,
}

/// One topic.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TopicReport {
    /// Topic.
    pub topic: String,
    /// Messages.
    pub messages: u64,
    /// Messages a second between the first and the last; of a modality, while it was present.
    pub hz: f64,
    /// Sequence numbers missing between messages.
    pub missing: u64,
    /// Longest time between two messages, seconds; of a modality, while it was present.
    pub longest_gap: f64,
    /// Times from capture to receipt; absent without messages, and of the frame index, which is
    /// written when it is due.
    pub lateness: Option<Lateness>,
}

/// Times from capture to receipt, ms.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Lateness {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Longest.
    pub max: f64,
}

/// A value of the mask and when it began.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MaskEdge {
    /// Seconds from the beginning.
    pub at: f64,
    /// The mask from then on, `0x05`.
    pub mask: String,
}

/// An event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventReport {
    /// Seconds from the beginning.
    pub at: f64,
    /// What kind of event.
    pub kind: String,
    /// The modality, or empty.
    pub device: String,
    /// For people.
    pub text: String,
}

/// Reads a file and says what it holds.
///
/// # Errors
/// When it cannot be read or is no MCAP file. An unfinished or damaged one is no error.
pub fn inspect(path: &Path) -> Result<Inspection, InspectError> {
    let io = |source| InspectError::Io { path: path.to_owned(), source };
    let (file, size) = episode_format::open(path).map_err(|error| match error {
        OpenError::Io { path, source } => InspectError::Io { path, source },
        OpenError::NotFile(path) => InspectError::NotFile(path),
    })?;
    inspect_from(file, size, path, episode_format::boot_id())
        .map_err(io)?
        .ok_or_else(|| InspectError::NotMcap(path.to_owned()))
}

/// What a file of these bytes, which may be any, holds; `None` if they are no MCAP file.
#[must_use]
pub fn inspect_bytes(bytes: &[u8]) -> Option<Inspection> {
    inspect_from(bytes, bytes.len() as u64, Path::new("bytes.mcap"), None).ok()?
}

/// `None`: no MCAP file.
fn inspect_from(file: impl ReadAt, size: u64, path: &Path, boot: Option<String>) -> io::Result<Option<Inspection>> {
    let failed = Failed::of(&file, size)?;
    let recorded = failed.as_ref().map_or(size, |failed| failed.at);
    let mut collected = Collected::default();
    let walked = walk(file, recorded, boot, &mut |opcode, record| collected.record(opcode, record))?;
    // The recorder's own mark shows that it was an episode, of which nothing is left.
    let walked = walked.or_else(|| failed.is_some().then(Walked::nothing));
    Ok(walked.map(|walked| collected.report(path, size, walked, failed)))
}
