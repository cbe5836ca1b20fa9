//! `rapid list`: recorded episodes with their verdicts, labels and notes, filtered and sorted.
//!
//! The verdict is that of the file as it is now, not the one noted when it was recorded; label and note are those of
//! the file beside it, or of a session ([`crate::session::noted`]).

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::{self, Write};
use std::path::Path;
use std::time::Duration;

use rapid_core::text;
use rapid_core::time::{Zone, rfc3339};
use rapid_episode::record::inspect::{self, Judgement, Listed, ReadError};
use rapid_status::Grade;
use rapid_status::palette::Palette;
use rapid_status::session::{Label, Notes};
use serde::Serialize;

use super::{CommandStatus, Format, json_line, progress};
use crate::cli::{LabelFilter, ListArgs, SortArg};
use crate::session::noted::{NotedError, noted};

/// Why there is no list.
#[derive(Debug, thiserror::Error)]
pub enum ListError {
    /// A folder cannot be read.
    #[error(transparent)]
    Episode(#[from] ReadError),
    /// A date is invalid.
    #[error("{option}: {why}")]
    Date {
        /// The option.
        option: &'static str,
        /// What is wrong with it.
        why: String,
    },
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// An episode, and what people noted about it.
#[derive(Debug, Serialize)]
struct Row {
    #[serde(flatten)]
    listed: Listed,
    /// Beginning, RFC 3339, UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    begun: Option<String>,
    #[serde(flatten)]
    notes: Notes,
}

impl Row {
    fn new(listed: Listed, notes: Notes) -> Self {
        let begun = (listed.begin_ns > 0).then(|| rfc3339(listed.begin_ns));
        Self { listed, begun, notes }
    }

    /// The first reason for its verdict, and all that was noted.
    fn remarks(&self) -> String {
        let reasons = self.listed.verdict.reasons();
        let first = reasons.first().copied().unwrap_or_default();
        let more = if reasons.len() > 1 { format!("and {} more", reasons.len() - 1) } else { String::new() };
        let label = if self.notes.label_reason.is_empty() {
            String::new()
        } else {
            format!("{}: {}", self.notes.label.map_or("label", Label::word), self.notes.label_reason)
        };
        let verdict = self.listed.verdict.verdict();
        let away = verdict.and_then(|verdict| verdict.sensors.as_ref()).map_or(&[][..], |sensors| &sensors.away);
        let away: Vec<String> = away.iter().map(ToString::to_string).collect();
        let replays =
            verdict.map_or(&[][..], |verdict| &verdict.replay_of).iter().map(|file| format!("replay of {file}"));
        // The reason names it already.
        let replays: Vec<String> = replays.filter(|replay| !first.starts_with(replay.as_str())).collect();
        let tags: Vec<String> = self.listed.tags.iter().map(|(key, value)| format!("{key}={value}")).collect();
        let parts = [&tags.join(" "), first, &more, &replays.join(", "), &away.join(", "), &label, &self.notes.note];
        let parts: Vec<&str> = parts.into_iter().filter(|part| !part.is_empty()).collect();
        text::plain(&parts.join("; ")).into_owned()
    }
}

#[derive(Debug)]
struct Filter<'a> {
    args: &'a ListArgs,
    task: Option<String>,
    since_ns: u64,
    before_ns: u64,
}

impl<'a> Filter<'a> {
    fn new(args: &'a ListArgs, zone: &Zone) -> Result<Self, ListError> {
        let date = |option, text: &Option<String>, missing| match text {
            Some(text) => zone.wall_ns(text).map_err(|why| ListError::Date { option, why }),
            None => Ok(missing),
        };
        Ok(Self {
            args,
            task: args.task.as_ref().map(|task| task.to_lowercase()),
            since_ns: date("--since", &args.since, 0)?,
            before_ns: date("--before", &args.before, u64::MAX)?,
        })
    }

