//! Where iceoryx2 keeps its files, and whether this user may use them.
//!
//! iceoryx2 0.10 creates its folder (`/tmp/iceoryx2`) for the first user, mode 0750, and its shared memory under names
//! that anybody can predict. For another user's folder it only reports `InternalError`; in a folder that is open to
//! everybody it would use the files that are there.

use std::fs::{Metadata, Permissions};
use std::io::ErrorKind;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::Access;

use super::BusError;
use super::space::PLACE;

/// Access to the folders: only the owner, whatever the umask.
const MODE: u32 = 0o700;

/// Where the bus of this user keeps its files: in iceoryx2's folder or, if another user has that one, in one of its own
/// beside it, which it also uses as long as it is there.
pub(super) fn of_this_user(folder: &Path) -> PathBuf {
    let user = rustix::process::geteuid().as_raw();
    let own = PathBuf::from(format!("{}-{user}", folder.display()));
    let owner = |path: &Path| std::fs::symlink_metadata(path).ok().map(|there| there.uid());
    let is_free = owner(folder).is_none_or(|owner| owner == user);
    if owner(&own) == Some(user) || !is_free { own } else { folder.to_owned() }
}

/// Refuses a folder that another user created, that is reached by another user's link, or that this process may not
/// use. A missing folder is created later.
pub(super) fn check(folder: &Path) -> Result<(), BusError> {
    let foreign = |what: String| BusError::Foreign { path: folder.to_owned(), what };
    let Ok(named) = std::fs::symlink_metadata(folder) else { return Ok(()) };
    if !is_trusted(&named) {
        return Err(foreign(belongs(&named)));
    }
    let Ok(folder_itself) = std::fs::metadata(folder) else {
        return Err(foreign("a link that leads nowhere".to_owned()));
    };
    if !folder_itself.is_dir() {
        return Err(foreign("not a folder".to_owned()));
    }
    if !is_trusted(&folder_itself) {
        return Err(foreign(belongs(&folder_itself)));
    }
    match rustix::fs::access(folder, Access::WRITE_OK | Access::EXEC_OK) {
        Ok(()) => Ok(()),
        Err(_) => Err(foreign(belongs(&folder_itself))),
    }
}

/// Refuses a machine without `/proc`, from which it is known whose files are in use.
pub(super) fn processes() -> Result<(), BusError> {
    if Path::new("/proc/self").exists() { Ok(()) } else { Err(BusError::NoProc) }
}

/// Refuses shared memory that is missing or not writable.
///
/// # Errors
/// In these cases, with the fix.
pub fn memory() -> Result<(), BusError> {
    usable(Path::new(PLACE))
}

fn usable(place: &Path) -> Result<(), BusError> {
    const MOUNT: &str = "mount it: sudo mkdir -p /dev/shm && sudo mount -t tmpfs -o mode=1777 tmpfs /dev/shm";
    let failed = |what: &str, fix| Err(BusError::Memory { what: what.to_owned(), fix });
    match std::fs::metadata(place) {
        Err(error) if error.kind() == ErrorKind::NotFound => return failed("there is no shared memory", MOUNT),
        Err(error) => return failed(&error.to_string(), MOUNT),
        Ok(there) if !there.is_dir() => return failed("it is not a folder; remove it", MOUNT),
        Ok(_) => {}
    }
    match rustix::fs::access(place, Access::WRITE_OK | Access::EXEC_OK) {
        Ok(()) => Ok(()),
        Err(rustix::io::Errno::ROFS) => {
            failed("it is mounted read-only", "mount it for writing: sudo mount -o remount,rw /dev/shm")
        }
        Err(_) => failed("this user may not write to it", "allow it: sudo chmod 1777 /dev/shm"),
    }
}

