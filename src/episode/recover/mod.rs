//! Repair of episodes that were not finished: a `.partial` left by a kill or a full disk, a file cut
//! or damaged later.
//!
//! `copy` writes the readable parts into a whole file, `names` has the names of the files, `folder` repairs a folder,
//! in the background on request. The result for a file is a [`RepairOutcome`]:
//!
//! 1. Not whole, with something recorded: repaired into a file of the finished name. The `.partial`
//!    is removed once that file has its name, or kept as `.damaged` if anything of it was left out. A finished file is
//!    never touched: the repaired one stands beside it, `.recovered.mcap`.
//! 2. Whole, but without its final name (a kill at the very end): it gets its name, or a free one if another file has
//!    it by now, and is not changed otherwise.
//! 3. Zero bytes: removed and reported. Undamaged but without a sample: set aside as `.empty`. Not an MCAP file, or
//!    damaged and without a message: set aside as `.damaged`. Both are reported once, and their number stays taken.
//!
//! Invariant: every chunk of ours that is taken has a right check value. Messages of a cut last chunk have none: they
//! are taken only while the kernel that ordered their writes still runs, which proves that they were written, not that
//! no bit has changed since. They are counted, reported, and a reason not to call the file GOOD.
//! Invariant: what the recorder called BAD stays BAD.
//! Invariant: at every moment all recorded data is in the repaired file or in one that a later repair finds; an
//! interrupted repair leaves a `.recovering` file, which the next one replaces.

mod copy;
#[cfg(test)]
mod damage;
mod folder;
mod names;
#[cfg(test)]
mod proof;
mod report;
mod summary;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read, Seek};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use rapid_core::{text, time};
use serde::Serialize;

use super::partial::{self, Lock};
use crate::framing::MAGIC;
use crate::{Failed, ReadError};

pub use self::copy::recover_bytes;
pub use self::folder::{Repairs, finished, is_damaged, left_behind};
use self::names::{Names, set_aside};
use self::report::{About, Copied};
use self::summary::Summary;
pub use super::record_iter::{FileEnd, LeftOut};

/// What became of a file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recovered {
    /// The file.
    #[serde(serialize_with = "text::lossy")]
    pub file: PathBuf,
    /// What became of it.
    #[serde(flatten)]
    pub outcome: RepairOutcome,
}

/// What became of a file.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
pub enum RepairOutcome {
    /// It was repaired into a whole file.
    Repaired(Box<Repaired>),
    /// Only its name was missing, which it has now; or nothing.
    Whole {
        /// Its name.
        #[serde(serialize_with = "text::lossy")]
        to: PathBuf,
    },
    /// An earlier repair was ended after its work was done; the repaired file holds all of the original.
    AlreadyRepaired {
        /// The repaired file.
        #[serde(serialize_with = "text::lossy")]
        to: PathBuf,
        /// The original, if it holds more than the repaired file.
        #[serde(serialize_with = "text::lossy_option")]
        kept: Option<PathBuf>,
    },
    /// Nothing was recorded in it.
    Empty {
        /// What it is called now; a file of no bytes is removed.
        #[serde(serialize_with = "text::lossy_option")]
        kept: Option<PathBuf>,
    },
    /// It is not an MCAP file, or none of its messages can be read.
    Unreadable {
        /// What it is called now.
        #[serde(serialize_with = "text::lossy")]
        kept: PathBuf,
        /// Why its recorder called it BAD.
        #[serde(skip_serializing_if = "Option::is_none")]
        failed: Option<String>,
    },
}

/// What a repaired file holds, and what it lacks.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Repaired {
    /// The repaired file.
    #[serde(serialize_with = "text::lossy")]
    pub to: PathBuf,
    /// Seconds from the episode's beginning to the last message.
    pub seconds: f64,
    /// Messages.
    pub messages: u64,
    /// How the original ends.
    pub end: FileEnd,
    /// Bytes of the original that could not be read.
    pub unread_bytes: u64,
    /// Chunks left out because their check value is wrong.
    pub damaged_chunks: u64,
    /// What else is left out.
    #[serde(flatten)]
    pub left_out: LeftOut,
    /// Messages left out because the definition of their channel is lost, by the channel's number.
    pub nameless: BTreeMap<u16, u64>,
    /// Messages taken without a check value from a chunk cut by the end of the file: they were written since this
    /// machine was started.
    pub ordered_messages: u64,
    /// Records left out because they contradict others.
    pub refused_records: u64,
    /// Why its recorder called it BAD, if it did so after the last message.
    pub failed: Option<String>,
    /// Time of the last message, RFC 3339.
    pub last: String,
    /// The original, if it holds more than the repaired file, or is not a `.partial`.
    #[serde(serialize_with = "text::lossy_option")]
    pub original: Option<PathBuf>,
}

/// Called regularly during long work: `done` of `size` bytes are read. It may block.
pub type ProgressFn<'a> = dyn FnMut(u64, u64) -> ControlFlow<()> + 'a;

