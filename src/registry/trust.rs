//! Trust: whether any user other than root and this user may change the target of a path.
//!
//! A file can be exchanged by any user who may write to it, to a folder on the way to it, or to a link on
//! that way. Files that root reads or runs must not depend on such a file: it would grant root's rights to
//! its writer. The same rule as OpenSSH's for its key files (`StrictModes`, `safe_path()`).
//!
//! As root only root is trusted; otherwise root and this user. A folder that any user may write to is
//! acceptable if it is sticky, like /tmp: there only the owner of an entry, or of the folder,
//! can remove the entry. An access control list is visible in the bits of the group (acl(5)).
//!
//! Invariant: a path without an objection cannot be changed between the check and its use by an
//! untrusted user.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use rapid_system::folder::{FolderError, Missing, PathWalk};
use rustix::fs::{FileType, Stat};

/// Why the target of a path cannot be trusted. As text, the reason without the file's own name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Distrust {
    /// The object that others can change.
    place: EntryType,
    path: PathBuf,
    why: Why,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EntryType {
    File,
    Folder,
    Link,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Why {
    /// Its owner may change it.
    Owner(u32),
    /// Its mode lets others write.
    Mode(u32),
}

impl Distrust {
    /// The fix, with shell commands where possible.
    pub fn fix(&self) -> String {
        let path = shown(&self.path);
        match (self.place, self.why) {
            (EntryType::Link, _) => "name the real file instead of the link".to_owned(),
            (EntryType::File, Why::Owner(_)) => format!("chown {} {path}", rustix::process::geteuid().as_raw()),
            (EntryType::Folder, Why::Owner(_)) if rustix::process::geteuid().is_root() => {
                "copy it to where only root may write, and name it there: sudo install -D -m 644 devices.toml \
                 /etc/rapid/devices.toml, then --config /etc/rapid/devices.toml"
                    .to_owned()
            }
            (EntryType::Folder, Why::Owner(_)) => {
                "copy the file into a folder of your own and name it there".to_owned()
            }
            (EntryType::File | EntryType::Folder, Why::Mode(_)) => format!("chmod go-w {path}"),
        }
    }
}

impl fmt::Display for Distrust {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let path = shown(&self.path);
        let gain = if rustix::process::geteuid().is_root() { "could change what root runs" } else { "could change it" };
        match (self.place, self.why) {
            (EntryType::File, Why::Owner(uid)) => write!(f, "it belongs to user {uid}, who {gain}"),
            (EntryType::File, Why::Mode(mode)) => write!(f, "other users may write to it (mode {mode:04o})"),
            (EntryType::Folder, Why::Owner(uid)) => write!(f, "the folder {path} belongs to user {uid}, who {gain}"),
            (EntryType::Folder, Why::Mode(mode)) => {
                write!(f, "other users may write to the folder {path} (mode {mode:04o}) and {gain}")
            }
            (EntryType::Link, Why::Owner(uid)) => write!(f, "the link {path} belongs to user {uid}, who {gain}"),
            // The mode of a link has no meaning.
            (EntryType::Link, Why::Mode(_)) => write!(f, "others {gain}"),
        }
    }
}

/// Checks a file and everything on the way to it: the first reason not to trust it, if any.
///
/// To be called for a registry and for every program it names: as root an objection is an error, for
/// another user a warning.
///
/// # Errors
/// When there is no such file, or its folder may not be accessed.
pub fn distrust(path: &Path) -> io::Result<Option<Distrust>> {
    let euid = rustix::process::geteuid().as_raw();
    // The path to the working folder is part of the way.
    let path = if path.is_absolute() { path.to_owned() } else { std::env::current_dir()?.join(path) };
    let mut found = None;
    let mut check = |part: &Path, stat: &Stat| {
        let place = match FileType::from_raw_mode(stat.st_mode) {
            FileType::Symlink => EntryType::Link,
            FileType::Directory => EntryType::Folder,
            _ => EntryType::File,
        };
        let bits = Bits { mode: stat.st_mode & 0o7777, owner: stat.st_uid, group: stat.st_gid };
        let Some(why) = judge(place, bits, euid) else { return Ok(()) };
        found = Some(Distrust { place, path: part.to_owned(), why });
        // Stops the walk.
        Err(FolderError::NoFolder(part.to_owned()))
    };
    let walked = PathWalk::new(Missing::Refused, &mut check).to(&path);
    if found.is_none() {
        walked?;
    }
    Ok(found)
}

#[derive(Debug, Clone, Copy)]
struct Bits {
    mode: u32,
    owner: u32,
    group: u32,
}

fn judge(place: EntryType, bits: Bits, euid: u32) -> Option<Why> {
    let Bits { mode, owner, group } = bits;
    if owner != 0 && owner != euid {
        return Some(Why::Owner(owner));
    }
    if place == EntryType::Link || (place == EntryType::Folder && mode & 0o1000 != 0) {
        return None;
    }
    // A user's own group, numbered like the user, has no other members; files are 0664 where each
    // user has one.
    let own_group = euid != 0 && group == owner;
    let others = if own_group { 0o002 } else { 0o022 };
    (mode & others != 0).then_some(Why::Mode(mode))
}

