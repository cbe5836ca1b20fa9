//! The state of a file: whether it is whole, what a repair recorded about it, what of it is counted, and what of it is in
//! doubt.

use std::collections::BTreeMap;

use rapid_core::provenance::ReplaySource;
use rapid_core::sync::Grid;
use rapid_core::text;
use rapid_core::time::Stamp;
use rapid_status::{Grade, Verdict};
use serde_json::Value;

use super::super::metadata::CUT_SHORT;
use super::super::sources::{Epochs, REPLAY_OF};
use super::super::verdict::{FileState, Missing};
use super::ModalityReport;
use crate::episode_id::EpisodeId;
use crate::record::Quality;
use crate::record_iter::{FileEnd, Integrity, LeftOut};
use crate::{ABOUT, SUMMARY};

/// Ticks are at whole nanoseconds of another clock.
const ROUNDING: u64 = 1_000;

const UNFINISHED: &str = "the recorder has not finished it";
const UNPROVEN: &str = "check values are missing in it, so that damage would not show";

/// How a file ended.
#[derive(Debug)]
pub(super) struct Ending<'a> {
    /// What was found in it.
    pub(super) file: Integrity,
    /// Length of the episode, seconds.
    pub(super) seconds: f64,
    /// What it states about itself at its beginning.
    pub(super) about: &'a BTreeMap<String, String>,
    /// The recorder's summary; empty without one.
    pub(super) summary: &'a BTreeMap<String, String>,
    /// It was repaired from one that was not whole: the reason.
    pub(super) repaired: Option<&'a str>,
    /// Why its recorder called it BAD after it had written its summary, or without one.
    pub(super) failed: Option<&'a str>,
    /// What is left out if parts of it are damaged.
    pub(super) damage: &'a str,
    /// The epochs of the modalities.
    pub(super) units: &'a Epochs,
    pub(super) counted: Counted,
}

pub(super) fn file_state<'a>(ending: &Ending<'a>) -> FileState<'a> {
    let Ending { file: integrity, summary, repaired, failed, damage, .. } = ending;
    if let Some(why) = failed {
        return FileState::Failed(why);
    }
    let cut_short = summary.get(CUT_SHORT);
    match (integrity.end, *repaired) {
        (FileEnd::Finished, Some(report)) => FileState::NotWhole(report),
        // A check value that is not right counts as much as a chunk that cannot be read.
        (FileEnd::Finished, None) if integrity.damaged_chunks == 0 && integrity.sound => match cut_short {
            Some(why) => FileState::NotWhole(why),
            // Another program wrote the footer: the recorder writes a summary with its own.
            None if summary.is_empty() => FileState::NotWhole(UNFINISHED),
            None if !integrity.proven => FileState::NotWhole(UNPROVEN),
            None => FileState::Whole,
        },
        _ => FileState::NotWhole(damage),
    }
}

/// What a file that is not whole lacks: how it ends, and what is left out.
pub(super) fn damage(integrity: &Integrity) -> String {
    let end = match integrity.end {
        FileEnd::Finished => "parts of it are damaged",
        FileEnd::Unfinished => UNFINISHED,
        FileEnd::Torn => "its last record is cut",
        FileEnd::Damaged => "it cannot be read from some place on",
    };
    let left_out = integrity.left_out.sentences(integrity.damaged_chunks);
    std::iter::once(end.to_owned()).chain(left_out).collect::<Vec<_>>().join("; ")
}

/// What a repaired file lacks, by its record `rapid/recovered`; `None`: it has none.
pub(super) fn repaired(recovered: &BTreeMap<String, String>) -> Option<String> {
    let count = |key: &str| recovered.get(key).and_then(|count| count.parse::<u64>().ok()).unwrap_or(0);
    let counts = recovered.keys().map(|key| (key.clone(), Value::from(count(key)))).collect();
    let left_out: LeftOut = serde_json::from_value(Value::Object(counts)).unwrap_or_default();
    let mut report = vec!["it was repaired".to_owned()];
    match recovered.get("end").map(String::as_str) {
        Some("unfinished" | "torn") => report.push("what came last may be missing".to_owned()),
        Some("damaged") => report.push("its end could not be read".to_owned()),
        _ => {}
    }
    report.extend(left_out.sentences(count("damaged_chunks")));
    if count("refused_records") > 0 {
        report.push("records that make no sense are left out".to_owned());
    }
    let ordered = count("ordered_messages");
    report.extend((ordered > 0).then(|| unverified(ordered)));
    (!recovered.is_empty()).then(|| report.join("; "))
}

/// So many messages of a chunk that was cut are there, although nothing shows whether a bit of them changed.
pub(super) fn unverified(count: u64) -> String {
    let are = if count == 1 { "message at its end is" } else { "messages at its end are" };
    format!("{} {are} taken without a check value", text::count(count))
}

/// What of each modality is counted, summed up, if the recorder counted `key` too.
pub(super) fn sum(
    summary: &BTreeMap<String, String>,
    key: &str,
    modalities: &[ModalityReport],
    count: fn(&Quality) -> u64,
) -> Option<u64> {
    let recorded = summary.get(key)?.parse().ok()?;
    let counted = modalities.iter().map(|modality| modality.quality.as_ref().map(count));
    // Without a judge there is only the recorder's count.
    Some(counted.sum::<Option<u64>>().filter(|_| !modalities.is_empty()).unwrap_or(recorded))
}