/// Why a file was not repaired. It is unchanged.
#[derive(Debug, thiserror::Error)]
pub enum RecoverError {
    /// The system refuses.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// It is a folder, a pipe, a device or a link.
    #[error("{}: not a file; name an episode itself, a file that ends in .mcap or .mcap.partial", .0.display())]
    NotFile(PathBuf),
    /// It is being written, or repaired, at this moment.
    #[error("{}: another rapid is writing or repairing it; end that first", .0.display())]
    Busy(PathBuf),
    /// Whether it is being written cannot be known.
    #[error("{}: its file system knows no locks, so it may still be written; copy it to another disk and repair it there", .0.display())]
    NoLock(PathBuf),
    /// A finished file that is not an MCAP file.
    #[error("{}: not an MCAP file", .0.display())]
    NotMcap(PathBuf),
    /// A finished file in which nothing can be read.
    #[error("{}: no message in it can be read", .0.display())]
    Nothing(PathBuf),
    /// The user ended it.
    #[error("{}: interrupted; it is as it was", .0.display())]
    Interrupted(PathBuf),
}

impl From<ReadError> for RecoverError {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Io { path, source } => Self::Io { path, source },
            ReadError::NotFile(path) => Self::NotFile(path),
            ReadError::NotMcap(path) => Self::NotMcap(path),
        }
    }
}

impl RecoverError {
    /// Was the argument something that cannot be repaired?
    pub fn is_bad_argument(&self) -> bool {
        match self {
            Self::NotFile(_) | Self::NotMcap(_) => true,
            Self::Io { source, .. } => source.kind() == io::ErrorKind::NotFound,
            _ => false,
        }
    }
}

/// Repairs the file at `path`; blocks for as long as it takes to copy it. One that another process writes or repairs is left
/// alone.
///
/// # Errors
/// See [`RecoverError`]; the file is unchanged.
pub fn recover(path: &Path, watch: &mut ProgressFn<'_>) -> Result<Recovered, RecoverError> {
    let io = |source| io_of(path, source);
    if fs::symlink_metadata(path).map_err(io)?.is_symlink() {
        return Err(RecoverError::NotFile(path.to_owned()));
    }
    let (file, _) = crate::open(path)?;
    let names = Names::for_path(path);
    match partial::lock(&file, path).map_err(io)? {
        Lock::Ours => {}
        Lock::Others => return Err(RecoverError::Busy(path.to_owned())),
        Lock::Gone => return Err(io(io::ErrorKind::NotFound.into())),
        // No program writes a finished file.
        Lock::Unknown if !names.is_partial => {}
        Lock::Unknown => return Err(RecoverError::NoLock(path.to_owned())),
    }
    // From here on no other program writes it.
    let size = file.metadata().map_err(io)?.len();
    let failed = Failed::read(&file, size).map_err(io)?;
    let mut source = LockedFile { path, file, size, failed };
    let outcome = if names.is_partial { source.partial(&names, watch) } else { source.finished(&names, watch) };
    outcome.map(|outcome| Recovered { file: path.to_owned(), outcome })
}

/// The file being repaired, under its lock.
struct LockedFile<'a> {
    path: &'a Path,
    file: File,
    size: u64,
    /// What its recorder wrote behind it.
    failed: Option<Failed>,
}

