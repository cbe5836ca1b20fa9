//! The files of a dataset: their names, and how they get them.
//!
//! Invariant: a file has its name once it is complete and on the disk; what a program leaves that is killed is called
//! `.*.tmp`, and the next one removes it (see `owned`).

use std::ffi::OsStr;
use std::fs::File;
use std::path::Path;

use arrow_array::RecordBatch;
use arrow_schema::ArrowError;
use parquet::arrow::ArrowWriter;
use parquet::errors::ParquetError;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use rapid_system::folder::{Folder, Links, Missing, Sync};

use super::error::SetError;
use super::owned;

/// Files of a folder; also `chunks_size` in `info.json`.
pub(super) const CHUNK: u64 = 1000;
pub(super) const VIDEOS: &str = "videos";
/// What is in a file of Parquet about its writer.
pub(super) const CREATED_BY: &str = concat!("rapid ", env!("CARGO_PKG_VERSION"));
/// What that begins with in every version.
pub(super) const CREATOR: &str = "rapid ";
/// What the name of a file ends with that is not complete.
pub(super) const TEMPORARY: &str = ".tmp";

/// The file of an episode in this folder of the dataset.
pub(super) fn numbered(folder: &str, episode: u64, extension: &str) -> String {
    format!("{folder}/chunk-{:03}/file-{:03}.{extension}", episode / CHUNK, episode % CHUNK)
}

/// The file of an episode's video.
pub(super) fn video(key: &str, episode: u64) -> String {
    numbered(&format!("{VIDEOS}/{key}"), episode, "mp4")
}

/// The folder of a file, which is created, and its name in it.
fn place(path: &Path) -> Result<(Folder, &OsStr), SetError> {
    let parent = path.parent().unwrap_or(Path::new("."));
    Ok((Folder::open(parent, Links::Own, Missing::All)?, path.file_name().unwrap_or_default()))
}

pub(super) fn write(path: &Path, contents: &[u8]) -> Result<(), SetError> {
    let (folder, name) = place(path)?;
    folder.replace_by_umask(name, contents, Sync::Wait).map_err(|source| SetError::Io { path: path.to_owned(), source })
}

pub(super) fn write_parquet(path: &Path, batch: Result<RecordBatch, ArrowError>) -> Result<(), SetError> {
    let written = batch.map_err(ParquetError::from).and_then(|batch| {
        let mut bytes = Vec::new();
        // Of one row in hundreds of columns, dictionaries and indices would be most of the file.
        let properties = WriterProperties::builder()
            .set_dictionary_enabled(false)
            .set_statistics_enabled(EnabledStatistics::None)
            .set_offset_index_disabled(true)
            .set_created_by(CREATED_BY.to_owned())
            .build();
        let mut writer = ArrowWriter::try_new(&mut bytes, batch.schema(), Some(properties))?;
        writer.write(&batch)?;
        writer.close()?;
        Ok(bytes)
    });
    write(path, &written.map_err(|source| SetError::Parquet { path: path.to_owned(), source })?)
}

/// A file that gets its name when it is complete, and disappears if it is not.
#[derive(Debug)]
pub(super) struct NewFile {
    folder: Folder,
    temporary: String,
    pub(super) file: File,
    is_kept: bool,
}

impl NewFile {
    /// A file in the folder of `path`, which is created, with a name made of that of `path`.
    pub(super) fn create(path: &Path) -> Result<Self, SetError> {
        let (folder, name) = place(path)?;
        let temporary = format!(".{}{TEMPORARY}", name.to_string_lossy());
        // The set is locked: it is what a program left that was killed.
        let _ = folder.remove(&temporary);
        let file =
            folder.create_new(&temporary, 0o666).map_err(|source| SetError::Io { path: path.to_owned(), source })?;
        Ok(Self { folder, temporary, file, is_kept: false })
    }

    /// The same file, open once more.
    pub(super) fn again(&self) -> Result<File, SetError> {
        let path = || self.folder.path().join(&self.temporary);
        self.file.try_clone().map_err(|source| SetError::Io { path: path(), source })
    }

    /// Calls it `path`, where no file of another program may be.
    pub(super) fn keep(mut self, path: &Path) -> Result<(), SetError> {
        let (folder, name) = place(path)?;
        // Without facts: of an attempt that failed between the two.
        if owned::is_ours(path) {
            let _ = folder.remove(name);
        }
        let kept = self
            .file
            .sync_all()
            .and_then(|()| self.folder.move_new(self.temporary.as_ref(), &folder, name))
            .and_then(|()| folder.sync());
        self.is_kept = kept.is_ok();
        kept.map_err(|source| SetError::Io { path: path.to_owned(), source })
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        if !self.is_kept {
            let _ = self.folder.remove(&self.temporary);
        }
    }
}