/// The verdict of the recorder's summary; `None` in a file that has no verdict.
pub(super) fn recorded_verdict(summary: &BTreeMap<String, String>) -> Option<Verdict> {
    let word = summary.get("verdict")?;
    let grade = [Grade::Good, Grade::Suspect, Grade::Bad].into_iter().find(|grade| grade.word() == word)?;
    let reasons = of_json(summary, "reasons")?;
    let sensors = of_json(summary, "sensors");
    let replayed: Vec<ReplaySource> = of_json(summary, REPLAY_OF).unwrap_or_default();
    let replay_of = replayed.iter().map(|replayed| replayed.name().to_owned()).collect();
    Some(Verdict { grade, reasons, sensors, replay_of })
}

fn of_json<T: serde::de::DeserializeOwned>(map: &BTreeMap<String, String>, key: &str) -> Option<T> {
    serde_json::from_str(map.get(key)?).ok()
}

/// What was counted in a file.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Counted {
    /// Messages on all topics.
    pub(super) messages: u64,
    /// Ticks of the frame index, and the time of the latest.
    pub(super) frames: u64,
    pub(super) last_frame: u64,
    /// Records that could not be understood.
    pub(super) unread: u64,
    /// Changes of the mask and of what is plugged in that were too many to be judged.
    pub(super) unjudged: u64,
    /// Samples of no bytes.
    pub(super) empty: u64,
    /// Metadata records at the beginning, and at the end.
    pub(super) abouts: u64,
    pub(super) summaries: u64,
    /// Is the registry attached that its metadata name? Unknown without an attachment.
    pub(super) attached: Option<bool>,
    /// Numbers missing between its messages, and between ticks of its frame index.
    pub(super) missing: Missing,
    pub(super) missing_frames: u64,
}

/// What in a file could not be judged, is there without proof, or contradicts something else in it: each is a reason
/// against GOOD, whatever check values are right.
pub(super) fn doubts(ending: &Ending<'_>) -> Vec<String> {
    let Counted { unread, unjudged, empty, abouts, summaries, attached, .. } = ending.counted;
    let unread = unread.saturating_add(ending.file.left_out.oversized_records);
    let counted = [
        (unread, "record", "in the file cannot be understood"),
        (unjudged, "change", "of the mask or of what is plugged in not judged: there are more than 10,000"),
        (empty, "sample", "without content"),
    ];
    let counted = counted.into_iter().filter(|(count, ..)| *count > 0);
    let mut report: Vec<String> =
        counted.map(|(count, what, rest)| format!("{} {rest}", text::counted(count, what))).collect();
    let twice = [(abouts, ABOUT), (summaries, SUMMARY)].into_iter().filter(|(count, _)| *count > 1);
    report
        .extend(twice.map(|(count, name)| format!("it has {count} metadata records {name:?}, of which one is right")));
    let registry = match attached {
        Some(true) => None,
        Some(false) => Some("the registry attached to it is not that of its metadata"),
        None => Some("the registry is not attached to it"),
    };
    report.extend(registry.map(str::to_owned));
    if ending.file.end == FileEnd::Finished && !ending.file.indexed {
        report.push("it has no index".to_owned());
    }
    let named = EpisodeId::from_metadata(ending.about).zip(ending.file.episode);
    if named.is_some_and(|(metadata, chunks)| metadata != chunks) {
        report.push("its metadata and its samples are of different episodes".to_owned());
    }
    report.extend(length(ending));
    let (unproven, frames) = (ending.file.ordered_messages, ending.counted.missing_frames);
    report.extend((unproven > 0).then(|| unverified(unproven)));
    let are = if frames == 1 { "frame is" } else { "frames are" };
    report.extend((frames > 0).then(|| format!("{frames} {are} not in the file (limit 0)")));
    report
}

/// Is the file as long as its summary states? A recorder that ends an episode writes every frame before its end.
fn length(ending: &Ending<'_>) -> Option<String> {
    if ending.repaired.is_some() || ending.summary.contains_key(CUT_SHORT) {
        return None;
    }
    let seconds: f64 = ending.summary.get("duration_s")?.parse().ok()?;
    let hz: f64 = ending.about.get("observation_hz")?.parse().ok()?;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates, as wanted")]
    let end = Stamp((seconds * 1e9).round() as u64);
    let begin: u64 = ending.about.get("begin_wall_ns")?.parse().ok()?;
    let grid = Grid::new(Stamp(0), hz);
    let Counted { frames, last_frame, .. } = ending.counted;
    let last = grid.tick(frames.saturating_sub(1)).0;
    // The length is rounded, a tick is not.
    let differs = grid.ticks_before(end).abs_diff(frames) > 1
        || frames > 0 && last.abs_diff(last_frame.saturating_sub(begin)) > ROUNDING
        || !hz.is_finite();
    differs
        .then(|| format!("its metadata give {seconds} s at {hz} frames a second, which its {frames} frames do not fit"))
}
