//! Episodes as bytes: the MCAP file read record by record, whole or not, and the names in it.
//!
//! What reads an episode, to tell of it, to repair it or to play it, reads it through a
//! [`walk::Walk`]; what only one of them needs is theirs.
//!
//! Invariant: no bytes make anything here panic, and memory holds one record of a file at a time.

mod chunk;
mod ends;
mod failed;
mod header;
mod index;
mod names;
pub(crate) mod op;
pub(crate) mod own;
mod owners;
mod passed;
mod resync;
mod source;
mod structure;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
pub(crate) mod walk;
mod walked;
mod whole;
pub(crate) mod wire;

pub(crate) use chunk::is_sound;
pub(crate) use failed::Failed;
pub(crate) use header::Writer;
pub(crate) use source::ReadAt;

use std::fs::File;
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;

/// Topic of the frame index.
pub(crate) const FRAME_TOPIC: &str = "/rapid/frame";
/// Topic of events.
pub(crate) const EVENT_TOPIC: &str = "/rapid/event";
/// Topic of the log.
pub(crate) const LOG_TOPIC: &str = "/rapid/log";

/// Metadata record at an episode's beginning.
pub(crate) const ABOUT: &str = "rapid";
/// Metadata record at an episode's end.
pub(crate) const SUMMARY: &str = "rapid/summary";
/// Metadata record of an episode that was repaired.
pub(crate) const RECOVERED: &str = "rapid/recovered";

/// Key of [`RECOVERED`]: why the original's recorder called it BAD.
pub(crate) const FAILED: &str = "failed";

/// Key of [`ABOUT`]: the boot of the machine in which the episode was recorded.
pub(crate) const BOOT_ID: &str = "boot_id";

/// The present boot of this machine (proc(5)): within one boot the kernel keeps the order of writes, whatever becomes
/// of the processes. `None` where the system does not say.
pub(crate) fn boot_id() -> Option<String> {
    let text = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    Some(text.trim().to_owned()).filter(|id| !id.is_empty())
}

/// Why a file cannot be opened to be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OpenError {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{}: not a file; name an episode, a file that ends in .mcap or .mcap.partial", .0.display())]
    NotFile(PathBuf),
}

/// Opens a file to be read, and its size in bytes. Pipes, devices and folders are refused without
/// being opened: opening one may wait for ever, or do something.
pub(crate) fn open(path: &Path) -> Result<(File, u64), OpenError> {
    let io = |source| OpenError::Io { path: path.to_owned(), source };
    let not_file = || OpenError::NotFile(path.to_owned());
    if !std::fs::metadata(path).map_err(io)?.is_file() {
        return Err(not_file());
    }
    let flags = OFlags::NONBLOCK.bits().cast_signed();
    let file = File::options().read(true).custom_flags(flags).open(path).map_err(io)?;
    // What has the name now may be another thing than what had it a moment ago.
    let metadata = file.metadata().map_err(io)?;
    if metadata.is_file() { Ok((file, metadata.len())) } else { Err(not_file()) }
}
