//! `rapid recover`: repairs files and folders, and reports what was kept and lost of each.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use rapid_core::text;
use rapid_episode::recover::{ProgressFn, RecoverError, Recovered, finished, is_damaged, left_behind, recover};
use serde::Serialize;
use serde_json::json;

use super::progress::Bar;
use super::{Format, json_line};

/// The outcome of all files together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FailureCounts {
    failed: usize,
    bad_arguments: usize,
}

impl FailureCounts {
    /// Whether everything that can be repaired was.
    pub const fn is_done(self) -> bool {
        self.failed == 0 && self.bad_arguments == 0
    }

    /// Whether some argument was not an episode, and nothing worse happened.
    pub const fn is_bad_argument(self) -> bool {
        self.failed == 0 && self.bad_arguments > 0
    }
}

/// Repairs every file of `paths` and every unfinished one of a folder among them. Results go to `out`, errors
/// to `err`; the progress of text is a line on standard error. `stop` interrupts the current file and skips the rest.
///
/// A closed output leaves no file unrepaired, so its error is returned separately from the outcome.
pub fn run(
    paths: &[PathBuf],
    format: Format,
    stop: &AtomicBool,
    out: &mut impl Write,
    err: &mut impl Write,
) -> (FailureCounts, io::Result<()>) {
    let mut report = Report { outcome: FailureCounts::default(), format, out, written: Ok(()), err };
    for path in paths {
        let (unfinished, finished) = match work_of(path) {
            Ok(work) => work,
            Err(source) => {
                report.failed(path, &RecoverError::Io { path: path.clone(), source });
                continue;
            }
        };
        let is_idle = unfinished.is_empty();
        for file in unfinished {
            match report.with_progress(&file, stop, recover) {
                Ok(recovered) => report.done(&recovered),
                Err(error) => report.failed(&file, &error),
            }
        }
        let mut is_sound = true;
        for file in finished {
            let damaged = report.with_progress(&file, stop, is_damaged);
            is_sound &= matches!(damaged, Ok(false));
            match damaged {
                Ok(false) => {}
                Ok(true) => report.damaged(&file),
                Err(error) => report.failed(&file, &error),
            }
        }
        if is_idle && is_sound {
            report.nothing(path);
        }
    }
    report.end()
}

/// The files of a path to repair, and those only to check: a finished file is repaired only if it is named explicitly.
fn work_of(path: &Path) -> io::Result<(Vec<PathBuf>, Vec<PathBuf>)> {
    // Listed before anything is repaired: repaired files need no check.
    if path.is_dir() { Ok((left_behind(path)?, finished(path)?)) } else { Ok((vec![path.to_owned()], Vec::new())) }
}

/// Writes a line per file, and keeps the outcome so far.
struct Report<'a, O, E> {
    outcome: FailureCounts,
    format: Format,
    out: &'a mut O,
    /// The first error of `out`, after which nothing more is written to it.
    written: io::Result<()>,
    err: &'a mut E,
}

