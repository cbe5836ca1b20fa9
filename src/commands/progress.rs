//! Long-running work: a progress line on standard error, and many episodes judged in parallel, on all processors.
//!
//! Every file is read completely, regardless of its recorded summary, so later changes are found.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use rapid_core::text;

const UNITS: &str = "{prefix} {bar:20} {pos}/{len}{rate}{left}";
const BYTES: &str = "{prefix} {bar:20} {done}{left}";
const EVERY: Duration = Duration::from_millis(100);
/// How soon a worker notices that there is room for its result.
const WAIT: Duration = Duration::from_millis(5);

/// `label ██████·········· 12/72  8.6/s  00:07 left` on standard error, redrawn in place and erased when it is dropped.
///
/// Only on a terminal that can redraw a line: one with a `TERM` that is not `dumb`.
#[derive(Debug)]
pub struct Bar(ProgressBar);

impl Bar {
    /// A line for `total` units of work, if `wanted`.
    pub fn new(label: &'static str, total: usize, wanted: bool) -> Self {
        Self::on(target(wanted), label.into(), UNITS, total as u64)
    }

    /// A line for bytes, if `wanted`: `label ██████·········· 1.0 MB of 3.2 MB  00:07 left`.
    pub fn of_bytes(label: String, wanted: bool) -> Self {
        Self::on(target(wanted), label.into(), BYTES, 0)
    }

    fn on(target: ProgressDrawTarget, label: Cow<'static, str>, template: &str, total: u64) -> Self {
        // The templates are constants, and a test draws them.
        let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
        let style = style.progress_chars("█·").with_key("done", done).with_key("rate", rate).with_key("left", left);
        Self(ProgressBar::with_draw_target(Some(total), target).with_style(style).with_prefix(label))
    }

    /// Reports that `done` units are done.
    pub fn at(&self, done: usize) {
        self.0.set_position(done as u64);
    }

    /// Reports that `done` of `total` are done.
    pub fn at_of(&self, done: u64, total: u64) {
        if self.0.length() != Some(total) {
            self.0.set_length(total);
        }
        self.0.set_position(done);
    }

    /// Does what writes to the same terminal, without the line.
    pub fn aside<T>(&self, write: impl FnOnce() -> T) -> T {
        self.0.suspend(write)
    }
}

fn target(wanted: bool) -> ProgressDrawTarget {
    if wanted { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() }
}

/// Bytes done, of how many.
fn done(state: &ProgressState, out: &mut dyn fmt::Write) {
    // Writing to the line that is drawn does not fail; here and below.
    let _ = write!(out, "{} of {}", text::size(state.pos()), text::size(state.len().unwrap_or_default()));
}

/// The rate, as soon as it is known.
fn rate(state: &ProgressState, out: &mut dyn fmt::Write) {
    let _ = match state.per_sec() {
        rate if rate >= 1.0 => write!(out, "  {rate:.1}/s"),
        rate if rate > 0.0 => write!(out, "  {:.1}/min", 60.0 * rate),
        _ => Ok(()),
    };
}

/// The time left, as soon as it is known.
fn left(state: &ProgressState, out: &mut dyn fmt::Write) {
    if state.per_sec() > 0.0 {
        let _ = write!(out, "  {} left", text::clock(state.eta()));
    }
}

/// Applies `read` to every file, on all processors, and passes the results to `take`: see [`Work::each`].
///
/// # Errors
/// The first of `take`.
pub(super) fn each<T: Send, E>(
    files: &[PathBuf],
    read: impl Fn(&Path) -> T + Sync,
    mut take: impl FnMut(&Path, T) -> Result<(), E>,
) -> Result<(), E> {
    let workers = thread::available_parallelism().map_or(1, usize::from);
    let work = Work { label: "episodes", workers, total: files.len(), done: None };
    work.each(files, |file| read(file), |file, result| take(file, result))
}

/// Work on many items in parallel.
#[derive(Debug)]
pub(super) struct Work<'a> {
    /// What the line begins with.
    pub(super) label: &'static str,
    /// How many items are worked on at a time.
    pub(super) workers: usize,
    /// Units of work.
    pub(super) total: usize,
    /// The units done so far; `None` where an item is one.
    pub(super) done: Option<&'a AtomicUsize>,
}

