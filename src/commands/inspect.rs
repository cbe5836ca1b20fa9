//! `rapid inspect`: a report on one episode, or a line for each of many.

use std::io::{self, Write};
use std::path::PathBuf;

use super::{Format, Outcome};
use crate::record::inspect::{self, InspectError, Paint};
use crate::text;

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum InspectFailure {
    /// The episode.
    #[error(transparent)]
    Episode(#[from] InspectError),
    /// The output.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// Tells of the episodes at `paths`. In a list, a file that cannot be read has a line like the others;
/// then the outcome is not [`Outcome::Done`].
///
/// # Errors
/// When the only file named cannot be read, or nothing can be written to `out`.
pub fn inspect(
    paths: &[PathBuf],
    format: Format,
    columns: usize,
    paint: Paint,
    out: &mut impl Write,
) -> Result<Outcome, InspectFailure> {
    if let [path] = paths
        && !path.is_dir()
    {
        let inspection = inspect::inspect(path)?;
        match format {
            Format::Json => write_json(out, &inspection)?,
            Format::Text => out.write_all(inspect::render(&inspection, columns, paint).as_bytes())?,
        }
        return Ok(Outcome::Done);
    }
    let files = inspect::episodes(paths)?;
    if files.is_empty() && format == Format::Text {
        let places: Vec<_> = paths.iter().map(|path| path.display().to_string()).collect();
        writeln!(out, "no episodes in {}", text::plain(&places.join(", ")))?;
    }
    let width = |file: &PathBuf| text::width(&file.file_name().unwrap_or_default().to_string_lossy());
    let name = files.iter().map(width).max().unwrap_or(0);
    let mut outcome = Outcome::Done;
    for file in &files {
        // One after the other: a line is there as soon as its file has been read.
        let listed = inspect::list(file);
        if listed.verdict.is_none() {
            outcome = Outcome::BadConfiguration;
        }
        match format {
            Format::Json => write_json(out, &listed)?,
            Format::Text => writeln!(out, "{}", inspect::render_list(&listed, name, paint))?,
        }
    }
    Ok(outcome)
}

fn write_json(out: &mut impl Write, value: &impl serde::Serialize) -> io::Result<()> {
    writeln!(out, "{}", crate::text::json(value)?)
}
