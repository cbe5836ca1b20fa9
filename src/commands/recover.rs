//! `rapid recover`: repairs files and folders, and says of each what is there and what is lost.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::json;

use super::Format;
use crate::record::recover::{RecoverError, left_behind, recover};
use crate::text;

/// How it went, of all files together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Outcome {
    failed: usize,
    bad_arguments: usize,
}

impl Outcome {
    /// Is everything whole that can be?
    #[must_use]
    pub const fn is_done(self) -> bool {
        self.failed == 0 && self.bad_arguments == 0
    }

    /// Was something named that is no episode, and nothing worse?
    #[must_use]
    pub const fn is_bad_argument(self) -> bool {
        self.failed == 0 && self.bad_arguments > 0
    }
}

/// Repairs every file of `paths` and every unfinished one of a folder among them; what became of them
/// goes to `out`, what failed and, if wanted, the progress to `err`. `stop` interrupts the file in work
/// and leaves out the rest.
///
/// # Errors
/// When `out` cannot be written.
pub fn run(
    paths: &[PathBuf],
    format: Format,
    progress: bool,
    stop: &AtomicBool,
    out: &mut impl Write,
    err: &mut impl Write,
) -> io::Result<Outcome> {
    let mut outcome = Outcome::default();
    for path in paths {
        let files = match unfinished(path) {
            Some(Ok(files)) if files.is_empty() => {
                if format == Format::Text {
                    writeln!(out, "{}: nothing to repair", path.display())?;
                }
                continue;
            }
            Some(Ok(files)) => files,
            Some(Err(source)) => {
                let error = RecoverError::Io { path: path.clone(), source };
                tell(&mut outcome, path, &error, format, out, err)?;
                continue;
            }
            None => vec![path.clone()],
        };
        for file in files {
            if stop.load(Ordering::Relaxed) {
                tell(&mut outcome, &file, &RecoverError::Interrupted(file.clone()), format, out, err)?;
                continue;
            }
            let mut bar = Progress { file: &file, shown: None };
            let mut watch = |done, size| {
                if progress {
                    bar.show(done, size, err);
                }
                if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            let recovered = recover(&file, &mut watch);
            bar.clear(err);
            match recovered {
                Ok(recovered) if format == Format::Json => {
                    serde_json::to_writer(&mut *out, &recovered)?;
                    writeln!(out)?;
                }
                Ok(recovered) => writeln!(out, "{}", text::plain(&recovered.sentence().1))?,
                Err(error) => tell(&mut outcome, &file, &error, format, out, err)?,
            }
        }
    }
    out.flush()?;
    Ok(outcome)
}

/// What of a folder is to be repaired; `None`: it is none.
fn unfinished(path: &Path) -> Option<io::Result<Vec<PathBuf>>> {
    path.is_dir().then(|| left_behind(path))
}

fn tell(
    outcome: &mut Outcome,
    file: &Path,
    error: &RecoverError,
    format: Format,
    out: &mut impl Write,
    err: &mut impl Write,
) -> io::Result<()> {
    match error {
        error if error.is_bad_argument() => outcome.bad_arguments += 1,
        _ => outcome.failed += 1,
    }
    if format == Format::Json {
        writeln!(out, "{}", json!({"file": file, "outcome": "failed", "error": error.to_string()}))?;
    }
    // Standard error may be closed.
    let _ = writeln!(err, "error: {}", text::plain(&error.to_string()));
    Ok(())
}

/// One line that is written over, whenever the percentage changes.
struct Progress<'a> {
    file: &'a Path,
    shown: Option<u64>,
}

impl Progress<'_> {
    fn show(&mut self, done: u64, size: u64, err: &mut impl Write) {
        let percent = u128::from(done) * 100 / u128::from(size.max(1));
        let percent = u64::try_from(percent).unwrap_or(100);
        if self.shown.replace(percent) != Some(percent) {
            let file = self.file.display().to_string();
            let _ = write!(err, "\r\x1b[K{}: {percent} % of {}", text::plain(&file), text::size(size));
            let _ = err.flush();
        }
    }

    fn clear(&mut self, err: &mut impl Write) {
        if self.shown.take().is_some() {
            let _ = write!(err, "\r\x1b[K");
            let _ = err.flush();
        }
    }
}
