//! The state of a file: whether it is whole, what a repair recorded about it, and what of it is counted.

use std::collections::BTreeMap;

use super::super::metadata::CUT_SHORT;
use super::super::verdict::{FileState, Finding};
use super::super::walk::{FileEnd, LeftOut, Walked};
use super::ModalityReport;
use super::judge::Ending;
use crate::record::Quality;
use crate::status::{Grade, Verdict};
use crate::text;

const UNPROVEN: &str = "check values are missing in it, so that damage would not show";

pub(super) fn file_state<'a>(ending: &Ending<'a>) -> FileState<'a> {
    let Ending { file: walked, summary, repaired, failed, damage, .. } = ending;
    if let Some(why) = failed {
        return FileState::Failed(why);
    }
    let cut_short = summary.get(CUT_SHORT);
    match (walked.end, *repaired) {
        (FileEnd::Finished, Some(said)) => FileState::NotWhole(said),
        // A check value that is not right counts as much as a chunk that cannot be read.
        (FileEnd::Finished, None) if walked.damaged_chunks == 0 && walked.sound => match cut_short {
            Some(why) => FileState::NotWhole(why),
            // Whoever wrote the footer: what the recorder ends, it sums up.
            None if summary.is_empty() => FileState::NotWhole("the recorder has not finished it"),
            None if !walked.proven => FileState::NotWhole(UNPROVEN),
            None => FileState::Whole,
        },
        (FileEnd::Finished, None) => FileState::NotWhole(damage),
        (FileEnd::Unfinished, _) => FileState::NotWhole("the recorder has not finished it"),
        (FileEnd::Torn, _) => FileState::NotWhole("its last record is cut"),
        (FileEnd::Damaged, _) => FileState::NotWhole("from some place on it cannot be read"),
    }
}

/// What of a damaged file is left out, for people.
pub(super) fn damage(walked: &Walked) -> String {
    let left_out = walked.left_out.sentences(walked.damaged_chunks);
    std::iter::once("parts of it are damaged".to_owned()).chain(left_out).collect::<Vec<_>>().join("; ")
}

/// What is in the file without proof, and what is missing by its own numbers.
pub(super) fn findings(ending: &Ending<'_>) -> impl Iterator<Item = Finding> + use<> {
    let (unproven, frames) = (ending.file.ordered_messages, ending.counted.missing.frames);
    let are = if frames == 1 { "frame is" } else { "frames are" };
    let said = [
        (unproven > 0).then(|| unverified(unproven)),
        (frames > 0).then(|| format!("{frames} {are} not in the file (limit 0)")),
    ];
    said.into_iter().flatten().map(Finding::suspect)
}

/// What a repaired file lacks, by its record `rapid/recovered`; `None`: it has none.
pub(super) fn repaired(recovered: &BTreeMap<String, String>) -> Option<String> {
    let count = |key: &str| recovered.get(key).and_then(|count| count.parse::<u64>().ok()).unwrap_or(0);
    let left_out = LeftOut {
        gaps: count("gaps"),
        oversized_records: count("oversized_records"),
        swollen_chunks: count("swollen_chunks"),
        excess_records: count("excess_records"),
        repeated_chunks: count("repeated_chunks"),
        nameless_messages: count("nameless_messages"),
        unproven_messages: count("unproven_messages"),
        unproven_bytes: count("unproven_bytes"),
        other_chunks: count("other_chunks"),
        bytes_before: count("bytes_before"),
        bytes_behind: count("bytes_behind"),
    };
    let mut said = vec!["it was repaired".to_owned()];
    match recovered.get("end").map(String::as_str) {
        Some("unfinished" | "torn") => said.push("what came last may be missing".to_owned()),
        Some("damaged") => said.push("its end could not be read".to_owned()),
        _ => {}
    }
    said.extend(left_out.sentences(count("damaged_chunks")));
    if count("refused_records") > 0 {
        said.push("records that make no sense are left out".to_owned());
    }
    let ordered = count("ordered_messages");
    said.extend((ordered > 0).then(|| unverified(ordered)));
    (!recovered.is_empty()).then(|| said.join("; "))
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
    let reasons = serde_json::from_str(summary.get("reasons")?).ok()?;
    let sensors = summary.get("sensors").and_then(|sensors| serde_json::from_str(sensors).ok());
    Some(Verdict { grade, reasons, sensors })
}
