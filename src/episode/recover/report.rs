//! The report on a repair: the metadata in the repaired file, and a sentence for people. Pure.

use std::collections::BTreeMap;

use rapid_core::text;
use rapid_core::time;
use rapid_status::{Grade, Level};
use serde_json::{Map, Value, json};

use super::summary::{LOSSLESS, SHA256, Summary};
use super::{FileEnd, LeftOut, Recovered, RepairOutcome, Repaired};
use crate::{FAILED, Failed, text_map};

/// Facts about the repair itself.
#[derive(Debug, Clone)]
pub(super) struct About<'a> {
    /// The original.
    pub(super) name: &'a str,
    /// Its SHA-256, hexadecimal.
    pub(super) sha256: String,
    /// Wall time now.
    pub(super) time_ns: u64,
    /// The present boot, if it is to prove the last writes: see [`RecordIter::of_boot`].
    pub(super) boot: Option<String>,
    /// The mark that the original's recorder appended, if any.
    pub(super) failed: Option<&'a Failed>,
}

/// A whole file was written.
#[derive(Debug)]
pub(super) struct Copied {
    pub(super) summary: Summary,
    /// Its content and losses; the caller adds its name and that of the original.
    pub(super) repaired: Repaired,
    /// Nothing of the original is left out but a torn end.
    pub(super) is_lossless: bool,
}

/// The metadata record `rapid/summary` of an episode whose recorder wrote none, as far as it is
/// known. Same keys as the recorder's, without those that only the recorder could count.
///
/// JSON: `modalities` `{name: {samples}}`.
pub(super) fn end(summary: &Summary) -> BTreeMap<String, String> {
    let mut modalities = Map::new();
    for channel in summary.channels.values() {
        let Some(name) = &channel.modality else { continue };
        let before = modalities.get(name).and_then(|report| report["samples"].as_u64()).unwrap_or(0);
        modalities.insert(name.clone(), json!({"samples": before.saturating_add(channel.messages)}));
    }
    text_map([
        ("duration_s", summary.seconds().to_string()),
        ("messages", summary.messages.to_string()),
        ("frames", summary.frames.to_string()),
        ("modalities", Value::Object(modalities).to_string()),
    ])
}

