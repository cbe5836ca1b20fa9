//! Long-running work: a progress line on standard error, and many episodes judged in parallel, on all processors.
//!
//! Every file is read completely, regardless of its recorded summary, so later changes are found.

use std::collections::BTreeMap;
use std::io::{IsTerminal, Write, stderr};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use crate::text;

const EVERY: Duration = Duration::from_millis(100);
/// How soon a worker notices that there is room for its result.
const WAIT: Duration = Duration::from_millis(5);
const BLOCKS: usize = 20;

/// `label ██████·········· 12/72  0:07 left`, redrawn in place; only on a terminal.
#[derive(Debug)]
pub struct Bar {
    label: &'static str,
    total: usize,
    begun: Instant,
    drawn: Option<Instant>,
    shown: bool,
}

impl Bar {
    /// A line for `total` units of work, if `wanted` and standard error is a terminal.
    pub fn new(label: &'static str, total: usize, wanted: bool) -> Self {
        Self { label, total, begun: Instant::now(), drawn: None, shown: wanted && stderr().is_terminal() }
    }

    /// Reports that `done` units are done.
    pub fn at(&mut self, done: usize) {
        if !self.shown || self.drawn.is_some_and(|drawn| drawn.elapsed() < EVERY) {
            return;
        }
        self.drawn = Some(Instant::now());
        let _ = write!(stderr(), "\r\x1b[2K{}", line(self.label, done, self.total, self.begun.elapsed()));
        let _ = stderr().flush();
    }

    /// Clears the line.
    pub fn clear(&mut self) {
        if self.drawn.take().is_some() {
            let _ = write!(stderr(), "\r\x1b[2K");
        }
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.clear();
    }
}

fn line(label: &str, done: usize, total: usize, elapsed: Duration) -> String {
    let full = (BLOCKS * done).checked_div(total).unwrap_or(BLOCKS).min(BLOCKS);
    let bar = "█".repeat(full) + &"·".repeat(BLOCKS - full);
    let left = (done > 0).then(|| elapsed.mul_f64((total.saturating_sub(done)) as f64 / done as f64));
    let left = left.map(|left| format!("  {} left", text::clock(left))).unwrap_or_default();
    format!("{label} {bar} {done}/{total}{left}")
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
        let mut bar = Bar::new(self.label, self.total, self.total > 1);
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
                    bar.clear();
                    outcome = take(item, result);
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
    use super::*;

    #[test]
    fn the_line_shows_progress_and_time_left() {
        let bar = |done, total| line("trials", done, total, Duration::from_secs(30));
        assert_eq!(bar(0, 4), "trials ···················· 0/4");
        assert_eq!(bar(1, 4), "trials █████··············· 1/4  01:30 left");
        assert_eq!(bar(4, 4), "trials ████████████████████ 4/4  00:00 left");
        assert_eq!(bar(0, 0), "trials ████████████████████ 0/0");
    }
}

#[cfg(test)]
mod episodes_tests {
    use super::*;

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
