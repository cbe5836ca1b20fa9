//! The `writeback` thread of an episode: syncs written data to the disk, so that a loss of power loses little.
//!
//! The writer requests a sync and continues: a slow disk is synced less often, and no sample waits for it.
//!
//! Invariant: an error of the disk reaches the writer, from [`Writeback::ask`] or [`Writeback::end`]:
//! the kernel reports each only once.

use std::fs::File;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{self, SyncSender, TrySendError};
use std::thread::JoinHandle;

use rapid_system::folder::Folder;

pub(super) struct Writeback {
    ask: SyncSender<()>,
    thread: JoinHandle<io::Result<()>>,
}

impl Writeback {
    /// Starts the thread for `file`, whose name is in `folder`; `None` if the system gives none.
    pub(super) fn start(file: Arc<File>, folder: &Folder) -> Option<Self> {
        let started = folder.descriptor().try_clone().and_then(|folder| {
            let mut folder = Some(folder);
            Self::with(move || {
                // Once, for the name; not every file system can be asked for that.
                if let Some(Err(error)) = folder.take().map(rustix::fs::fsync) {
                    tracing::debug!(%error, "folder not synced");
                }
                file.sync_data()
            })
        });
        started.map_err(|error| tracing::warn!(%error, "no writeback while recording")).ok()
    }

    fn with(mut sync: impl FnMut() -> io::Result<()> + Send + 'static) -> io::Result<Self> {
        let (ask, asked) = mpsc::sync_channel(1);
        let work = move || asked.iter().try_for_each(|()| sync());
        let thread = std::thread::Builder::new().name("writeback".to_owned()).spawn(work)?;
        Ok(Self { ask, thread })
    }

    /// Requests a sync of everything written so far; never waits. `None` once the disk has refused: [`Self::end`]
    /// returns the error.
    pub(super) fn ask(&self) -> Option<()> {
        match self.ask.try_send(()) {
            // It is busy, and will check again.
            Ok(()) | Err(TrySendError::Full(())) => Some(()),
            Err(TrySendError::Disconnected(())) => None,
        }
    }

    /// Ends the thread; waits for the current sync.
    ///
    /// # Errors
    /// When the disk has refused at any time.
    pub(super) fn end(self) -> io::Result<()> {
        drop(self.ask);
        self.thread.join().unwrap_or_else(|_| Err(io::Error::other("the writeback thread panicked")))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    #[test]
    fn a_blocked_disk_delays_no_caller() {
        let (keep_going, wait) = mpsc::channel::<()>();
        let (begun, begins) = mpsc::channel();
        let synced = Arc::new(AtomicU32::new(0));
        let counted = Arc::clone(&synced);
        let writeback = Writeback::with(move || {
            begun.send(()).unwrap();
            wait.recv().unwrap();
            counted.fetch_add(1, Ordering::Relaxed);
            Ok(())
        });
        let writeback = writeback.unwrap();
        assert!(writeback.ask().is_some());
        begins.recv().unwrap();
        for _ in 0..1000 {
            assert!(writeback.ask().is_some());
        }
        for _ in 0..2 {
            keep_going.send(()).unwrap();
        }
        writeback.end().unwrap();
        // Once for what was asked first, once for all that came meanwhile.
        assert_eq!(synced.load(Ordering::Relaxed), 2);
    }

    #[test]
    fn errors_of_the_disk_are_reported() {
        let writeback = Writeback::with(|| Err(io::ErrorKind::StorageFull.into())).unwrap();
        while writeback.ask().is_some() {
            std::thread::yield_now();
        }
        assert_eq!(writeback.end().unwrap_err().kind(), io::ErrorKind::StorageFull);
    }
}
