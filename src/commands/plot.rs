//! `rapid inspect --plot`: a picture of each episode.
//!
//! Invariant: only a picture that this command made is replaced.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_episode::plot::{self, Plot};
use rapid_episode::record::inspect::{self, Judgement, ReadError};
use rapid_system::folder::{Folder, FolderError, Links, Missing, Sync};
use serde::Serialize;

use super::{CommandStatus, Format, json_line};
use crate::session::noted::noted;

/// Anyone may read a picture whose episode may be read.
const MODE: u32 = 0o644;

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The episode.
    #[error(transparent)]
    Episode(#[from] ReadError),
    /// A file of that name is not a picture that this command made.
    #[error("{}: not a picture of `rapid inspect --plot`, and not replaced: move it, or name another with --plot=SVG", .0.display())]
    Foreign(PathBuf),
    /// One name for several pictures.
    #[error(
        "{count} episodes, and one place for a picture, {}: name a folder that exists, or leave the name out", to.display()
    )]
    Several {
        /// How many.
        count: usize,
        /// The name.
        to: PathBuf,
    },
    /// The name of a folder that does not exist.
    #[error("{}: no such folder: make it, or leave the `/` out to name a picture", .0.display())]
    NoFolder(PathBuf),
    /// Episodes of one name, and one folder for their pictures.
    #[error(
        "{} and {} would both be drawn to {}: name a folder for each of their folders, or leave the name out",
        one.display(), other.display(), to.display()
    )]
    Twice {
        /// An episode.
        one: PathBuf,
        /// Another of its name.
        other: PathBuf,
        /// The picture.
        to: PathBuf,
    },
    /// The folder of the picture.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The picture cannot be written.
    #[error("{}: {source}", path.display())]
    Output {
        /// The picture.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// Standard output.
    #[error("output: {0}")]
    Stdout(#[from] io::Error),
}

/// A picture that was written.
#[derive(Debug, Serialize)]
struct Written<'a> {
    #[serde(serialize_with = "text::lossy")]
    file: &'a Path,
    #[serde(flatten)]
    verdict: &'a Judgement,
    #[serde(serialize_with = "text::lossy")]
    svg: &'a Path,
    /// Bytes of the picture.
    bytes: usize,
}

