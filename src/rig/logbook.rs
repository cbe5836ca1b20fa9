//! The logbook: the output of each device's programs, one file `NAME.log` per device.
//!
//! The files are in the folder `logs` of the state directory: `$STATE_DIRECTORY`, which systemd sets, otherwise `rapid`
//! in `$XDG_STATE_HOME` or `~/.local/state`. Each run appends to them; a file that has grown to [`LARGEST`] becomes
//! `NAME.log.1`, that one `NAME.log.2`, and so on up to [`KEPT`].
//!
//! Invariant: writers never wait for the disk: a separate thread writes. Lines it cannot keep up with are counted and
//! reported.

use std::collections::HashMap;
use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use rapid_core::text;
use rapid_core::time;
use rapid_status::{Board, EventKind, Level};
use rapid_system::folder::state_directory;
use tokio::sync::oneshot;
use tokio::time::timeout;

/// Size in bytes at which a new file is started.
const LARGEST: u64 = 1 << 20;
/// Number of older files per device.
const KEPT: u32 = 3;
/// Lines that may be queued for the disk.
const DEPTH: usize = 1024;
/// How long the end of a run waits for the disk.
const LAST: Duration = Duration::from_secs(1);

#[derive(Debug, Clone)]
pub(super) struct Logbook {
    /// `None` if there is no folder or no thread for it.
    pages: Option<SyncSender<Page>>,
    /// Lines dropped because the queue was full.
    missing: Arc<AtomicU64>,
}

#[derive(Debug)]
enum Page {
    Line {
        device: String,
        wall_ns: u64,
        text: String,
    },
    /// Answered when everything before it is written.
    Flush(oneshot::Sender<()>),
}

impl Logbook {
    /// Starts writing below the state directory; with several rigs on this machine, each in a folder of its own.
    pub(super) fn start(instance: Option<&str>, board: &Arc<Board>) -> Self {
        let folder = state_directory().map(|state| {
            let logs = state.join("logs");
            instance.map_or(logs.clone(), |instance| logs.join(instance))
        });
        let Some(folder) = folder else { return Self::without_folder() };
        Self::in_folder(folder, Arc::clone(board))
    }

    /// Writes nothing: there is no state directory.
    pub(super) fn without_folder() -> Self {
        Self { pages: None, missing: Arc::default() }
    }

    fn in_folder(folder: PathBuf, board: Arc<Board>) -> Self {
        let (pages, inbox) = sync_channel(DEPTH);
        let missing: Arc<AtomicU64> = Arc::default();
        let files = Files { folder, open: HashMap::new(), largest: LARGEST };
        let count = Arc::clone(&missing);
        let thread =
            std::thread::Builder::new().name("logbook".to_owned()).spawn(move || keep(files, inbox, &count, &board));
        Self { pages: thread.is_ok().then_some(pages), missing }
    }