impl LockedFile<'_> {
    fn partial(&mut self, names: &Names, watch: &mut ProgressFn<'_>) -> Result<RepairOutcome, RecoverError> {
        if self.size == 0 {
            fs::remove_file(self.path).map_err(|source| self.io(source))?;
            return Ok(RepairOutcome::Empty { kept: None });
        }
        // A footer at the end: perhaps the whole episode, perhaps one that was repaired already.
        let known = if self.ends_with_magic()? { self.read(watch)? } else { None };
        if self.failed.is_none() && known.is_some_and(|known| known.is_whole()) {
            let to = names.publish(self.path).map_err(|source| self.io(source))?;
            return Ok(RepairOutcome::Whole { to });
        }
        let path = self.path;
        let aside = |ending| set_aside(path, &names.finished, ending).map_err(|source| io_of(path, source));
        let sha256 = self.sha256(watch)?;
        if let Some((to, is_all)) = self.repaired(names, &sha256, watch)? {
            let kept = if is_all { None } else { Some(aside("damaged")?) };
            if is_all {
                fs::remove_file(path).map_err(|source| self.io(source))?;
            }
            return Ok(RepairOutcome::AlreadyRepaired { to, kept });
        }
        let Some(copied) = self.copy(&names.recovering, sha256, watch)? else {
            return Ok(self.unreadable(aside("damaged")?));
        };
        let is_all = copied.is_lossless;
        if copied.summary.is_empty() && (is_all || copied.summary.messages == 0) {
            remove(&names.recovering);
            // A file damaged before its first message is not empty.
            let ending = if is_all { "empty" } else { "damaged" };
            let kept = aside(ending)?;
            return Ok(if is_all { RepairOutcome::Empty { kept: Some(kept) } } else { self.unreadable(kept) });
        }
        let to = self.publish(names)?;
        // Removed only if nothing is lost: a torn end is less than one record.
        let original = if is_all {
            fs::remove_file(self.path).err().map(|error| {
                tracing::warn!(file = %self.path.display(), %error, "repaired, but not removed");
                self.path.to_owned()
            })
        } else {
            Some(aside("damaged")?)
        };
        Ok(RepairOutcome::Repaired(Box::new(Repaired { to, original, ..copied.repaired })))
    }

    fn unreadable(&self, kept: PathBuf) -> RepairOutcome {
        RepairOutcome::Unreadable { kept, failed: self.failed.as_ref().map(|failed| failed.why.clone()) }
    }

    fn finished(&mut self, names: &Names, watch: &mut ProgressFn<'_>) -> Result<RepairOutcome, RecoverError> {
        let Some(known) = self.read(watch)? else { return Err(RecoverError::NotMcap(self.path.to_owned())) };
        if self.failed.is_none() && known.is_whole() {
            return Ok(RepairOutcome::Whole { to: self.path.to_owned() });
        }
        let sha256 = self.sha256(watch)?;
        if let Some((to, _)) = self.repaired(names, &sha256, watch)? {
            return Ok(RepairOutcome::AlreadyRepaired { to, kept: None });
        }
        let Some(copied) = self.copy(&names.recovering, sha256, watch)? else {
            return Err(RecoverError::NotMcap(self.path.to_owned()));
        };
        if copied.summary.messages == 0 {
            remove(&names.recovering);
            return Err(RecoverError::Nothing(self.path.to_owned()));
        }
        let to = self.publish(names)?;
        let original = Some(self.path.to_owned());
        Ok(RepairOutcome::Repaired(Box::new(Repaired { to, original, ..copied.repaired })))
    }

    /// Copies what can be read into a whole file of the name `to`; `None` if this is not an MCAP file.
    /// After an error there is no such file.
    fn copy(&self, to: &Path, sha256: String, watch: &mut ProgressFn<'_>) -> Result<Option<Copied>, RecoverError> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let (time_ns, boot, failed) = (time::realtime_ns(), crate::boot_id(), self.failed.as_ref());
        let about = About { name: &name, sha256, time_ns, boot, failed };
        let copied = names::create(to).map_err(copy::Error::Write).and_then(|file| {
            let copied = copy::copy(&self.file, self.size, &about, file, watch);
            if !matches!(copied, Ok(Some(_))) {
                remove(to);
            }
            copied
        });
        copied.map_err(|error| self.error(error, to))
    }

    /// Reads the file without writing anything.
    fn read(&self, watch: &mut ProgressFn<'_>) -> Result<Option<Summary>, RecoverError> {
        copy::summary(&self.file, self.size, watch).map_err(|error| self.error(error, self.path))
    }

    fn sha256(&self, watch: &mut ProgressFn<'_>) -> Result<String, RecoverError> {
        copy::sha256(&self.file, self.size, watch).map_err(|error| self.error(error, self.path))
    }

    /// Classifies an error of reading this file or writing `to`.
    fn error(&self, error: copy::Error, to: &Path) -> RecoverError {
        match error {
            copy::Error::Read(source) => self.io(source),
            copy::Error::Write(source) => io_of(to, source),
            copy::Error::Interrupted => RecoverError::Interrupted(self.path.to_owned()),
        }
    }

    /// A whole file repaired from this one, whose hash is `sha256`, under one of its candidate names, and whether it
    /// holds all except a torn end.
    fn repaired(
        &self,
        names: &Names,
        sha256: &str,
        watch: &mut ProgressFn<'_>,
    ) -> Result<Option<(PathBuf, bool)>, RecoverError> {
        for finished in names.candidates() {
            let Ok((file, size)) = crate::open(&finished) else { continue };
            let summary = copy::summary(&file, size, watch).map_err(|error| self.error(error, self.path))?;
            let Some(summary) = summary else { continue };
            if let Some((_, is_all)) = summary.made_of(self.size).filter(|(of, _)| *of == sha256) {
                return Ok(Some((finished, is_all)));
            }
        }
        Ok(None)
    }

    /// Gives the repaired file its name, another one if that is taken.
    fn publish(&self, names: &Names) -> Result<PathBuf, RecoverError> {
        names.publish(&names.recovering).map_err(|source| {
            remove(&names.recovering);
            self.io(source)
        })
    }

    fn ends_with_magic(&mut self) -> Result<bool, RecoverError> {
        let mut end = [0; MAGIC.len()];
        let Some(at) = self.size.checked_sub(MAGIC.len() as u64) else { return Ok(false) };
        let read = self.file.seek(io::SeekFrom::Start(at)).and_then(|_| self.file.read_exact(&mut end));
        read.map_err(|source| self.io(source))?;
        Ok(end == MAGIC)
    }

    fn io(&self, source: io::Error) -> RecoverError {
        io_of(self.path, source)
    }
}

fn io_of(path: &Path, source: io::Error) -> RecoverError {
    RecoverError::Io { path: path.to_owned(), source }
}

/// Its remains are replaced by the next repair.
fn remove(recovering: &Path) {
    if let Err(error) = fs::remove_file(recovering) {
        tracing::warn!(file = %recovering.display(), %error, "not removed");
    }
}
