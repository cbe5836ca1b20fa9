//! What in a file could not be judged, or contradicts something else in it: each is a reason against GOOD, whatever
//! check values are right.

use super::super::metadata::CUT_SHORT;
use super::super::verdict::Finding;
use super::judge::Ending;
use crate::episode_format::own::EpisodeId;
use crate::episode_format::walk::FileEnd;
use crate::episode_format::{ABOUT, SUMMARY};
use crate::sync::Grid;
use crate::text;
use crate::time::Stamp;

/// Ticks are at whole nanoseconds of another clock.
const ROUNDING: u64 = 1_000;

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
    /// Numbers missing between its messages.
    pub(super) missing: Missing,
}

/// Numbers missing between the messages of a topic.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Missing {
    pub(super) actions: u64,
    pub(super) masks: u64,
    pub(super) events: u64,
    pub(super) frames: u64,
}

/// See the module's comment.
pub(super) fn of(ending: &Ending<'_>) -> Vec<Finding> {
    let Counted { unread, unjudged, empty, abouts, summaries, attached, .. } = ending.counted;
    let unread = unread.saturating_add(ending.file.left_out.oversized_records);
    let counted = [
        (unread, "record", "in the file cannot be understood"),
        (unjudged, "change", "of the mask or of what is plugged in not judged: there are more than 10,000"),
        (empty, "sample", "without content"),
    ];
    let counted = counted.into_iter().filter(|(count, ..)| *count > 0);
    let mut said: Vec<String> =
        counted.map(|(count, what, rest)| format!("{} {rest}", text::counted(count, what))).collect();
    let twice = [(abouts, ABOUT), (summaries, SUMMARY)].into_iter().filter(|(count, _)| *count > 1);
    said.extend(twice.map(|(count, name)| format!("it has {count} metadata records {name:?}, of which one is right")));
    let registry = match attached {
        Some(true) => None,
        Some(false) => Some("the registry attached to it is not that of its metadata"),
        None => Some("the registry is not attached to it"),
    };
    said.extend(registry.map(str::to_owned));
    if ending.file.end == FileEnd::Finished && !ending.file.indexed {
        said.push("it has no index".to_owned());
    }
    let named = EpisodeId::of(ending.about).zip(ending.file.episode);
    if named.is_some_and(|(metadata, chunks)| metadata != chunks) {
        said.push("its metadata and its samples are of different episodes".to_owned());
    }
    said.extend(length(ending));
    said.into_iter().map(Finding::suspect).collect()
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
