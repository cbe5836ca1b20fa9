//! The trash of a session: the folder `.trash` beside its episodes.
//!
//! Invariant: nothing is deleted but by [`empty`], and then only what a session put there.

use std::io;
use std::os::fd::AsFd as _;
use std::path::Path;

use rapid_episode::partial::TRASH;
use rapid_system::folder::{Folder, Links, Missing};
use rustix::fs::RenameFlags;
use rustix::io::Errno;

/// Whether this is the name of an episode's file, and not a path.
pub fn is_name(name: &str) -> bool {
    let ending = [".mcap", ".mcap.partial"].iter().any(|ending| name.ends_with(ending));
    ending && !name.starts_with('.') && !name.contains(['/', '\0'])
}

/// Whether the trash of `folder` has this file.
pub fn holds(folder: &Path, name: &str) -> bool {
    folder.join(TRASH).join(name).symlink_metadata().is_ok()
}

/// Moves an episode to the trash.
///
/// # Errors
/// When it does not exist, or cannot be moved.
pub fn discard(folder: &Path, name: &str) -> io::Result<()> {
    let (episodes, trash) = open(folder, Missing::Last)?;
    rename(&episodes, &trash, name)
}

/// Takes an episode back from the trash.
///
/// # Errors
/// `AlreadyExists` when its name is taken; otherwise when it is not there, or cannot be moved.
pub fn restore(folder: &Path, name: &str) -> io::Result<()> {
    let (episodes, trash) = open(folder, Missing::Refused)?;
    rename(&trash, &episodes, name)
}

/// Deletes these files from the trash, and the trash itself if nothing else is in it. A file that is not there counts as
/// deleted.
///
/// # Errors
/// The first error; the other files are deleted nevertheless.
pub fn empty<'a>(folder: &Path, names: impl Iterator<Item = &'a str>) -> io::Result<()> {
    let (episodes, trash) = match open(folder, Missing::Refused) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        opened => opened?,
    };
    let mut outcome = Ok(());
    for name in names {
        match trash.remove(name) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => outcome = outcome.and(Err(error)),
            _ => {}
        }
    }
    // It stays if another program put something else there.
    let _ = rustix::fs::unlinkat(episodes.descriptor(), TRASH, rustix::fs::AtFlags::REMOVEDIR);
    outcome
}

fn open(folder: &Path, missing: Missing) -> io::Result<(Folder, Folder)> {
    let episodes = Folder::open(folder, Links::Own, Missing::Refused)?;
    // Links are refused: the trash is on the disk of the episodes.
    let trash = Folder::open(&folder.join(TRASH), Links::Own, missing)?;
    Ok((episodes, trash))
}

/// A file system without the flag (NFS, some FUSE) is checked instead.
fn rename(from: &Folder, to: &Folder, name: &str) -> io::Result<()> {
    let (old, new) = (from.descriptor().as_fd(), to.descriptor().as_fd());
    match rustix::fs::renameat_with(old, name, new, name, RenameFlags::NOREPLACE) {
        Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) if !to.has(name) => {
            rustix::fs::renameat(old, name, new, name)?;
        }
        outcome => outcome?,
    }
    // A file system without this keeps the names at its own pace.
    let _ = to.sync().and(from.sync());
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn what_is_discarded_comes_back_whole_and_replaces_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        fs::write(out.join("a.mcap"), "one").unwrap();
        discard(out, "a.mcap").unwrap();
        assert!(holds(out, "a.mcap") && !out.join("a.mcap").exists());
        assert_eq!(discard(out, "a.mcap").unwrap_err().kind(), io::ErrorKind::NotFound);
        fs::write(out.join("a.mcap"), "two").unwrap();
        assert_eq!(restore(out, "a.mcap").unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(discard(out, "a.mcap").unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read_to_string(out.join("a.mcap")).unwrap(), "two");
        fs::remove_file(out.join("a.mcap")).unwrap();
        restore(out, "a.mcap").unwrap();
        assert_eq!(fs::read_to_string(out.join("a.mcap")).unwrap(), "one");
    }

    #[test]
    fn only_the_named_files_are_deleted() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        empty(out, std::iter::once("a.mcap")).unwrap();
        for name in ["a.mcap", "b.mcap"] {
            fs::write(out.join(name), "x").unwrap();
            discard(out, name).unwrap();
        }
        fs::write(out.join(TRASH).join("mine.txt"), "x").unwrap();
        empty(out, ["a.mcap", "missing.mcap"].into_iter()).unwrap();
        assert!(!holds(out, "a.mcap") && holds(out, "b.mcap"));
        empty(out, std::iter::once("b.mcap")).unwrap();
        assert!(out.join(TRASH).join("mine.txt").exists());
        fs::remove_file(out.join(TRASH).join("mine.txt")).unwrap();
        empty(out, std::iter::empty()).unwrap();
        assert!(!out.join(TRASH).exists());
    }

    #[test]
    fn a_name_is_the_name_of_an_episode() {
        for (name, expected) in [
            ("20261124_place-block_001.mcap", true),
            ("20261124_place-block_001.mcap.partial", true),
            ("../a.mcap", false),
            (".hidden.mcap", false),
            ("a.txt", false),
            ("", false),
        ] {
            assert_eq!(is_name(name), expected, "{name}");
        }
    }
}
