//! The unfinished episodes of a folder, and their repair in the background.
//!
//! Invariant: nothing waits for a repair in the background. It works at most half of the time and leaves enough disk
//! space that an episode being recorded is neither closed nor warned about.

use std::fs::{self, DirEntry, File};
use std::io;
use std::ops::ControlFlow;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver};
use std::time::{Duration, Instant, SystemTime};

use rapid_core::text;
use rapid_status::{Board, EventKind, Level};
use rapid_system::disk::Disk;
use rustix::process::setpriority_process;

use super::{LockedFile, Names, ProgressFn, RecoverError, Recovered, RepairOutcome, recover};
use crate::Failed;

/// How soon a repair in the background notices that it is to end.
const NOTICE: Duration = Duration::from_millis(20);
/// How long the end of a run waits for it: it may be in the middle of writing to the disk.
const PATIENCE: Duration = Duration::from_millis(500);
/// Lower priority than everything else on this machine.
const NICE: i32 = 15;

/// The episodes of `folder` that were not finished, by name.
///
/// # Errors
/// When the folder cannot be read.
pub fn left_behind(folder: &Path) -> io::Result<Vec<PathBuf>> {
    Ok(entries(folder, b".mcap.partial")?.into_iter().map(|entry| entry.path()).collect())
}

/// The finished files of `folder`, by name.
///
/// # Errors
/// When the folder cannot be read.
pub fn finished(folder: &Path) -> io::Result<Vec<PathBuf>> {
    Ok(entries(folder, b".mcap")?.into_iter().map(|entry| entry.path()).collect())
}

/// Is this finished file damaged and not yet repaired? Nothing is written.
///
/// # Errors
/// When it cannot be read, or `watch` ends it.
pub fn is_damaged(path: &Path, watch: &mut ProgressFn<'_>) -> Result<bool, RecoverError> {
    let (file, size) = crate::open(path)?;
    let failed = Failed::read(&file, size).map_err(|source| super::io_of(path, source))?;
    let source = LockedFile { path, file, size, failed };
    let Some(known) = source.read(watch)? else { return Ok(false) };
    if source.failed.is_none() && known.is_whole() {
        return Ok(false);
    }
    let sha256 = source.sha256(watch)?;
    Ok(source.repaired(&Names::for_path(path), &sha256, watch)?.is_none())
}

fn entries(folder: &Path, ending: &[u8]) -> io::Result<Vec<DirEntry>> {
    let mut entries: Vec<DirEntry> = fs::read_dir(folder)?.collect::<Result<_, _>>()?;
    entries.retain(|entry| {
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        is_file && entry.file_name().as_bytes().ends_with(ending)
    });
    entries.sort_by_key(DirEntry::file_name);
    Ok(entries)
}

/// The repair of a folder, in a thread of its own. Dropping it interrupts the repair.
#[derive(Debug)]
pub struct Repairs {
    stop: Arc<AtomicBool>,
    ended: Receiver<()>,
}

impl Repairs {
    /// Repairs what an earlier run left unfinished in `folder`, and reports it on `board`; `reserve` is the
    /// registry's `disk_reserve`. Then, unless it was interrupted, the thread does what is to follow.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(
        folder: PathBuf,
        reserve: Option<u64>,
        board: Arc<Board>,
        then: impl FnOnce() + Send + 'static,
    ) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (notify, ended) = mpsc::channel();
        let asked = Arc::clone(&stop);
        let begun = SystemTime::now();
        std::thread::Builder::new().name("recover".to_owned()).spawn(move || {
            repair_all(&folder, reserve, begun, &board, &asked);
            // The waiting task may have ended.
            let _ = notify.send(());
            if !asked.load(Ordering::Relaxed) {
                then();
            }
        })?;
        Ok(Self { stop, ended })
    }
}

impl Drop for Repairs {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // It can be ended at any moment.
        let _ = self.ended.recv_timeout(PATIENCE);
    }
}

fn repair_all(folder: &Path, reserve: Option<u64>, begun: SystemTime, board: &Board, stop: &AtomicBool) {
    // Of this thread alone; if refused, it runs at normal priority.
    let _ = setpriority_process(None, NICE);
    let log = |level, text| board.announce(EventKind::Log { level, text });
    let entries = match entries(folder, b".mcap.partial") {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return,
        Err(error) => return log(Level::Warn, format!("{}: {error}; nothing in it is repaired", folder.display())),
    };
    for entry in entries {
        // Newer files are ours, or are handled by the next start.
        let metadata = entry.metadata();
        let is_new = metadata.as_ref().is_ok_and(|metadata| metadata.created().is_ok_and(|made| made >= begun));
        if is_new || stop.load(Ordering::Relaxed) {
            continue;
        }
        let path = entry.path();
        let size = metadata.map_or(0, |metadata| metadata.len());
        let room = |size| {
            let disk = File::open(folder).and_then(|folder| Disk::of_file(&folder)).ok()?;
            disk.lacks_room_beside_an_episode(size, reserve).then_some(disk.free)
        };
        let refused = |free| {
            let (size, free) = (text::size(size), text::size(free));
            let why = format!("it takes {size} and {free} are free; make room and run `rapid recover`");
            log(Level::Warn, format!("{}: not repaired: {why}", path.display()));
        };
        if let Some(free) = room(size) {
            refused(free);
            continue;
        }
        let mut worked = Instant::now();
        let mut full = None;
        let mut watch = |done, size: u64| {
            rest(worked.elapsed(), stop);
            worked = Instant::now();
            // The episode being recorded takes disk space meanwhile.
            full = room(size.saturating_sub(done));
            if full.is_some() || stop.load(Ordering::Relaxed) {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        };
        match recover(&path, &mut watch) {
            Ok(recovered) => board.announce(event(recovered)),
            Err(RecoverError::Busy(_)) => {
                log(Level::Info, format!("{}: another rapid writes or repairs it; left alone", path.display()));
            }
            Err(RecoverError::Interrupted(_)) => full.into_iter().for_each(refused),
            Err(RecoverError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
            Err(error) => log(Level::Warn, format!("{error}; it stays as it is")),
        }
    }
}

/// Rests for as long as it worked.
fn rest(time: Duration, stop: &AtomicBool) {
    let end = Instant::now() + time;
    while let Some(left) = end.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
        if stop.load(Ordering::Relaxed) {
            return;
        }
        std::thread::sleep(left.min(NOTICE));
    }
}

fn event(recovered: Recovered) -> EventKind {
    let (level, text) = recovered.sentence();
    match recovered.outcome {
        RepairOutcome::Repaired(repaired) => EventKind::Recovered {
            file: repaired.to,
            seconds: repaired.seconds,
            messages: repaired.messages,
            unread_bytes: repaired.unread_bytes,
            damaged_chunks: repaired.damaged_chunks,
            text,
        },
        _ => EventKind::Log { level, text },
    }
}

#[cfg(test)]
mod tests;
