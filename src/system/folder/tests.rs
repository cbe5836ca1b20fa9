use std::fs;
use std::os::unix::fs::{PermissionsExt, lchown, symlink};

use super::*;

const OTHER: u32 = 12_345;

fn open(path: &Path) -> Result<Folder, FolderError> {
    Folder::open(path, Links::Own, Missing::Refused)
}

/// Everything that can be planted under a name, each with a target that must not change.
fn plant(folder: &Path, name: &str) -> Vec<(&'static str, PathBuf)> {
    let victim = folder.join("victim");
    fs::write(&victim, "precious").unwrap();
    let kinds = ["link", "dangling link", "hard link", "pipe", "folder", "file", "link to a pipe"];
    let planted = kinds.map(|kind| {
        let place = folder.join(kind);
        fs::create_dir(&place).unwrap();
        let at = place.join(name);
        match kind {
            "link" => symlink(&victim, &at).unwrap(),
            "dangling link" => symlink(place.join("nothing"), &at).unwrap(),
            "hard link" => fs::hard_link(&victim, &at).unwrap(),
            "folder" => fs::create_dir(&at).unwrap(),
            "file" => fs::write(&at, "theirs").unwrap(),
            _ => {
                let pipe = if kind == "pipe" { at.clone() } else { place.join("real pipe") };
                rustix::fs::mknodat(CWD, &pipe, FileType::Fifo, 0o666.into(), 0).unwrap();
                if kind != "pipe" {
                    symlink(&pipe, &at).unwrap();
                }
            }
        }
        (kind, place)
    });
    planted.to_vec()
}

#[test]
fn planted_files_are_neither_opened_nor_written_to() {
    let dir = tempfile::tempdir().unwrap();
    for (kind, place) in plant(dir.path(), "name") {
        let folder = open(&place).unwrap();
        let error = folder.create_new("name", 0o644).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists, "{kind}");
        assert!(folder.has("name"), "{kind}");
        fs::write(place.join("whole"), "ours").unwrap();
        let error = folder.rename_new("whole".as_ref(), "name".as_ref()).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists, "{kind}");
        let read = folder.open_file("name").map(|_| ());
        assert_eq!(read.is_ok(), matches!(kind, "file" | "hard link"), "{kind}: {read:?}");
        // What can be replaced is; the target of a link stays unchanged.
        let replaced = folder.replace("name", b"ours", 0o640, Sync::Skip);
        assert_eq!(replaced.is_ok(), kind != "folder", "{kind}: {replaced:?}");
        if replaced.is_ok() {
            let made = fs::symlink_metadata(place.join("name")).unwrap();
            assert!(made.is_file() && made.permissions().mode() & 0o777 == 0o640, "{kind}: {made:?}");
            assert_eq!(fs::read_to_string(place.join("name")).unwrap(), "ours");
        }
        assert!(!place.join("nothing").exists(), "written through a dangling link");
        let left: Vec<_> = fs::read_dir(&place).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert!(!left.iter().any(|name| name.to_string_lossy().ends_with(".tmp")), "{kind}: {left:?}");
    }
    assert_eq!(fs::read_to_string(dir.path().join("victim")).unwrap(), "precious");
}

#[test]
fn a_taken_temporary_name_is_avoided() {
    let dir = tempfile::tempdir().unwrap();
    let folder = open(dir.path()).unwrap();
    let temporary = dir.path().join(format!(".name.{}.tmp", std::process::id()));
    // A folder cannot be removed like a file, just as another user's file cannot.
    fs::create_dir(&temporary).unwrap();
    folder.replace("name", b"ours", 0o644, Sync::Wait).unwrap();
    assert_eq!(fs::read_to_string(dir.path().join("name")).unwrap(), "ours");
    assert!(temporary.is_dir());
}

#[test]
fn links_in_the_path_are_followed_depending_on_their_owner() {
    let dir = tempfile::tempdir().unwrap();
    let real = dir.path().join("real/deep");
    fs::create_dir_all(&real).unwrap();
    symlink("real", dir.path().join("relative")).unwrap();
    symlink(dir.path().join("relative"), dir.path().join("absolute")).unwrap();
    symlink("circle", dir.path().join("circle")).unwrap();
    let way = dir.path().join("absolute/deep/../deep");
    let folder = open(&way).unwrap();
    folder.create_new("made", 0o644).unwrap();
    assert!(real.join("made").exists());
    assert_eq!(folder.path(), way);
    let error = Folder::open(&way, Links::Refused, Missing::Refused).unwrap_err();
    assert!(matches!(&error, FolderError::Link { path, .. } if *path == dir.path().join("absolute")), "{error}");
    assert!(error.to_string().contains("a symbolic link, which is not followed here; name the real folder"));
    let error = open(&dir.path().join("circle")).unwrap_err();
    assert!(matches!(error, FolderError::Io { .. }), "{error}");
    if lchown(dir.path().join("relative"), Some(OTHER), None).is_err() {
        crate::skip::skipped("only root can give links away");
        return;
    }
    let error = open(&way).unwrap_err();
    assert!(matches!(&error, FolderError::Link { owner: OTHER, .. }), "{error}");
    assert!(error.to_string().contains("relative: a symbolic link of user 12345, which"), "{error}");
}

#[test]
fn only_the_permitted_missing_folders_are_created() {
    let dir = tempfile::tempdir().unwrap();
    let deep = dir.path().join("a/b");
    let error = Folder::open(&deep, Links::Own, Missing::Last).unwrap_err();
    assert!(matches!(&error, FolderError::Io { path, .. } if *path == dir.path().join("a")), "{error}");
    Folder::open(&deep, Links::Refused, Missing::All).unwrap();
    assert!(deep.is_dir());
    fs::write(deep.join("file"), "").unwrap();
    let error = open(&deep.join("file")).unwrap_err();
    assert!(error.to_string().ends_with("file: not a folder"), "{error}");
    // It is held open, so files are written to it wherever it has been moved.
    let folder = open(&deep).unwrap();
    fs::rename(&deep, dir.path().join("moved")).unwrap();
    symlink("/proc", &deep).unwrap();
    folder.replace("made", b"", 0o644, Sync::Skip).unwrap();
    assert!(dir.path().join("moved/made").exists());
}

#[test]
fn a_planted_file_is_not_read_beyond_the_limit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("file");
    fs::write(&path, "0123456789").unwrap();
    assert!(read_text(&path, 4).unwrap_err().to_string().contains("larger than 4 B"));
    assert_eq!(read_text(&path, 100).unwrap(), "0123456789");
    fs::remove_file(&path).unwrap();
    symlink("/dev/zero", &path).unwrap();
    assert!(read_text(&path, 100).is_err());
}