/// The metadata record `rapid/recovered`: what was repaired when and by which program, with its content and losses: the
/// keys of [`LeftOut`](super::LeftOut), and as JSON `nameless` `{channel: messages}`. `ordered_messages` were taken
/// without a check value, because the machine has not been restarted since they were written.
pub(super) fn recovered(copied: &Copied, about: &About<'_>, size: u64) -> BTreeMap<String, String> {
    let Repaired { unread_bytes, refused_records, nameless, failed, .. } = &copied.repaired;
    let Repaired { messages, seconds, damaged_chunks, ordered_messages, .. } = copied.repaired;
    let end = serde_json::to_value(copied.repaired.end).ok();
    let mut report = text_map([
        ("software", concat!("rapid ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("time", time::rfc3339(about.time_ns)),
        ("source", about.name.to_owned()),
        ("source_bytes", size.to_string()),
        ("end", end.as_ref().and_then(Value::as_str).unwrap_or_default().to_owned()),
        ("messages", messages.to_string()),
        ("seconds", seconds.to_string()),
        ("last_wall_ns", copied.summary.last_ns.to_string()),
        ("unread_bytes", unread_bytes.to_string()),
        (SHA256, about.sha256.clone()),
        ("damaged_chunks", damaged_chunks.to_string()),
        ("ordered_messages", ordered_messages.to_string()),
        ("nameless", json!(nameless).to_string()),
        ("refused_records", refused_records.to_string()),
        (LOSSLESS, copied.is_lossless.to_string()),
    ]);
    if let Ok(Value::Object(left_out)) = serde_json::to_value(copied.repaired.left_out) {
        report.extend(left_out.into_iter().map(|(key, count)| (key, count.to_string())));
    }
    report.extend(failed.iter().map(|why| (FAILED.to_owned(), why.clone())));
    report
}

/// The `rapid/summary` of an episode that its recorder called BAD only after it had written that.
pub(super) fn failed(why: &str) -> BTreeMap<String, String> {
    text_map([("verdict", Grade::Bad.word().to_owned()), ("reasons", json!([why]).to_string())])
}

impl Recovered {
    /// The result for the file, for people, and its level.
    pub fn sentence(&self) -> (Level, String) {
        let name = |path: &std::path::Path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let (level, text) = match &self.outcome {
            RepairOutcome::Repaired(repaired) => {
                let whole = repaired.original.is_none() && repaired.failed.is_none();
                let mut report = repaired.sentence();
                if repaired.to != self.file.with_extension("") {
                    report = format!("{report}; now {}", name(&repaired.to));
                }
                if let Some(original) = repaired.original.as_ref().filter(|original| **original != self.file) {
                    report = format!("{report}; all of it is kept in {}", name(original));
                }
                (if whole { Level::Info } else { Level::Warn }, report)
            }
            RepairOutcome::Whole { to } if *to == self.file => (Level::Info, "whole; nothing to repair".to_owned()),
            RepairOutcome::Whole { to } => (Level::Info, format!("whole; it only lacked its name, {}", name(to))),
            RepairOutcome::AlreadyRepaired { to, kept: None } => {
                (Level::Info, format!("already repaired: {}", name(to)))
            }
            RepairOutcome::AlreadyRepaired { to, kept: Some(kept) } => {
                let (to, kept) = (name(to), name(kept));
                (Level::Warn, format!("already repaired: {to}; all of it is kept in {kept}"))
            }
            RepairOutcome::Empty { kept: None } => (Level::Info, "of no bytes; removed".to_owned()),
            RepairOutcome::Empty { kept: Some(kept) } => {
                (Level::Info, format!("nothing was recorded in it; set aside as {}", name(kept)))
            }
            RepairOutcome::Unreadable { kept, failed } => {
                let why = failed.as_ref().map(|why| format!("; BAD: {why}")).unwrap_or_default();
                (Level::Warn, format!("no message in it can be read{why}; set aside as {}", name(kept)))
            }
        };
        (level, format!("{}: {text}", self.file.display()))
    }
}

impl Repaired {
    /// Is nothing left out although the original was not whole? Then data is missing, or a check value is wrong.
    fn is_unexplained(&self) -> bool {
        let counted = [self.unread_bytes, self.damaged_chunks, self.ordered_messages, self.refused_records];
        self.failed.is_none() && counted.iter().all(|count| *count == 0) && self.left_out == LeftOut::default()
    }

    fn sentence(&self) -> String {
        let mut report = format!("repaired, {:.1} s, {}", self.seconds, text::counted(self.messages, "message"));
        let mut but = |text: String| {
            report.push_str("; ");
            report.push_str(&text);
        };
        if let Some(why) = &self.failed {
            but(format!("BAD: {why}"));
        }
        let unread = text::counted(self.unread_bytes, "byte");
        match self.end {
            FileEnd::Finished if self.is_unexplained() => {
                but("its end does not fit what is before it: parts of it may be missing".to_owned());
            }
            FileEnd::Finished => {}
            FileEnd::Unfinished => but("the last second may be missing".to_owned()),
            FileEnd::Torn if self.unread_bytes == 0 => but("the last second may be missing".to_owned()),
            FileEnd::Torn => {
                let were = if self.unread_bytes == 1 { "was" } else { "were" };
                but(format!("the last second may be missing: {unread} at the end {were} torn"));
            }
            FileEnd::Damaged => but("the end cannot be read".to_owned()),
        }
        if self.unread_bytes > 0 && self.end != FileEnd::Torn {
            but(format!("{unread} could not be read"));
        }
        if self.ordered_messages > 0 {
            let messages = text::counted(self.ordered_messages, "message");
            but(format!(
                "{messages} of a torn chunk taken without a check value, written since this machine was started"
            ));
        }
        self.left_out.sentences(self.damaged_chunks).into_iter().for_each(&mut but);
        if !self.nameless.is_empty() {
            let channels: Vec<_> = self.nameless.iter().map(|(id, count)| format!("{id} ({count})")).collect();
            but(format!("of channels {}", channels.join(", ")));
        }
        match self.refused_records {
            0 => {}
            1 => but("1 record that makes no sense is left out".to_owned()),
            records => but(format!("{} records that make no sense are left out", text::count(records))),
        }
        report
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_one_are_singular() {
        let report = |count| {
            let repaired = Repaired {
                to: "a.mcap".into(),
                original: None,
                end: FileEnd::Torn,
                messages: count,
                last: String::new(),
                seconds: 1.0,
                unread_bytes: count,
                damaged_chunks: count,
                left_out: LeftOut { gaps: count, nameless_messages: count, ..LeftOut::default() },
                nameless: BTreeMap::from([(7, count)]),
                ordered_messages: 0,
                refused_records: count,
                failed: None,
            };
            repaired.sentence()
        };
        assert_eq!(
            report(1),
            "repaired, 1.0 s, 1 message; the last second may be missing: 1 byte at the end was torn; \
             1 damaged chunk is left out; 1 place is not readable; 1 message is left out: the definition of the channel is lost; \
             of channels 7 (1); 1 record that makes no sense is left out"
        );
        assert_eq!(
            report(2000),
            "repaired, 1.0 s, 2,000 messages; the last second may be missing: 2,000 bytes at the end were torn; \
             2,000 damaged chunks are left out; 2,000 places are not readable; 2,000 messages are left out: the definition \
             of the channel is lost; of channels 7 (2000); 2,000 records that make no sense are left out"
        );
    }
}
