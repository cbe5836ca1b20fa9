//! Files with mistakes, each with its expected message in `NAME.expected`.

use std::path::{Path, PathBuf};

use rapid_registry::Diagnostic;

/// The files of a folder of `tests/` with this extension, by name.
pub(crate) fn files(folder: &str, extension: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(folder);
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|found| found == extension))
        .collect();
    files.sort();
    files
}

/// The text of a file; panics with its name if there is none.
pub(crate) fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Checks that each file of `folder` is refused with exactly the text beside it, and that each problem has a fix and no
/// control characters. There must be at least `count` files, so that a lost one is noticed. `refused` returns the
/// message for a text and its problems; `None` if it is accepted.
pub(crate) fn check(
    folder: &str,
    extension: &str,
    count: usize,
    refused: impl Fn(&str) -> Option<(String, Vec<Diagnostic>)>,
) {
    let mistakes = files(folder, extension);
    assert!(mistakes.len() >= count, "{} files of {count}", mistakes.len());
    for expected in files(folder, "expected") {
        assert!(expected.with_extension(extension).exists(), "{} is of no file", expected.display());
    }
    for path in mistakes {
        let (printed, problems) = refused(&read(&path)).unwrap_or_else(|| panic!("{} is accepted", path.display()));
        assert_eq!(format!("{printed}\n"), read(&path.with_extension("expected")), "{}", path.display());
        for problem in &problems {
            assert!(problem.fix.as_ref().is_some_and(|fix| !fix.is_empty()), "{problem}");
            assert!(!problem.to_string().chars().any(|c| c.is_control() && c != '\n'), "{problem:?}");
        }
    }
}
