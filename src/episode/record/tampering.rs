//! Whether the file of the episode in progress is still what the recorder wrote.
//!
//! 1. The file is only appended to, so that its size is what was written, unless another program cut it or wrote
//!    behind it: then the size stays wrong, and every look sees it.
//! 2. If the name of the file now means another file, the file was replaced.
//! 3. The kernel reports that another program opened the file (inotify(7), `IN_OPEN`). Whether every program has closed
//!    it is unknown, as equal events are merged, and what they changed inside is not visible from outside. Such a file
//!    is read back once it is finished, and all its check values must be right. Others are not read back.
//!
//! Removal is not damage: the file is written again when the episode ends (`episode_path::keep`).
//!
//! Invariant: nothing here runs between two samples: checks belong to flushes.

use std::fs::File;
use std::io;
use std::mem::MaybeUninit;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::PathBuf;
use std::sync::Arc;

use rustix::fs::inotify::{self, CreateFlags, ReadFlags, Reader, WatchFlags};
use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl, fstat, stat};

use super::episode_path::EpisodePath;
use crate::record_iter::RecordIter;

/// Room for the events of one read; more need another.
const EVENT_BYTES: usize = 1024;

pub(super) struct FileWatch {
    file: Arc<File>,
    partial: PathBuf,
    /// None without inotify: then damage inside the file is found by its reader.
    events: Option<OwnedFd>,
    /// Another program opened the file, for reading or for writing.
    was_opened: bool,
    /// Another program had it open for writing, which was reported.
    was_written: bool,
}

impl FileWatch {
    /// Guards the file of an episode, of which nothing is written yet.
    pub(super) fn begin(path: &EpisodePath) -> Self {
        let append = fcntl_getfl(&path.file).and_then(|flags| fcntl_setfl(&path.file, flags | OFlags::APPEND));
        if let Err(error) = append {
            tracing::debug!(%error, "the file is not only appended to");
        }
        let events = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).and_then(|events| {
            let watched = WatchFlags::OPEN | WatchFlags::CLOSE_WRITE;
            inotify::add_watch(&events, itself(&path.file), watched)?;
            Ok(events)
        });
        let events = events.map_err(|error| tracing::debug!(%error, "other programs' writes are not watched")).ok();
        Self {
            file: Arc::clone(&path.file),
            partial: path.partial.clone(),
            events,
            was_opened: false,
            was_written: false,
        }
    }

    /// Is the file unchanged, with `written` bytes?
    ///
    /// # Errors
    /// When another program cut, extended or replaced it; the text is the reason.
    pub(super) fn check(&mut self, written: u64) -> io::Result<()> {
        let is = fstat(&self.file)?;
        let size = u64::try_from(is.st_size).unwrap_or(0);
        if size < written {
            let text =
                format!("another program cut it while it was recorded: {} of {written} bytes are gone", written - size);
            return Err(io::Error::other(text));
        }
        if size > written {
            let text = format!("another program wrote {} bytes into it while it was recorded", size - written);
            return Err(io::Error::other(text));
        }
        let named = if is.st_nlink == 0 { stat(&self.partial).ok() } else { None };
        if named.is_some_and(|named| (named.st_dev, named.st_ino) != (is.st_dev, is.st_ino)) {
            let text = "another program put another file in its place while it was recorded, which is left alone";
            return Err(io::Error::other(text));
        }
        self.take_events();
        Ok(())
    }

    /// Is the finished file undamaged? Read back only if there is reason for doubt.
    ///
    /// # Errors
    /// When it is not; the text is the reason.
    pub(super) fn verify(mut self, written: u64) -> io::Result<()> {
        self.check(written)?;
        if !self.was_opened {
            return Ok(());
        }
        if let Some(mut records) = RecordIter::new(File::open(itself(&self.file))?, written)? {
            while records.advance()? {}
            if records.integrity().proven {
                return Ok(());
            }
        }
        Err(io::Error::other("another program wrote into it while it was recorded: its check values are not right"))
    }

    fn take_events(&mut self) {
        let Some(events) = &self.events else { return };
        let mut buffer = [MaybeUninit::uninit(); EVENT_BYTES];
        let mut reader = Reader::new(events, &mut buffer);
        // Empty, or broken: nothing to read.
        while let Ok(event) = reader.next() {
            let what = event.events();
            let written = what.intersects(ReadFlags::CLOSE_WRITE | ReadFlags::QUEUE_OVERFLOW);
            self.was_opened |= written || what.contains(ReadFlags::OPEN);
            if written && !std::mem::replace(&mut self.was_written, true) {
                let file = self.partial.display();
                tracing::warn!(
                    %file,
                    "another program had the episode open for writing; its check values are verified when it ends"
                );
            }
        }
    }
}

/// A path to an open file, whatever became of its names, proc(5).
fn itself(file: &File) -> String {
    format!("/proc/self/fd/{}", file.as_raw_fd())
}