/// Creates the folders that iceoryx2 keeps files in, for their owner alone.
pub(super) fn make(root: &Path) -> Result<(), BusError> {
    for folder in [root.to_owned(), root.join("nodes"), root.join("services")] {
        let unusable = |what: String| BusError::Damaged { path: folder.clone(), what };
        match std::fs::create_dir(&folder) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => return Err(unusable(error.to_string())),
            _ => {}
        }
        let there = std::fs::metadata(&folder).map_err(|error| unusable(error.to_string()))?;
        if !there.is_dir() {
            return Err(unusable("not a folder".to_owned()));
        }
        let ours = there.uid() == rustix::process::geteuid().as_raw();
        if ours && there.permissions().mode() & 0o777 != MODE {
            let narrowed = std::fs::set_permissions(&folder, Permissions::from_mode(MODE));
            narrowed.map_err(|error| unusable(error.to_string()))?;
        }
    }
    Ok(())
}

/// Another user's file under a name that starts with our prefix: why a node could not be created.
pub(super) fn in_the_way(prefix: &str) -> Option<BusError> {
    let entries = std::fs::read_dir(PLACE).ok()?.flatten();
    let ours = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(prefix));
    entries.map(|entry| entry.path()).filter(ours).find_map(|path| {
        let there = std::fs::symlink_metadata(&path).ok()?;
        let what = belongs(&there);
        (!is_trusted(&there)).then_some(BusError::Foreign { path, what })
    })
}

fn is_trusted(metadata: &Metadata) -> bool {
    metadata.uid() == 0 || metadata.uid() == rustix::process::geteuid().as_raw()
}

fn belongs(metadata: &Metadata) -> String {
    format!("belongs to user {}", metadata.uid())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{chown, lchown, symlink};

    use super::*;

    #[test]
    fn each_user_has_a_folder_and_keeps_it() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("bus");
        let user = rustix::process::geteuid().as_raw();
        let own = dir.path().join(format!("bus-{user}"));
        assert_eq!(of_this_user(&folder), folder);
        std::fs::create_dir(&folder).unwrap();
        assert_eq!(of_this_user(&folder), folder);
        // Only root can give a folder away.
        if user == 0 {
            chown(&folder, Some(12_345), None).unwrap();
            assert_eq!(of_this_user(&folder), own);
        }
        std::fs::create_dir(&own).unwrap();
        std::fs::remove_dir(&folder).unwrap();
        assert_eq!(of_this_user(&folder), own, "as long as it is there");
    }

    #[test]
    fn shared_memory_that_cannot_be_used_is_an_error_with_its_fix() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        std::fs::write(&file, "").unwrap();
        assert!(usable(dir.path()).is_ok());
        for (place, what) in [(dir.path().join("none"), "there is no shared memory"), (file, "not a folder")] {
            let error = usable(&place).unwrap_err().to_string();
            assert!(error.starts_with("/dev/shm: ") && error.contains(what), "{error}");
            assert!(error.contains("sudo mount -t tmpfs"), "{error}");
        }
    }

    #[test]
    fn only_a_folder_we_own_is_used() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("iceoryx2");
        assert!(check(&folder).is_ok(), "it is made when it is missing");
        std::fs::create_dir(&folder).unwrap();
        assert!(check(&folder).is_ok());
        let link = dir.path().join("link");
        symlink(&folder, &link).unwrap();
        assert!(check(&link).is_ok());
        let file = dir.path().join("file");
        std::fs::write(&file, "").unwrap();
        assert!(check(&file).unwrap_err().to_string().contains("file: not a folder; "));
        symlink(dir.path().join("nowhere"), dir.path().join("dangling")).unwrap();
        assert!(check(&dir.path().join("dangling")).is_err());
        if lchown(&link, Some(12_345), None).is_err() {
            crate::skip::skipped("only root can give links away");
            return;
        }
        assert!(check(&link).unwrap_err().to_string().contains("link: belongs to user 12345; "));
        chown(&folder, Some(12_345), None).unwrap();
        let error = check(&folder).unwrap_err().to_string();
        assert!(error.contains("iceoryx2: belongs to user 12345; ") && error.contains("rm -r"), "{error}");
    }
}
