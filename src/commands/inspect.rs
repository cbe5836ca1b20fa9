//! `rapid inspect`: a report on one episode, or one line per episode.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_episode::record::inspect::{self, Judgement, ReadError};
use rapid_episode::sha256;
use rapid_status::palette::Palette;

use super::{CommandStatus, Format, json_line, progress};

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum InspectFailure {
    /// The episode.
    #[error(transparent)]
    Episode(#[from] ReadError),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// A line of `--json`: the report, and the SHA-256 of the file. `rapid list` does not read files for it.
#[derive(serde::Serialize)]
struct Hashed<'a, T> {
    #[serde(flatten)]
    report: &'a T,
    /// Hexadecimal; none of a file that cannot be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    sha256: Option<String>,
}

/// Reports on the episodes at `paths`. In a list, a file that cannot be read has a line too; then the
/// outcome is not [`CommandStatus::Done`]. An MCAP file of another program is not an error.
///
/// # Errors
/// When the only file named cannot be read, or nothing can be written to `out`.
pub fn inspect(
    paths: &[PathBuf],
    format: Format,
    columns: usize,
    palette: Palette,
    out: &mut impl Write,
) -> Result<CommandStatus, InspectFailure> {
    if let [path] = paths
        && !path.is_dir()
    {
        let inspection = inspect::inspect(path)?;
        match format {
            Format::Json => {
                let line = Hashed { report: &inspection, sha256: Some(sha256(path)?) };
                writeln!(out, "{}", json_line("inspection", &line)?)?;
            }
            Format::Text => out.write_all(inspect::render(&inspection, columns, palette).as_bytes())?,
        }
        return Ok(CommandStatus::Done);
    }
    let files = inspect::episodes(paths)?;
    if files.is_empty() && format == Format::Text {
        let places: Vec<_> = paths.iter().map(|path| path.display().to_string()).collect();
        writeln!(out, "no episodes in {}", text::plain(&places.join(", ")))?;
    }
    // Files of several folders may have the same name: then they are named by their paths.
    let folders: BTreeSet<Option<&Path>> = files.iter().map(|file| file.parent()).collect();
    let name_of = |file: &Path| {
        let name = if folders.len() > 1 { file.as_os_str() } else { file.file_name().unwrap_or_default() };
        text::plain(&name.to_string_lossy()).into_owned()
    };
    let name = files.iter().map(|file| text::width(&name_of(file))).max().unwrap_or(0);
    let mut outcome = CommandStatus::Done;
    let read = |file: &Path| {
        let sha256 = if format == Format::Json { sha256(file).ok() } else { None };
        (inspect::list(file), sha256)
    };
    progress::each(&files, read, |file, (listed, sha256)| {
        if matches!(listed.verdict, Judgement::Unreadable(_)) {
            outcome = CommandStatus::BadConfiguration;
        }
        match format {
            Format::Json => {
                json_line("listed", &Hashed { report: &listed, sha256 }).and_then(|line| writeln!(out, "{line}"))
            }
            Format::Text => writeln!(out, "{}", inspect::render_list(&listed, &name_of(file), name, palette)),
        }
    })?;
    Ok(outcome)
}