impl<O: Write, E: Write> Report<'_, O, E> {
    /// Applies `work` to a file, showing its progress, until `stop` interrupts it.
    fn with_progress<T>(
        &mut self,
        file: &Path,
        stop: &AtomicBool,
        work: fn(&Path, &mut ProgressFn<'_>) -> Result<T, RecoverError>,
    ) -> Result<T, RecoverError> {
        if stop.load(Ordering::Relaxed) {
            return Err(RecoverError::Interrupted(file.to_owned()));
        }
        let bar = Bar::of_bytes(text::plain(&file.display().to_string()).into_owned(), self.format == Format::Text);
        let mut watch = |done, size| {
            bar.at_of(done, size);
            if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        work(file, &mut watch)
    }

    /// Reports that nothing of this path needs a repair.
    fn nothing(&mut self, path: &Path) {
        match self.format {
            Format::Json => self.json(&json!({"file": path.to_string_lossy(), "outcome": "nothing"})),
            Format::Text => self.line(&text::plain(&format!("{}: nothing to repair", path.display()))),
        }
    }

    /// Reports a damaged finished file: it is not changed unless it is named explicitly.
    fn damaged(&mut self, file: &Path) {
        let name = file.display();
        match self.format {
            Format::Json => self.json(&json!({"file": file.to_string_lossy(), "outcome": "damaged"})),
            Format::Text => self.line(&text::plain(&format!(
                "{name}: damaged; `rapid recover {name}` saves its readable data to a new file"
            ))),
        }
    }

    fn done(&mut self, recovered: &Recovered) {
        match self.format {
            Format::Json => self.json(recovered),
            Format::Text => self.line(&text::plain(&recovered.sentence().1)),
        }
    }

    fn failed(&mut self, file: &Path, error: &RecoverError) {
        match error {
            error if error.is_bad_argument() => self.outcome.bad_arguments += 1,
            _ => self.outcome.failed += 1,
        }
        if self.format == Format::Json {
            self.json(&json!({"file": file.to_string_lossy(), "outcome": "failed", "error": error.to_string()}));
        }
        // Standard error may be closed.
        let _ = writeln!(self.err, "error: {}", text::plain(&error.to_string()));
    }

    fn json(&mut self, value: &impl Serialize) {
        match json_line("repair", value) {
            Ok(line) => self.line(&line),
            Err(error) => self.written = Err(error),
        }
    }

    fn line(&mut self, line: &str) {
        if self.written.is_ok() {
            self.written = writeln!(self.out, "{line}");
        }
    }

    fn end(self) -> (FailureCounts, io::Result<()>) {
        let Self { outcome, out, written, .. } = self;
        (outcome, written.and_then(|()| out.flush()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Closed;

    impl Write for Closed {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_damaged_finished_file_is_reported_with_the_fix() {
        let bytes = crate::recorded::episode(crate::recorded::options());
        let whole = rapid_episode::recover::recover_bytes(&bytes).expect("an episode");
        // The check value of the summary, before the magic number: every message is still readable.
        let mut flipped = whole.clone();
        flipped[whole.len() - 10] ^= 1;
        for (what, bytes, is_named) in
            [("whole", &whole[..], false), ("flipped", &flipped, true), ("cut", &whole[..whole.len() - 4], true)]
        {
            let folder = tempfile::tempdir().expect("a folder");
            let file = folder.path().join("a_001.mcap");
            std::fs::write(&file, bytes).expect("a file");
            let reported = |path: &Path, format| {
                let (mut out, mut err) = (Vec::new(), Vec::new());
                let (outcome, _) = run(&[path.to_owned()], format, &AtomicBool::new(false), &mut out, &mut err);
                let err = String::from_utf8_lossy(&err);
                assert!(outcome.is_done() && err.is_empty(), "{what}: {outcome:?} {err}");
                String::from_utf8(out).expect("text")
            };
            let text = reported(folder.path(), Format::Text);
            let command = format!("`rapid recover {}`", file.display());
            assert_eq!((text.contains(&command), text.contains("nothing to repair")), (is_named, !is_named), "{text}");
            assert_eq!(reported(folder.path(), Format::Json).contains("\"damaged\""), is_named, "{what}");
            assert_eq!(std::fs::read(&file).expect("the file"), bytes, "{what}");
            // After the repair there is nothing left to repair.
            reported(&file, Format::Text);
            assert!(reported(folder.path(), Format::Text).contains("nothing to repair"), "{what}");
        }
    }

    #[test]
    fn a_closed_output_leaves_no_file_unrepaired() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = |name: &str| folder.path().join(name);
        for name in ["a_001.mcap.partial", "b_001.mcap.partial", "c_001.mcap.partial"] {
            std::fs::write(file(name), "").expect("a file");
        }
        let paths = [file("none.mcap"), folder.path().to_owned()];
        let (stop, mut err) = (AtomicBool::new(false), Vec::new());
        for format in [Format::Text, Format::Json] {
            let (outcome, written) = run(&paths, format, &stop, &mut Closed, &mut err);
            assert!(outcome.is_bad_argument(), "{outcome:?}");
            assert_eq!(written.expect_err("closed").kind(), io::ErrorKind::BrokenPipe);
            assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0);
        }
    }
}