enum Destination<'a> {
    Beside,
    In(&'a Path),
    Named(&'a Path),
    Stdout,
}

/// Draws the episodes at `paths` to `to`: a name, a folder, `-` for `out`, or beside each episode. A line for each picture
/// goes to `out`. Of several, one that cannot be read is reported to `err`; then the outcome is not
/// [`CommandStatus::Done`].
///
/// # Errors
/// When the only file named cannot be read, a picture cannot be written, or a name is taken by another file.
pub fn plot(
    paths: &[PathBuf],
    to: Option<&Path>,
    format: Format,
    out: &mut dyn Write,
    err: &mut dyn Write,
) -> Result<CommandStatus, PlotError> {
    let files = inspect::episodes(paths)?;
    let place = match to {
        None => Destination::Beside,
        Some(to) if to.as_os_str() == "-" => Destination::Stdout,
        Some(to) if to.is_dir() => Destination::In(to),
        Some(to) if to.as_os_str().as_encoded_bytes().ends_with(b"/") => {
            return Err(PlotError::NoFolder(to.to_owned()));
        }
        Some(to) => Destination::Named(to),
    };
    if let (Destination::Named(_) | Destination::Stdout, Some(to), 2..) = (&place, to, files.len()) {
        return Err(PlotError::Several { count: files.len(), to: to.to_owned() });
    }
    if let Destination::In(folder) = place {
        let mut names = BTreeMap::new();
        for file in &files {
            if let Some(other) = names.insert(picture_of(file), file) {
                let to = folder.join(picture_of(file));
                return Err(PlotError::Twice { one: other.clone(), other: file.clone(), to });
            }
        }
    }
    // A picture without what people noted is one too; `rapid list` reports a session that cannot be read.
    let noted = noted(&files, &mut |_| {});
    if files.is_empty() && matches!(format, Format::Text) {
        writeln!(err, "no episodes in {}", text::plain(&folder_names(paths)))?;
    }
    let mut outcome = CommandStatus::Done;
    // One after the other: each may hold a large picture of a camera.
    for file in &files {
        let Plot { report, svg } = match plot::plot(file, noted.get(file)) {
            Ok(plot) => plot,
            Err(error) if files.len() > 1 => {
                writeln!(err, "error: {}", text::plain(&error.to_string()))?;
                outcome = CommandStatus::BadConfiguration;
                continue;
            }
            Err(error) => return Err(error.into()),
        };
        let name = match place {
            Destination::Stdout => {
                out.write_all(svg.as_bytes())?;
                continue;
            }
            Destination::Named(name) => name.to_owned(),
            Destination::Beside => file.with_file_name(picture_of(file)),
            Destination::In(folder) => folder.join(picture_of(file)),
        };
        write(&name, &svg)?;
        let written = Written { file, verdict: &report.verdict, svg: &name, bytes: svg.len() };
        match format {
            Format::Json => writeln!(out, "{}", json_line("plotted", &written)?)?,
            Format::Text => writeln!(out, "{}", text::plain(&name.display().to_string()))?,
        }
    }
    Ok(outcome)
}

fn folder_names(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// The name of the picture of an episode: `X.svg` of `X.mcap`, `X.mcap.partial.svg` of `X.mcap.partial`.
fn picture_of(file: &Path) -> OsString {
    let is_finished = file.extension().is_some_and(|ending| ending == "mcap");
    let stem = if is_finished { file.file_stem() } else { file.file_name() };
    let mut name = stem.unwrap_or_default().to_owned();
    name.push(".svg");
    name
}

/// Writes a picture, in the place of an earlier one only.
fn write(name: &Path, svg: &str) -> Result<(), PlotError> {
    let io = |source| PlotError::Output { path: name.to_owned(), source };
    let parent = name.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = Folder::open(parent, Links::Own, Missing::Refused)?;
    let own = name.file_name().ok_or_else(|| io(io::ErrorKind::InvalidInput.into()))?;
    if folder.has(own) {
        let mut beginning = Vec::new();
        let file = folder.open_file(own).map_err(|_| PlotError::Foreign(name.to_owned()))?;
        file.take(plot::BEGINNING.len() as u64).read_to_end(&mut beginning).map_err(io)?;
        if beginning != plot::BEGINNING.as_bytes() {
            return Err(PlotError::Foreign(name.to_owned()));
        }
    }
    folder.replace(own, svg.as_bytes(), MODE, Sync::Skip).map_err(io)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_picture_of_this_command_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.svg");
        let svg = |what: &str| format!("{}<svg>{what}</svg>", plot::BEGINNING);
        write(&path, &svg("one")).unwrap();
        write(&path, &svg("two")).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), svg("two"));
        for other in ["", "<svg/>", &plot::BEGINNING[..20]] {
            std::fs::write(&path, other).unwrap();
            assert!(matches!(write(&path, &svg("three")), Err(PlotError::Foreign(_))), "{other:?}");
            assert_eq!(std::fs::read_to_string(&path).unwrap(), other);
        }
        // A link to a picture may lead anywhere.
        std::fs::write(folder.path().join("b.svg"), svg("one")).unwrap();
        std::fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink("b.svg", &path).unwrap();
        assert!(matches!(write(&path, &svg("three")), Err(PlotError::Foreign(_))));
        assert!(matches!(write(&folder.path().join("none/a.svg"), &svg("one")), Err(PlotError::Folder(_))));
    }

    #[test]
    fn each_episode_has_a_name_of_its_own() {
        let names = ["x/a.mcap", "a.mcap.partial", "a.recovered.mcap", "a"].map(|file| picture_of(Path::new(file)));
        assert_eq!(names, ["a.svg", "a.mcap.partial.svg", "a.recovered.svg", "a.svg"]);
    }
}
