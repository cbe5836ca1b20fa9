//! The grammar of `rapid label`.

use std::path::PathBuf;

use clap::{Args, ValueHint};
use rapid_registry::units::parse_duration;
use rapid_status::session::{LONGEST, Mark, NotesChange};

use super::list::LabelFilter;

pub(super) const LABEL: &str = "\
It is written to X.mcap.toml beside X.mcap, which is moved and deleted with the episode; lists, datasets and \
pictures have it from there. No run is needed, and one in progress may go on.

Examples:
  rapid label episodes/20260101_place-block_001.mcap success
  rapid label episodes/20260101_place-block_002.mcap failure \"it slipped\" --note \"new pads\"
  rapid label episodes/20260101_place-block_002.mcap none             removes the label
  rapid label episodes/20260101_place-block_002.mcap --mark 12.5s=grasped
  rapid episode label success            the episode in progress, or the last one";

/// What to note about an episode.
#[derive(Debug, Args)]
pub struct LabelArgs {
    /// Episode, finished or .partial
    #[arg(value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub file: PathBuf,
    /// Whether the demonstration succeeded; none removes the label
    label: Option<LabelFilter>,
    /// Why
    #[arg(value_name = "TEXT", default_value = "", hide_default_value = true)]
    reason: String,
    /// Attach a note; an empty one removes it
    #[arg(long, value_name = "TEXT")]
    note: Option<String>,
    /// Mark a moment since the beginning, such as 12.5s=grasped; repeatable
    #[arg(long, value_name = "TIME[=TEXT]", value_parser = mark)]
    mark: Vec<Mark>,
}

fn mark(text: &str) -> Result<Mark, String> {
    let (at, text) = text.split_once('=').unwrap_or((text, ""));
    let at = parse_duration(at).ok_or_else(|| "write a number and a unit, such as 12.5s".to_owned())?.as_secs_f64();
    // What is read from a file is not longer either.
    let is_possible = at <= LONGEST;
    is_possible.then_some(Mark { at, text: text.to_owned() }).ok_or_else(|| "no episode is that long".to_owned())
}

impl LabelArgs {
    /// What changes, in this order.
    pub fn changes(&self) -> Vec<NotesChange> {
        let label = self.label.map(|label| NotesChange::Label(label.label(), self.reason.clone()));
        let note = self.note.clone().map(NotesChange::Note);
        label.into_iter().chain(note).chain(self.mark.iter().cloned().map(NotesChange::Mark)).collect()
    }
}