    fn wants(&self, row: &Row) -> bool {
        let Listed { verdict, task, tags, recorded, begin_ns, .. } = &row.listed;
        if matches!(verdict, Judgement::Unreadable(_)) {
            return true;
        }
        let args = self.args;
        let has = |name: &String| recorded.contains(name);
        (args.verdict.is_empty() || args.verdict.iter().any(|wanted| Some(wanted.grade()) == verdict.grade()))
            && (args.label.is_empty() || args.label.contains(&LabelFilter::of(row.notes.label)))
            && self.task.as_ref().is_none_or(|part| task.to_lowercase().contains(part))
            && args.tag.iter().all(|(key, value)| tags.get(key) == Some(value))
            && args.sensor.iter().all(has)
            && !args.without.iter().any(has)
            && (self.since_ns..self.before_ns).contains(begin_ns)
    }
}

/// Lists the episodes that `args` selects. A file that cannot be read has a line too; then the outcome is not
/// [`CommandStatus::Done`].
///
/// # Errors
/// When a folder cannot be read, a date is invalid, or nothing can be written to `out`.
pub fn list(
    args: &ListArgs,
    format: Format,
    palette: Palette,
    out: &mut dyn Write,
    warn: &mut dyn FnMut(&NotedError),
) -> Result<CommandStatus, ListError> {
    let zone = args.zone();
    let filter = Filter::new(args, &zone)?;
    for path in &args.paths {
        // A name that was mistyped is not an episode that cannot be read.
        std::fs::metadata(path).map_err(|source| ReadError::Io { path: path.clone(), source })?;
    }
    let files = inspect::episodes(&args.paths)?;
    let folders: BTreeSet<&Path> = files.iter().filter_map(|file| file.parent()).collect();
    let mut noted = noted(&files, warn);
    let mut rows = Vec::new();
    progress::each(&files, inspect::list, |file, listed| {
        rows.push(Row::new(listed, noted.remove(file).unwrap_or_default()));
        Ok::<_, ListError>(())
    })?;
    let all = rows.len();
    rows.retain(|row| filter.wants(row));
    sort(&mut rows, args.sort);
    match format {
        Format::Json => rows.iter().try_for_each(|row| writeln!(out, "{}", json_line("listed", row)?))?,
        Format::Text => write_table(&rows, all, folders.len() > 1, &zone, palette, out)?,
    }
    let unreadable = rows.iter().any(|row| matches!(row.listed.verdict, Judgement::Unreadable(_)));
    Ok(if unreadable { CommandStatus::BadConfiguration } else { CommandStatus::Done })
}

fn sort(rows: &mut [Row], by: SortArg) {
    let severity = |row: &Row| match &row.listed.verdict {
        Judgement::Unreadable(_) => 0,
        Judgement::Episode(verdict) if verdict.grade == Grade::Bad => 1,
        Judgement::Episode(verdict) if verdict.grade == Grade::Suspect => 2,
        Judgement::NotOurs => 3,
        Judgement::Episode(_) => 4,
    };
    // The files are in the order of their names, and the sort is stable.
    match by {
        SortArg::Begin => rows.sort_by_key(|row| row.listed.begin_ns),
        SortArg::Verdict => rows.sort_by_key(severity),
        SortArg::Length => rows.sort_by(|a, b| b.listed.seconds.total_cmp(&a.listed.seconds)),
        SortArg::Size => rows.sort_by_key(|row| Reverse(row.listed.bytes)),
        SortArg::Name => {}
    }
}

fn write_table(
    rows: &[Row],
    all: usize,
    has_paths: bool,
    zone: &Zone,
    palette: Palette,
    out: &mut dyn Write,
) -> io::Result<()> {
    let name = |row: &Row| {
        let file = &row.listed.file;
        let name = if has_paths { file.as_os_str() } else { file.file_name().unwrap_or_default() };
        text::plain(&name.to_string_lossy()).into_owned()
    };
    let columns = rows.iter().map(|row| text::width(&name(row))).max().unwrap_or(0);
    for row in rows {
        writeln!(out, "{}", line(row, &text::left(&name(row), columns, ""), zone, palette))?;
    }
    writeln!(out, "{}", palette.faint(&totals(rows, all, zone)))
}

fn line(row: &Row, name: &str, zone: &Zone, palette: Palette) -> String {
    let Listed { verdict, seconds, bytes, begin_ns, .. } = &row.listed;
    let begun = if *begin_ns > 0 { zone.minute(*begin_ns) } else { String::new() };
    let label = row.notes.label.map_or("", Label::word);
    let sensors = verdict.verdict().and_then(|verdict| verdict.sensors.as_ref());
    let sensors = sensors.map(|sensors| format!("{}/{}", sensors.throughout(), sensors.registered)).unwrap_or_default();
    let seconds = if row.listed.error.is_none() { format!("{seconds:.1} s") } else { String::new() };
    let size = if row.listed.error.is_none() { text::size(*bytes) } else { String::new() };
    let line = format!(
        "{begun:16}  {}  {name}  {seconds:>8}  {size:>8}  {sensors:>5}  {label:7}  {}",
        verdict.column(palette),
        row.remarks()
    );
    line.trim_end().to_owned()
}

/// How many, how long, how large, with which verdicts and labels.
fn totals(rows: &[Row], all: usize, zone: &Zone) -> String {
    let count = |grade| rows.iter().filter(|row| row.listed.verdict.grade() == Some(grade)).count();
    let labels = |label| rows.iter().filter(|row| row.notes.label == Some(label)).count();
    let seconds = rows.iter().map(|row| row.listed.seconds.max(0.0)).sum::<f64>();
    let length = Duration::try_from_secs_f64(seconds).unwrap_or_default();
    let bytes: u64 = rows.iter().map(|row| row.listed.bytes).sum();
    let shown = if rows.len() == all { all.to_string() } else { format!("{} of {all}", rows.len()) };
    let mut text = format!(
        "{shown} episode{}: {} GOOD, {} SUSPECT, {} BAD; {} success, {} failure; {}, {}",
        if all == 1 { "" } else { "s" },
        count(Grade::Good),
        count(Grade::Suspect),
        count(Grade::Bad),
        labels(Label::Success),
        labels(Label::Failure),
        text::clock(length),
        text::size(bytes)
    );
    let unreadable = rows.iter().filter(|row| matches!(row.listed.verdict, Judgement::Unreadable(_))).count();
    if unreadable > 0 {
        let _ = write!(text, "; {unreadable} cannot be read");
    }
    if let Some(last) = rows.iter().map(|row| row.listed.begin_ns).max().filter(|ns| *ns > 0) {
        let _ = write!(text, "; times in {}", zone.name(last));
    }
    text
}
