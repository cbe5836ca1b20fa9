//! The trash of a session: the folder `.trash` beside its episodes.
//!
//! Invariant: nothing is deleted but by [`empty`], and then only what a session put there.
//! Invariant: a link in its place is not followed: what it leads to is not ours.

use std::ffi::OsStr;
use std::io;

use rapid_episode::notes::name_for;
use rapid_episode::partial::TRASH;
use rapid_system::folder::{Folder, Missing};

/// Whether this is the name of an episode's file, and not a path.
pub fn is_name(name: &str) -> bool {
    let ending = [".mcap", ".mcap.partial"].iter().any(|ending| name.ends_with(ending));
    ending && !name.starts_with('.') && !name.contains(['/', '\0'])
}

/// Whether the trash of `folder` has this file.
pub fn holds(folder: &Folder, name: &str) -> bool {
    folder.subfolder(TRASH, Missing::Refused).is_ok_and(|trash| trash.has(name))
}

/// Moves an episode to the trash, with what is noted about it.
///
/// # Errors
/// When it does not exist, or cannot be moved; it is where it was then.
pub fn discard(folder: &Folder, name: &str) -> io::Result<()> {
    let trash = folder.subfolder(TRASH, Missing::Last)?;
    rename(folder, &trash, name)
}

/// Takes an episode back from the trash, with what is noted about it.
///
/// # Errors
/// `AlreadyExists` when its name is taken; otherwise when it is not there, or cannot be moved.
pub fn restore(folder: &Folder, name: &str) -> io::Result<()> {
    let trash = folder.subfolder(TRASH, Missing::Refused)?;
    rename(&trash, folder, name)
}

/// Deletes these files from the trash, what is noted about them, and the trash itself if nothing else is in it. A file that
/// is not there counts as deleted.
///
/// # Errors
/// The first error; the other files are deleted nevertheless.
pub fn empty<'a>(folder: &Folder, names: impl Iterator<Item = &'a str>) -> io::Result<()> {
    let mut names = names.peekable();
    let trash = match folder.subfolder(TRASH, Missing::Refused).map_err(io::Error::from) {
        // What is there in its place is not ours.
        Err(_) if names.peek().is_none() => return Ok(()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        opened => opened?,
    };
    let mut outcome = Ok(());
    let mut remove = |from: &Folder, name: &OsStr| match from.remove(name) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            let error = io::Error::new(error.kind(), format!("{}: {error}", from.path().join(name).display()));
            outcome = std::mem::replace(&mut outcome, Ok(())).and(Err(error));
        }
        _ => {}
    };
    for name in names {
        let notes = name_for(name.as_ref());
        remove(&trash, name.as_ref());
        remove(&trash, &notes);
        // They may have stayed behind; another episode of that name would have them.
        if !folder.has(name) {
            remove(folder, &notes);
        }
    }
    // It stays if another program put something else there.
    let _ = rustix::fs::unlinkat(folder.descriptor(), TRASH, rustix::fs::AtFlags::REMOVEDIR);
    outcome
}

fn rename(from: &Folder, to: &Folder, name: &str) -> io::Result<()> {
    from.move_new(name.as_ref(), to, name.as_ref())?;
    let notes = name_for(name.as_ref());
    // Where the episode is decides. Notes that cannot follow it stay where they are, and are found again when it is back.
    let _ = from.move_new(&notes, to, &notes);
    // A file system without this keeps the names at its own pace.
    let _ = to.sync().and(from.sync());
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use rapid_system::folder::Links;

    use super::*;

    fn opened(folder: &tempfile::TempDir) -> Folder {
        Folder::open(folder.path(), Links::Own, Missing::Refused).unwrap()
    }

    #[test]
    fn what_is_discarded_comes_back_whole_and_replaces_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let (out, open) = (folder.path(), &opened(&folder));
        fs::write(out.join("a.mcap"), "one").unwrap();
        discard(open, "a.mcap").unwrap();
        assert!(holds(open, "a.mcap") && !out.join("a.mcap").exists());
        assert_eq!(discard(open, "a.mcap").unwrap_err().kind(), io::ErrorKind::NotFound);
        fs::write(out.join("a.mcap"), "two").unwrap();
        assert_eq!(restore(open, "a.mcap").unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(discard(open, "a.mcap").unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read_to_string(out.join("a.mcap")).unwrap(), "two");
        fs::remove_file(out.join("a.mcap")).unwrap();
        restore(open, "a.mcap").unwrap();
        assert_eq!(fs::read_to_string(out.join("a.mcap")).unwrap(), "one");
    }

    #[test]
    fn only_the_named_files_are_deleted() {
        let folder = tempfile::tempdir().unwrap();
        let (out, open) = (folder.path(), &opened(&folder));
        empty(open, std::iter::once("a.mcap")).unwrap();
        for name in ["a.mcap", "b.mcap"] {
            fs::write(out.join(name), "x").unwrap();
            discard(open, name).unwrap();
        }
        fs::write(out.join(TRASH).join("mine.txt"), "x").unwrap();
        empty(open, ["a.mcap", "missing.mcap"].into_iter()).unwrap();
        assert!(!holds(open, "a.mcap") && holds(open, "b.mcap"));
        empty(open, std::iter::once("b.mcap")).unwrap();
        assert!(out.join(TRASH).join("mine.txt").exists());
        fs::remove_file(out.join(TRASH).join("mine.txt")).unwrap();
        empty(open, std::iter::empty()).unwrap();
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
