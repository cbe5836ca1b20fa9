//! `rapid recover`: repairs files and folders, and says of each what is there and what is lost.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;
use serde_json::json;

use super::Format;
use crate::record::recover::{RecoverError, Recovered, Watch, finished, is_damaged, left_behind, recover};
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
/// A reader that has gone is no reason to leave a file unrepaired: beside the outcome, whether all that
/// was to be said could be written to `out`.
pub fn run(
    paths: &[PathBuf],
    format: Format,
    progress: bool,
    stop: &AtomicBool,
    out: &mut impl Write,
    err: &mut impl Write,
) -> (Outcome, io::Result<()>) {
    let mut teller = Teller { outcome: Outcome::default(), format, out, written: Ok(()), err };
    for path in paths {
        let work = match Work::of(path) {
            Ok(work) => work,
            Err(source) => {
                teller.failed(path, &RecoverError::Io { path: path.clone(), source });
                continue;
            }
        };
        let is_idle = work.unfinished.is_empty();
        for file in work.unfinished {
            match teller.watched(&file, progress, stop, recover) {
                Ok(recovered) => teller.done(&recovered),
                Err(error) => teller.failed(&file, &error),
            }
        }
        let mut is_sound = true;
        for file in work.finished {
            let damaged = teller.watched(&file, progress, stop, is_damaged);
            is_sound &= matches!(damaged, Ok(false));
            match damaged {
                Ok(false) => {}
                Ok(true) => teller.damaged(&file),
                Err(error) => teller.failed(&file, &error),
            }
        }
        if is_idle && is_sound && format == Format::Text {
            teller.line(&format!("{}: nothing to repair", path.display()));
        }
    }
    teller.end()
}

/// What of a path is to be repaired, and of a folder what is only looked at: a finished file is repaired where it is
/// named itself.
struct Work {
    unfinished: Vec<PathBuf>,
    finished: Vec<PathBuf>,
}

impl Work {
    fn of(path: &Path) -> io::Result<Self> {
        if !path.is_dir() {
            return Ok(Self { unfinished: vec![path.to_owned()], finished: Vec::new() });
        }
        // Before anything is repaired: what that makes is whole.
        Ok(Self { unfinished: left_behind(path)?, finished: finished(path)? })
    }
}

/// What is said of each file, and how it went so far.
struct Teller<'a, O, E> {
    outcome: Outcome,
    format: Format,
    out: &'a mut O,
    /// The first error of `out`: nothing more is written to it.
    written: io::Result<()>,
    err: &'a mut E,
}

impl<O: Write, E: Write> Teller<'_, O, E> {
    /// Does `work` on a file, with its progress shown if that is wanted, until `stop` interrupts it.
    fn watched<T>(
        &mut self,
        file: &Path,
        progress: bool,
        stop: &AtomicBool,
        work: fn(&Path, &mut Watch<'_>) -> Result<T, RecoverError>,
    ) -> Result<T, RecoverError> {
        if stop.load(Ordering::Relaxed) {
            return Err(RecoverError::Interrupted(file.to_owned()));
        }
        let mut bar = Progress { file, shown: None };
        let mut watch = |done, size| {
            if progress {
                bar.show(done, size, self.err);
            }
            if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let done = work(file, &mut watch);
        bar.clear(self.err);
        done
    }

    /// A finished file that is damaged: it stays as it is unless it is named itself.
    fn damaged(&mut self, file: &Path) {
        let name = file.display();
        match self.format {
            Format::Json => self.json(&json!({"file": file.to_string_lossy(), "outcome": "damaged"})),
            Format::Text => self.line(&text::plain(&format!(
                "{name}: damaged; `rapid recover {name}` makes a whole file of what can be read of it"
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
        match text::json(value) {
            Ok(line) => self.line(&line),
            Err(error) => self.written = Err(error.into()),
        }
    }

    fn line(&mut self, line: &str) {
        if self.written.is_ok() {
            self.written = writeln!(self.out, "{line}");
        }
    }

    fn end(self) -> (Outcome, io::Result<()>) {
        let Self { outcome, out, written, .. } = self;
        (outcome, written.and_then(|()| out.flush()))
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    struct Gone;

    impl Write for Gone {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_finished_file_that_is_damaged_is_named_with_what_to_do() {
        let bytes = crate::episode_format::testing::episode(crate::episode_format::testing::options());
        let whole = crate::record::recover::recover_bytes(&bytes).expect("an episode");
        // The check value of the summary, before the magic number: every message can still be read.
        let mut flipped = whole.clone();
        flipped[whole.len() - 10] ^= 1;
        for (what, bytes, is_named) in
            [("whole", &whole[..], false), ("flipped", &flipped, true), ("cut", &whole[..whole.len() - 4], true)]
        {
            let folder = tempfile::tempdir().expect("a folder");
            let file = folder.path().join("a_001.mcap");
            std::fs::write(&file, bytes).expect("a file");
            let said = |path: &Path, format| {
                let (mut out, mut err) = (Vec::new(), Vec::new());
                let (outcome, _) = run(&[path.to_owned()], format, false, &AtomicBool::new(false), &mut out, &mut err);
                let err = String::from_utf8_lossy(&err);
                assert!(outcome.is_done() && err.is_empty(), "{what}: {outcome:?} {err}");
                String::from_utf8(out).expect("text")
            };
            let text = said(folder.path(), Format::Text);
            let command = format!("`rapid recover {}`", file.display());
            assert_eq!((text.contains(&command), text.contains("nothing to repair")), (is_named, !is_named), "{text}");
            assert_eq!(said(folder.path(), Format::Json).contains("\"damaged\""), is_named, "{what}");
            assert_eq!(std::fs::read(&file).expect("the file"), bytes, "{what}");
            // Once that is done there is nothing left to do.
            said(&file, Format::Text);
            assert!(said(folder.path(), Format::Text).contains("nothing to repair"), "{what}");
        }
    }

    #[test]
    fn a_reader_that_has_gone_leaves_no_file_unrepaired() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = |name: &str| folder.path().join(name);
        for name in ["a_001.mcap.partial", "b_001.mcap.partial", "c_001.mcap.partial"] {
            std::fs::write(file(name), "").expect("a file");
        }
        let paths = [file("none.mcap"), folder.path().to_owned()];
        let (stop, mut err) = (AtomicBool::new(false), Vec::new());
        for format in [Format::Text, Format::Json] {
            let (outcome, written) = run(&paths, format, false, &stop, &mut Gone, &mut err);
            assert!(outcome.is_bad_argument(), "{outcome:?}");
            assert_eq!(written.expect_err("nobody reads").kind(), io::ErrorKind::BrokenPipe);
            assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0);
        }
    }
}
