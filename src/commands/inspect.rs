//! `rapid inspect`: a report on one episode, or a line for each of many.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::{Format, Outcome, episodes};
use crate::record::inspect::{self, InspectError, Judgement, Paint};
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

/// Reports on the episodes at `paths`. In a list, a file that cannot be read has a line like the others;
/// then the outcome is not [`Outcome::Done`]. One that is not an episode of rapid is no error.
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
    // Files of several folders may have one name.
    let folders: BTreeSet<Option<&Path>> = files.iter().map(|file| file.parent()).collect();
    let names = if folders.len() > 1 { Names::Paths } else { Names::Files };
    let name = files.iter().map(|file| text::width(&names.of(file))).max().unwrap_or(0);
    let mut outcome = Outcome::Done;
    episodes::each(&files, inspect::list, |file, listed| {
        if matches!(listed.verdict, Judgement::Unreadable(_)) {
            outcome = Outcome::BadConfiguration;
        }
        match format {
            Format::Json => write_json(out, &listed),
            Format::Text => writeln!(out, "{}", inspect::render_list(&listed, &names.of(file), name, paint)),
        }
    })?;
    Ok(outcome)
}

/// What the files of a list are called.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Names {
    /// By their names: they lie in one folder.
    Files,
    /// By their paths.
    Paths,
}

impl Names {
    fn of(self, file: &Path) -> String {
        let name = match self {
            Self::Files => file.file_name().unwrap_or_default().to_string_lossy(),
            Self::Paths => file.to_string_lossy(),
        };
        text::plain(&name).into_owned()
    }
}

fn write_json(out: &mut impl Write, value: &impl serde::Serialize) -> io::Result<()> {
    writeln!(out, "{}", crate::text::json(value)?)
}