impl Work<'_> {
    /// Applies `read` to every item and passes the results to `take`, in the order of the items, each as soon as
    /// possible. No more results wait than there are workers, twice. On a terminal a line on standard error shows the
    /// progress.
    ///
    /// # Errors
    /// The first of `take`; the remaining items are then not read.
    pub(super) fn each<I: Sync, T: Send, E>(
        self,
        items: &[I],
        read: impl Fn(&I) -> T + Sync,
        mut take: impl FnMut(&I, T) -> Result<(), E>,
    ) -> Result<(), E> {
        let workers = self.workers.clamp(1, items.len().max(1));
        let bar = Bar::new(self.label, self.total, self.total > 1);
        let (next, taken, ended) = (AtomicUsize::new(0), AtomicUsize::new(0), AtomicBool::new(false));
        thread::scope(|scope| {
            let (done, results) = mpsc::sync_channel(2 * workers);
            for _ in 0..workers {
                let (done, next, taken, ended, read) = (done.clone(), &next, &taken, &ended, &read);
                scope.spawn(move || {
                    loop {
                        let index = next.fetch_add(1, Ordering::Relaxed);
                        let Some(item) = items.get(index) else { break };
                        // One that takes long keeps back the results of those after it.
                        while index >= taken.load(Ordering::Relaxed) + 2 * workers && !ended.load(Ordering::Relaxed) {
                            thread::sleep(WAIT);
                        }
                        // After an error the receiver is dropped.
                        if ended.load(Ordering::Relaxed) || done.send((index, read(item))).is_err() {
                            break;
                        }
                    }
                });
            }
            drop(done);
            let mut early = BTreeMap::new();
            let mut index = 0;
            let units = |index| self.done.map_or(index, |done| done.load(Ordering::Relaxed));
            let outcome = loop {
                match results.recv_timeout(EVERY) {
                    Ok((done, result)) => early.insert(done, result),
                    Err(RecvTimeoutError::Timeout) => None,
                    Err(RecvTimeoutError::Disconnected) => break Ok(()),
                };
                let mut outcome = Ok(());
                while let (Ok(()), Some((item, result))) = (&outcome, items.get(index).zip(early.remove(&index))) {
                    index += 1;
                    outcome = bar.aside(|| take(item, result));
                    taken.store(index, Ordering::Relaxed);
                }
                if outcome.is_err() {
                    break outcome;
                }
                bar.at(units(index));
            };
            ended.store(true, Ordering::Relaxed);
            outcome
        })
    }
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::sync::{Arc, Mutex};

    use indicatif::TermLike;

    use super::*;

    /// The last line that was drawn.
    #[derive(Debug, Clone, Default)]
    struct Screen(Arc<Mutex<String>>);

    impl Screen {
        fn line(&self) -> String {
            self.0.lock().unwrap().trim_end().to_owned()
        }
    }

    impl TermLike for Screen {
        fn width(&self) -> u16 {
            80
        }

        fn move_cursor_up(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_down(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_right(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_left(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn write_line(&self, text: &str) -> io::Result<()> {
            self.write_str(text)
        }

        fn write_str(&self, text: &str) -> io::Result<()> {
            self.0.lock().unwrap().push_str(text);
            Ok(())
        }

        fn clear_line(&self) -> io::Result<()> {
            self.0.lock().unwrap().clear();
            Ok(())
        }

        fn flush(&self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn the_line_shows_progress_and_is_erased() {
        let screen = Screen::default();
        let target = || ProgressDrawTarget::term_like(Box::new(screen.clone()));
        let bar = Bar::on(target(), "trials".into(), UNITS, 4);
        bar.at(0);
        assert_eq!(screen.line(), "trials ···················· 0/4");
        bar.at(1);
        let line = screen.line();
        assert!(line.starts_with("trials █████··············· 1/4  ") && line.ends_with(" left"), "{line}");
        assert_eq!(bar.aside(|| screen.line()), "");
        assert!(screen.line().starts_with("trials █████··············· 1/4"), "{}", screen.line());
        bar.at(4);
        assert!(screen.line().starts_with("trials ████████████████████ 4/4"), "{}", screen.line());
        drop(bar);
        assert_eq!(screen.line(), "");
        let bar = Bar::on(target(), "a.mcap".into(), BYTES, 0);
        bar.at_of(1_000_000, 4_000_000);
        let line = screen.line();
        assert!(line.starts_with("a.mcap █████··············· 1.0 MB of 4.0 MB"), "{line}");
    }

    #[test]
    fn results_follow_the_order_of_the_files_until_an_error() {
        let files: Vec<PathBuf> = (0..500).map(|number| PathBuf::from(number.to_string())).collect();
        let number = |file: &Path| file.to_str().unwrap().parse::<usize>().unwrap();
        let mut taken = Vec::new();
        each(&files, number, |file, read| {
            assert_eq!(file, files[read]);
            taken.push(read);
            Ok::<_, ()>(())
        })
        .unwrap();
        assert_eq!(taken, (0..500).collect::<Vec<_>>());
        let stopped = each(&files, number, |_, read| if read == 7 { Err(read) } else { Ok(()) });
        assert_eq!(stopped, Err(7));
        assert_eq!(each(&[], number, |_, read| Err(read)), Ok(()));
    }
}
