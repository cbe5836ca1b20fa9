//! The report on a recorded file: counts, rates, gaps, lateness and presence of every modality, and the verdict on it,
//! by the recorder's code. Every command that needs the verdict on an episode calls [`inspect`].
//!
//! Reads any file the recorder wrote, finished or not, from its beginning to where it ends.
//!
//! Invariant: GOOD is proven: see `judge`. What cannot be read or judged is never GOOD.
//! Invariant: no file makes this panic, and memory does not grow with what it holds.

mod collect;
mod judge;
mod list;
mod policy;
mod render;
mod state;
#[cfg(test)]
mod tests;
mod units;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_status::palette::Palette;
use rapid_status::{Grade, Sensors, Verdict};
use serde::{Serialize, Serializer};

use super::quality::{Quality, Spread};
use crate::reader::Reader;
use crate::record_iter::Integrity;
use crate::{Failed, ReadAt};
use collect::Collected;
pub(crate) use judge::Numbers;

pub use crate::ReadError;
pub use crate::record_iter::{FileEnd, LeftOut};
pub use list::{Listed, episodes, list, render_list};
pub use policy::{HoldReport, PolicyReport};
pub use render::render;

/// Reason of a file that has no verdict.
const NOT_OURS: &str = "not an episode of rapid";

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
    /// The verdict, by its content.
    #[serde(flatten)]
    pub verdict: Judgement,
    /// The recorder's verdict when it finished the file.
    pub recorded_verdict: Option<Verdict>,
    /// Bytes of it that could not be understood.
    pub unread_bytes: u64,
    /// Chunks with a wrong check value; nothing of them is counted below.
    pub damaged_chunks: u64,
    /// Other parts of the file that are left out.
    #[serde(flatten)]
    pub left_out: LeftOut,
    /// Messages of a chunk that the end of the file cuts, taken without a check value because they were written since this
    /// machine was started.
    pub ordered_messages: u64,
    /// The metadata `rapid/recovered` that a repair wrote into this file.
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
    /// Modalities that were present when it began; `None` in a file without this information.
    pub present_at_begin: Option<BTreeSet<String>>,
    /// Beginning, ns since 1970.
    pub begin_ns: u64,
    /// Length in seconds: by the recorder, else up to the last message.
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
    /// What the policy in control did, if there was one.
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

/// The judgement of a file. As JSON `verdict`, which is `null` without one, `reasons` and `sensors`.
#[derive(Debug, Clone, PartialEq)]
pub enum Judgement {
    /// It is an episode.
    Episode(Verdict),
    /// Another program wrote it, or nothing in it is an episode's.
    NotOurs,
    /// It cannot be read, or is no MCAP file; the text is the reason.
    Unreadable(String),
}

impl Judgement {
    /// The verdict, if there is one.
    pub fn verdict(&self) -> Option<&Verdict> {
        match self {
            Self::Episode(verdict) => Some(verdict),
            Self::NotOurs | Self::Unreadable(_) => None,
        }
    }

    /// Its word, if there is one.
    pub fn grade(&self) -> Option<Grade> {
        self.verdict().map(|verdict| verdict.grade)
    }

    /// Its word for a column of a table, `-` for a file of another program, `?` for one that cannot be read.
    pub fn column(&self, palette: Palette) -> String {
        let (word, shade) = match self {
            Self::Episode(verdict) => (verdict.grade.word(), verdict.grade),
            Self::NotOurs => ("-", Grade::Suspect),
            Self::Unreadable(_) => ("?", Grade::Bad),
        };
        palette.grade(shade, &format!("{word:7}"))
    }

    /// Why it is not GOOD, or has no verdict.
    pub fn reasons(&self) -> Vec<&str> {
        match self {
            Self::Episode(verdict) => verdict.reasons.iter().map(String::as_str).collect(),
            Self::NotOurs => vec![NOT_OURS],
            Self::Unreadable(why) => vec![why],
        }
    }
}

impl Serialize for Judgement {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        #[derive(Serialize)]
        struct Json<'a> {
            verdict: Option<Grade>,
            reasons: Vec<&'a str>,
            sensors: Option<&'a Sensors>,
            #[serde(skip_serializing_if = "<[String]>::is_empty")]
            replay_of: &'a [String],
        }
        let sensors = self.verdict().and_then(|verdict| verdict.sensors.as_ref());
        let replay_of = self.verdict().map_or(&[][..], |verdict| &verdict.replay_of);
        Json { verdict: self.grade(), reasons: self.reasons(), sensors, replay_of }.serialize(serializer)
    }
}

/// Reads a file and reports what it holds.
///
/// # Errors
/// When it cannot be read or is not an MCAP file. An unfinished or damaged one is not an error.
pub fn inspect(path: &Path) -> Result<Inspection, ReadError> {
    let (file, size) = crate::open(path)?;
    inspect_from(file, size, path, crate::boot_id())
}

/// What a file of these bytes, which may be any, holds; `None` if they are no MCAP file.
pub fn inspect_bytes(bytes: &[u8]) -> Option<Inspection> {
    inspect_from(bytes, bytes.len() as u64, Path::new("bytes.mcap"), None).ok()
}

fn inspect_from(file: impl ReadAt, size: u64, path: &Path, boot: Option<String>) -> Result<Inspection, ReadError> {
    let failed = Failed::read(&file, size).map_err(|source| ReadError::Io { path: path.to_owned(), source })?;
    let recorded = failed.as_ref().map_or(size, |failed| failed.at);
    let mut collected = Collected::default();
    let integrity = match Reader::new(file, recorded, path, boot) {
        Ok(mut reader) => {
            while reader.advance()? {
                collected.add(reader.item());
            }
            reader.integrity()
        }
        // The recorder's own mark shows that it was an episode, of which nothing is left.
        Err(ReadError::NotMcap(_)) if failed.is_some() => Integrity::default(),
        Err(error) => return Err(error),
    };
    Ok(collected.report(path, size, integrity, failed))
}
