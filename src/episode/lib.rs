//! Episodes as files: MCAP, read record by record, whole or not.
//!
//! Report, repair and replay all read an episode through a `RecordIter`; code for only one of them lives
//! there.
//!
//! Invariant: no bytes cause a panic here, and memory holds one record of a file at a time.

pub mod channel;
mod chunk;
pub(crate) mod chunk_writer;
pub mod decode;
#[cfg(test)]
#[path = "../../tests/support/effort.rs"]
mod effort;
pub mod encode;
mod episode_id;
mod failed;
pub mod form;
mod framing;
mod hash;
mod index;
mod integrity;
pub mod made;
mod names;
pub mod notes;
pub(crate) mod op;
pub(crate) mod own;
mod ownership;
pub mod partial;
#[cfg(test)]
#[path = "../../tests/support/patience.rs"]
mod patience;
pub mod plot;
pub mod reader;
pub mod record;
pub mod record_iter;
pub mod recover;
pub mod reference;
mod resync;
pub mod schema;
#[cfg(test)]
#[path = "../../tests/support/skip.rs"]
mod skip;
mod source;
#[cfg(test)]
#[path = "../../tests/support/recorded.rs"]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
pub mod wire;

pub use decode::decode;
pub(crate) use failed::Failed;
pub use framing::MAGIC;
pub use hash::sha256;
pub(crate) use integrity::Writer;
pub use reference::ReferenceSample;
pub use source::ReadAt;

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use rapid_system::limited::{Hole, large_hole};
use rustix::fs::OFlags;

/// Metadata record at an episode's beginning.
pub const ABOUT: &str = "rapid";
/// Metadata record at an episode's end.
pub(crate) const SUMMARY: &str = "rapid/summary";
/// Metadata record of an episode that was repaired.
pub(crate) const RECOVERED: &str = "rapid/recovered";

/// Key of [`RECOVERED`]: why the original's recorder called it BAD.
pub(crate) const FAILED: &str = "failed";

/// Key of [`ABOUT`]: the boot of the machine in which the episode was recorded.
pub(crate) const BOOT_ID: &str = "boot_id";

/// Pairs of text as MCAP's metadata have them.
pub fn text_map<const N: usize>(pairs: [(&str, String); N]) -> BTreeMap<String, String> {
    pairs.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

/// The present boot of this machine (proc(5)): within one boot the kernel keeps the order of writes, whatever becomes
/// of the processes. `None` where the system does not provide it.
pub(crate) fn boot_id() -> Option<String> {
    let text = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    Some(text.trim().to_owned()).filter(|id| !id.is_empty())
}

/// Why a file cannot be read as an episode.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// It cannot be opened or read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// It is a folder, a pipe or a device.
    #[error("{}: not a file; name an episode, a file that ends in .mcap or .mcap.partial", .0.display())]
    NotFile(PathBuf),
    /// It does not begin like an MCAP file.
    #[error("{}: not an MCAP file", .0.display())]
    NotMcap(PathBuf),
}

/// A hole in a file is within a record, as a copy makes it of black pictures: it is not longer than the longest record that is
/// read. Reading zeros takes time for nothing, so there are not many of them: for any file, and per byte that was written.
const LONGEST_HOLE: u64 = framing::MAX_RECORD;
const MOST_HOLES: u64 = 4 << 30;
const HOLES_EACH: u64 = 64;

/// Opens a file to be read, and its size in bytes. Pipes, devices and folders are refused without
/// being opened: opening one may block forever or have side effects.
///
/// # Errors
/// There is no such file, it is not a file, or much of it was never written.
pub fn open(path: &Path) -> Result<(File, u64), ReadError> {
    let io = |source| ReadError::Io { path: path.to_owned(), source };
    let not_file = || ReadError::NotFile(path.to_owned());
    if !std::fs::metadata(path).map_err(io)?.is_file() {
        return Err(not_file());
    }
    let flags = OFlags::NONBLOCK.bits().cast_signed();
    let file = File::options().read(true).custom_flags(flags).open(path).map_err(io)?;
    // The name may mean something else than a moment ago.
    let metadata = file.metadata().map_err(io)?;
    if !metadata.is_file() {
        return Err(not_file());
    }
    let size = metadata.len();
    match large_hole(&file, size, LONGEST_HOLE, MOST_HOLES, HOLES_EACH) {
        Some(Hole { at, bytes }) => Err(io(io::Error::other(format!(
            "{} from byte {at} on were never written (a sparse file): it is not as it was recorded; copy it again from where \
             it came from",
            rapid_core::text::size(bytes)
        )))),
        None => Ok((file, size)),
    }
}
