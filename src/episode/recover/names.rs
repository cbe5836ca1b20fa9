//! The names of the files of a repair.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use rapid_system::folder::{Folder, Links, Missing};

use super::super::partial::{PARTIAL, publish};
use crate::notes;

/// Names tried when others are taken.
const ATTEMPTS: u32 = 100;

/// The names around one file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Names {
    /// The file was being written.
    pub(super) is_partial: bool,
    /// The repaired file.
    pub(super) finished: PathBuf,
    /// The repaired file while it is written.
    pub(super) recovering: PathBuf,
    /// The stem of other names for the repaired file.
    base: PathBuf,
}

impl Names {
    pub(super) fn for_path(path: &Path) -> Self {
        let name = path.file_name().unwrap_or_default();
        // Names need not be UTF-8.
        let partial = name.as_bytes().strip_suffix(PARTIAL.as_bytes()).and_then(|name| name.strip_suffix(b"."));
        let partial = partial.map(OsStr::from_bytes).filter(|name| is_mcap(name));
        let (base, finished) = match partial.map(|name| path.with_file_name(name)) {
            Some(finished) => (finished.clone(), finished),
            None => (path.to_owned(), beside(path, 1)),
        };
        let recovering = with_ending(&finished, ".recovering");
        Self { is_partial: partial.is_some(), finished, recovering, base }
    }

    /// Gives `file` the first of its [`Self::candidates`] that is free; returns it.
    pub(super) fn publish(&self, file: &Path) -> io::Result<PathBuf> {
        let to = first_free(file, self.candidates(), "no free name for the whole file")?;
        self.copy_notes(&to);
        Ok(to)
    }

    /// What people noted about the episode is about the repaired one too.
    fn copy_notes(&self, to: &Path) {
        let folder = to.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let folder = match Folder::open(folder, Links::Own, Missing::Refused) {
            Ok(folder) => folder,
            Err(error) => return tracing::warn!(%error, "labels and notes are not copied"),
        };
        if let Err(error) = notes::copy(&folder, &self.base, to) {
            tracing::warn!(file = %to.display(), %error, "labels and notes are not copied");
        }
    }

    /// Names for the whole file, the best first. The finished name of a `.partial` can only be
    /// taken by another program's file.
    pub(super) fn candidates(&self) -> impl Iterator<Item = PathBuf> {
        let first = self.is_partial.then(|| self.finished.clone());
        first.into_iter().chain((1..ATTEMPTS).map(|number| beside(&self.base, number)))
    }
}

fn is_mcap(name: &OsStr) -> bool {
    Path::new(name).extension().is_some_and(|extension| extension == "mcap")
}

/// `x.mcap` becomes `x.recovered.mcap`, and with a number above one `x.recovered-2.mcap`.
fn beside(path: &Path, number: u32) -> PathBuf {
    let is_mcap = path.extension().is_some_and(|extension| extension == "mcap");
    let mut name = if is_mcap { path.file_stem() } else { path.file_name() }.unwrap_or_default().to_owned();
    name.push(".recovered");
    if number > 1 {
        name.push(format!("-{number}"));
    }
    name.push(".mcap");
    path.with_file_name(name)
}

fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut name: OsString = path.file_name().unwrap_or_default().to_owned();
    name.push(ending);
    path.with_file_name(name)
}

/// Creates the file that a repair writes, in place of one that an interrupted repair left. The caller must hold the
/// lock of the original.
pub(super) fn create(recovering: &Path) -> io::Result<File> {
    match fs::remove_file(recovering) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        // Never an existing file: it may have another name elsewhere.
        _ => File::create_new(recovering),
    }
}

/// Renames `path` to its finished name and `.ending`, or `.ending-2` and so on: returns the name.
pub(super) fn set_aside(path: &Path, finished: &Path, ending: &str) -> io::Result<PathBuf> {
    let ending = |number| if number == 1 { format!(".{ending}") } else { format!(".{ending}-{number}") };
    let names = (1..ATTEMPTS).map(|number| with_ending(finished, &ending(number)));
    first_free(path, names, "no free name to set it aside")
}

/// Gives `file` the first of `names` that is free; returns it.
fn first_free(file: &Path, names: impl Iterator<Item = PathBuf>, none: &str) -> io::Result<PathBuf> {
    for to in names {
        match publish(file, &to) {
            Ok(()) => return Ok(to),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
    Err(io::Error::new(io::ErrorKind::AlreadyExists, none))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repaired_files_get_names_beside_the_original() {
        let names = Names::for_path(Path::new("out/20261121_t_003.mcap.partial"));
        assert!(names.is_partial);
        assert_eq!(names.finished, Path::new("out/20261121_t_003.mcap"));
        assert_eq!(names.recovering, Path::new("out/20261121_t_003.mcap.recovering"));
        let candidates: Vec<_> = names.candidates().take(3).collect();
        assert_eq!(
            candidates[1..],
            ["out/20261121_t_003.recovered.mcap", "out/20261121_t_003.recovered-2.mcap"].map(PathBuf::from)
        );
        for (file, first, second) in [
            ("a.mcap", "a.recovered.mcap", "a.recovered-2.mcap"),
            ("a.b.mcap", "a.b.recovered.mcap", "a.b.recovered-2.mcap"),
            ("a.partial", "a.partial.recovered.mcap", "a.partial.recovered-2.mcap"),
        ] {
            let names = Names::for_path(Path::new(file));
            assert!(!names.is_partial);
            assert_eq!(names.finished, Path::new(first));
            let candidates: Vec<_> = names.candidates().take(2).collect();
            assert_eq!(candidates, [first, second].map(PathBuf::from), "{file}");
        }
    }
}