fn shown(path: &Path) -> String {
    path.display().to_string().escape_debug().to_string()
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::{PermissionsExt, chown, lchown, symlink};

    use super::*;

    #[test]
    fn write_access_follows_owner_and_mode() {
        use EntryType::{File, Folder, Link};
        let why = |place, mode, owner, group, euid| judge(place, Bits { mode, owner, group }, euid);
        for (place, mode, owner, group, euid, expected) in [
            (File, 0o644, 0, 0, 0, None),
            (File, 0o664, 0, 0, 0, Some(Why::Mode(0o664))),
            (File, 0o646, 0, 0, 0, Some(Why::Mode(0o646))),
            (File, 0o600, 1000, 1000, 0, Some(Why::Owner(1000))),
            (File, 0o664, 1000, 1000, 1000, None),
            (File, 0o664, 1000, 100, 1000, Some(Why::Mode(0o664))),
            (File, 0o666, 1000, 1000, 1000, Some(Why::Mode(0o666))),
            (File, 0o644, 0, 0, 1000, None),
            (File, 0o644, 1001, 0, 1000, Some(Why::Owner(1001))),
            (File, 0o1666, 0, 0, 0, Some(Why::Mode(0o1666))),
            (Folder, 0o1777, 0, 0, 0, None),
            (Folder, 0o777, 0, 0, 0, Some(Why::Mode(0o777))),
            (Folder, 0o755, 1000, 1000, 0, Some(Why::Owner(1000))),
            (Link, 0o777, 0, 0, 0, None),
            (Link, 0o777, 1000, 1000, 0, Some(Why::Owner(1000))),
        ] {
            assert_eq!(why(place, mode, owner, group, euid), expected, "{place:?} {mode:o} {owner} {group} {euid}");
        }
    }

    struct Tree(tempfile::TempDir);

    impl Tree {
        /// `a/b/file`, which no other user may change.
        fn new() -> (Self, PathBuf) {
            let dir = tempfile::tempdir().unwrap();
            fs::create_dir_all(dir.path().join("a/b")).unwrap();
            let file = dir.path().join("a/b/file");
            fs::write(&file, "").unwrap();
            for path in ["a", "a/b"] {
                fs::set_permissions(dir.path().join(path), PermissionsExt::from_mode(0o755)).unwrap();
            }
            fs::set_permissions(&file, PermissionsExt::from_mode(0o644)).unwrap();
            (Self(dir), file)
        }

        fn at(&self, path: &str) -> PathBuf {
            self.0.path().join(path)
        }
    }

    fn found(path: &Path) -> Option<(EntryType, PathBuf)> {
        distrust(path).unwrap().map(|found| (found.place, found.path))
    }

    #[test]
    fn every_folder_on_the_way_counts_and_every_link() {
        let (tree, file) = Tree::new();
        assert_eq!(found(&file), None);
        fs::set_permissions(tree.at("a"), PermissionsExt::from_mode(0o777)).unwrap();
        assert_eq!(found(&file), Some((EntryType::Folder, tree.at("a"))));
        // A detour through a good folder does not help, nor one through `..`.
        symlink("a", tree.at("link")).unwrap();
        assert_eq!(found(&tree.at("link/b/file")), Some((EntryType::Folder, tree.at("a"))));
        assert_eq!(found(&tree.at("a/b/../b/file")), Some((EntryType::Folder, tree.at("a"))));
        fs::set_permissions(tree.at("a"), PermissionsExt::from_mode(0o1777)).unwrap();
        assert_eq!(found(&tree.at("link/b/file")), None);
        fs::set_permissions(&file, PermissionsExt::from_mode(0o666)).unwrap();
        symlink(&file, tree.at("absolute")).unwrap();
        assert_eq!(found(&tree.at("absolute")), Some((EntryType::File, file.clone())));
        let reason = distrust(&tree.at("absolute")).unwrap().unwrap();
        assert_eq!(reason.to_string(), "other users may write to it (mode 0666)");
        assert_eq!(reason.fix(), format!("chmod go-w {}", file.display()));
    }

    #[test]
    fn a_loop_of_links_and_a_missing_file_are_errors() {
        let (tree, _) = Tree::new();
        symlink("two", tree.at("one")).unwrap();
        symlink("one", tree.at("two")).unwrap();
        assert!(distrust(&tree.at("one")).is_err());
        assert_eq!(distrust(&tree.at("none")).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn files_of_another_user_are_not_trusted() {
        const OTHER: u32 = 12_345;
        let (tree, file) = Tree::new();
        if chown(&file, Some(OTHER), None).is_err() {
            crate::skip::skipped("only root can give files away");
            return;
        }
        assert_eq!(found(&file), Some((EntryType::File, file.clone())));
        chown(&file, Some(0), None).unwrap();
        symlink(&file, tree.at("link")).unwrap();
        lchown(tree.at("link"), Some(OTHER), None).unwrap();
        assert_eq!(found(&tree.at("link")), Some((EntryType::Link, tree.at("link"))));
        chown(tree.at("a"), Some(OTHER), None).unwrap();
        assert_eq!(found(&file), Some((EntryType::Folder, tree.at("a"))));
    }
}