    /// Adds a line of a device.
    pub(super) fn write(&self, device: &str, text: &str) {
        let Some(pages) = &self.pages else { return };
        let line = Page::Line { device: device.to_owned(), wall_ns: time::realtime_ns(), text: text.to_owned() };
        if pages.try_send(line).is_err() {
            self.missing.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Waits briefly until everything is written.
    pub(super) async fn flush(&self) {
        let Some(pages) = &self.pages else { return };
        let (done, is_done) = oneshot::channel();
        // If this does not fit into the queue, the disk is not writing.
        if pages.try_send(Page::Flush(done)).is_ok() {
            let _ = timeout(LAST, is_done).await;
        }
    }
}

/// The thread's work.
fn keep(mut files: Files, inbox: Receiver<Page>, missing: &AtomicU64, board: &Board) {
    let mut complained = false;
    for page in inbox {
        let (device, wall_ns, text) = match page {
            Page::Line { device, wall_ns, text } => (device, wall_ns, text),
            Page::Flush(done) => {
                let _ = done.send(());
                continue;
            }
        };
        let lost = missing.swap(0, Ordering::Relaxed);
        let lost = if lost > 0 {
            format!("{} {} missing\n", time::rfc3339(wall_ns), text::counted(lost, "line"))
        } else {
            String::new()
        };
        let line = format!("{lost}{} {text}\n", time::rfc3339(wall_ns));
        if let Err(error) = files.write(&device, &line)
            && !complained
        {
            complained = true;
            let folder = files.folder.display();
            let text = format!("{folder}: {error}: what programs print is in the log of this run alone");
            board.announce(EventKind::Log { level: Level::Warn, text });
        }
    }
}

/// The open files, one per device.
#[derive(Debug)]
struct Files {
    folder: PathBuf,
    open: HashMap<String, (File, u64)>,
    largest: u64,
}

impl Files {
    fn write(&mut self, device: &str, line: &str) -> io::Result<()> {
        let path = self.folder.join(format!("{device}.log"));
        if self.open.get(device).is_some_and(|(_, size)| *size >= self.largest) {
            self.open.remove(device);
            rotate(&path);
        }
        let (file, size) = match self.open.get_mut(device) {
            Some(open) => open,
            None => self.open.entry(device.to_owned()).or_insert(open(&self.folder, &path)?),
        };
        let written = file.write_all(line.as_bytes());
        *size += line.len() as u64;
        if written.is_err() {
            // The next line may find space again.
            self.open.remove(device);
        }
        written
    }
}

fn open(folder: &Path, path: &Path) -> io::Result<(File, u64)> {
    DirBuilder::new().recursive(true).mode(0o755).create(folder)?;
    // A symbolic link would lead elsewhere.
    let file = OpenOptions::new().append(true).create(true).mode(0o644).custom_flags(libc::O_NOFOLLOW).open(path)?;
    let size = file.metadata()?.len();
    Ok((file, size))
}

/// Renames each file to the next number; the last one is removed.
fn rotate(path: &Path) {
    let older = |number: u32| path.with_extension(format!("log.{number}"));
    for number in (1..KEPT).rev() {
        let _ = std::fs::rename(older(number), older(number + 1));
    }
    let _ = std::fs::rename(path, older(1));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(folder: &Path, name: &str) -> String {
        std::fs::read_to_string(folder.join(name)).unwrap_or_default()
    }

    #[test]
    fn files_are_appended_to_and_rotated_when_full() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("state/logs");
        let files = || Files { folder: folder.clone(), open: HashMap::new(), largest: 8 };
        files().write("cam", "one\n").unwrap();
        // Another run.
        let mut files = files();
        for line in
            ["two\n", "three\n", "four\n", "five\n", "six\n", "seven\n", "eight\n", "nine\n", "ten\n", "eleven\n"]
        {
            files.write("cam", line).unwrap();
        }
        files.write("imu", "apart\n").unwrap();
        let names = ["cam.log.3", "cam.log.2", "cam.log.1", "cam.log"];
        assert_eq!(
            names.map(|name| read(&folder, name)),
            ["five\nsix\n", "seven\neight\n", "nine\nten\n", "eleven\n"].map(str::to_owned)
        );
        assert_eq!(read(&folder, "imu.log"), "apart\n");
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 5);
    }

    #[test]
    fn a_link_is_not_followed_and_an_impossible_folder_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        let elsewhere = dir.path().join("elsewhere");
        std::os::unix::fs::symlink(&elsewhere, dir.path().join("cam.log")).unwrap();
        let mut files = Files { folder: dir.path().to_owned(), open: HashMap::new(), largest: 8 };
        assert!(files.write("cam", "one\n").is_err());
        assert!(!elsewhere.exists());
        std::fs::write(dir.path().join("file"), "").unwrap();
        files.folder = dir.path().join("file/logs");
        assert!(files.write("imu", "one\n").is_err());
    }
}
