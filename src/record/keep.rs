//! Keeping an episode whatever became of its folder while it was recorded.
//!
//! The file is open all the time, so that what was written is there although its name is gone: a
//! folder that was moved is followed, and a file that was removed is written again.
//!
//! Invariant: a name that means another file is left alone.

use std::fs;
use std::io::{self, Seek, SeekFrom, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::episode::{EpisodePath, PARTIAL, lock};
use crate::episode_format::Failed;
use crate::folder::{Folder, Links, Missing};

/// Names tried for a file that is written again, while others have taken them.
const ATTEMPTS: u32 = 100;

/// Gives a finished file its name; returns where it is.
///
/// # Errors
/// When it keeps its partial name, or cannot be kept.
pub(super) fn publish(path: &EpisodePath) -> io::Result<PathBuf> {
    match whereabouts(path)? {
        Whereabouts::Here => path.publish(),
        Whereabouts::Moved(partial) => {
            let (from, to) = (path.finished.display(), partial.display());
            tracing::warn!(%from, %to, "the episode was moved while it was recorded");
            if partial.extension().is_none_or(|extension| extension != PARTIAL) {
                // Whoever moved it gave it the name it is to have.
                return Ok(partial);
            }
            let folder = open(partial.parent().unwrap_or(Path::new("")), Missing::Refused)?;
            let (finished, file) = (partial.with_extension(""), Arc::clone(&path.file));
            EpisodePath { folder, finished, partial, file, dropped: path.dropped.clone() }.publish()
        }
        Whereabouts::Removed => {
            let file = write_again(path, Content::Whole)?;
            tracing::warn!(file = %file.display(), "the episode was removed while it was recorded, and is written again");
            Ok(file)
        }
    }
}

/// Where a file is that could not be finished; one that was removed is written again. Behind it is written `why` it is
/// BAD, so that whoever reads it later finds that again: its summary may be GOOD by then.
pub(super) fn failed(path: &EpisodePath, why: &str) -> PathBuf {
    let mut file = &*path.file;
    let marked = file.seek(SeekFrom::End(0)).and_then(|_| file.write_all(&Failed::mark(why)));
    if let Err(error) = marked.and_then(|()| file.sync_data()) {
        let file = path.partial.display();
        tracing::error!(%file, %error, "BAD, and after a loss of power the file itself may not show it; remove it");
    }
    let found = whereabouts(path).and_then(|whereabouts| match whereabouts {
        Whereabouts::Here => Ok(path.partial.clone()),
        Whereabouts::Moved(partial) => Ok(partial),
        Whereabouts::Removed => write_again(path, Content::Partial),
    });
    found.unwrap_or_else(|error| {
        tracing::error!(file = %path.partial.display(), %error, "the episode is lost");
        path.partial.clone()
    })
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Content {
    Whole,
    Partial,
}

enum Whereabouts {
    Here,
    /// Its partial name, in another folder.
    Moved(PathBuf),
    Removed,
}

fn whereabouts(path: &EpisodePath) -> io::Result<Whereabouts> {
    let open = path.file.metadata()?;
    if open.nlink() == 0 {
        return Ok(Whereabouts::Removed);
    }
    let is_ours = |path: &Path| {
        fs::symlink_metadata(path).is_ok_and(|named| (named.dev(), named.ino()) == (open.dev(), open.ino()))
    };
    if is_ours(&path.partial) {
        return Ok(Whereabouts::Here);
    }
    // proc(5): the name the file has now.
    let there = fs::read_link(format!("/proc/self/fd/{}", path.file.as_raw_fd()))?;
    if is_ours(&there) {
        return Ok(if is_hidden(&there) { Whereabouts::Removed } else { Whereabouts::Moved(there) });
    }
    Err(io::Error::new(io::ErrorKind::NotFound, "the file is in none of the folders that can be seen"))
}

/// Is it the name a file system without open files that have none gives to one that was removed, until
/// it is closed (NFS, libfuse)?
fn is_hidden(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().as_encoded_bytes();
    [&b".nfs"[..], b".fuse_hidden"].iter().any(|hidden| name.starts_with(hidden))
}

/// Copies the open file to its folder, which is made again, or to that for temporary files.
fn write_again(path: &EpisodePath, content: Content) -> io::Result<PathBuf> {
    let name = path.finished.file_stem().unwrap_or_default();
    let mut first = None;
    let folder = path.finished.parent().map(Path::to_owned).unwrap_or_default();
    for folder in [folder, std::env::temp_dir()] {
        match write_into(&folder, &name.to_string_lossy(), content, path) {
            Ok(written) => return Ok(written),
            Err(error) => {
                tracing::error!(folder = %folder.display(), %error, "the episode cannot be written again here");
                first = first.or(Some(error));
            }
        }
    }
    Err(first.unwrap_or_else(|| io::ErrorKind::NotFound.into()))
}

fn write_into(out: &Path, stem: &str, content: Content, path: &EpisodePath) -> io::Result<PathBuf> {
    for attempt in 1..=ATTEMPTS {
        let folder = open(out, Missing::All)?;
        let stem = if attempt == 1 { stem.to_owned() } else { format!("{stem}-{attempt}") };
        let (finished, partial) = (format!("{stem}.mcap"), format!("{stem}.mcap.{PARTIAL}"));
        if folder.has(&finished) {
            continue;
        }
        let mut copy = match folder.create_new(&partial, 0o666) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => continue,
            made => made?,
        };
        let (finished, partial) = (out.join(finished), out.join(partial));
        // Before there is anything in it that somebody could repair.
        if !lock(&copy, &partial)? {
            continue;
        }
        let mut source = &*path.file;
        let copied = source.seek(SeekFrom::Start(0)).and_then(|_| io::copy(&mut source, &mut copy));
        if let Err(error) = copied.and_then(|_| copy.sync_all()) {
            // Half of it is of no use while the whole may go elsewhere.
            let _ = fs::remove_file(&partial);
            return Err(error);
        }
        if content == Content::Partial {
            return Ok(partial);
        }
        let dropped = path.dropped.clone();
        return EpisodePath { folder, finished, partial, file: Arc::new(copy), dropped }.publish();
    }
    Err(io::Error::new(io::ErrorKind::AlreadyExists, "no free name"))
}

fn open(folder: &Path, missing: Missing) -> io::Result<Folder> {
    Folder::open(folder, Links::Own, missing).map_err(io::Error::from)
}
