use std::os::unix::fs::{PermissionsExt, symlink};

use super::*;

fn one() -> SystemFile {
    system_files(&Registry::builtin()).remove(0)
}

#[test]
fn all_files_are_written_and_stale_ones_are_removed() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("udev");
    std::fs::create_dir_all(folder.join(DESCRIPTORS)).unwrap();
    std::fs::write(folder.join("descriptors/gone.yaml"), format!("{HEADER}\nmodule: \"gone\"\n")).unwrap();
    std::fs::write(folder.join("descriptors/theirs.yaml"), "module: theirs\n").unwrap();
    let mut out = Vec::new();
    write(&Registry::builtin(), &folder, &mut out).unwrap();
    for file in system_files(&Registry::builtin()) {
        let path = folder.join(&file.path);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), file.contents);
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o644);
    }
    let mut names: Vec<_> = std::fs::read_dir(folder.join(DESCRIPTORS))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(names, ["cam_wrist.yaml", "motor_state.yaml", "tactile_tip.yaml", "theirs.yaml"]);
    let listed = String::from_utf8(out).unwrap();
    assert_eq!(listed.lines().count(), 11);
    assert!(listed.contains("gone.yaml: the entry no longer exists"), "{listed}");
}

#[test]
fn a_planted_link_is_replaced_and_never_written_through() {
    let dir = tempfile::tempdir().unwrap();
    let victim = dir.path().join("victim");
    std::fs::write(&victim, "precious").unwrap();
    let path = dir.path().join("99-rapid.rules");
    symlink(&victim, &path).unwrap();
    write_file(&path, one().contents.as_bytes(), 0o644, Links::Refused).unwrap();
    assert_eq!(std::fs::read_to_string(&victim).unwrap(), "precious");
    assert!(!path.is_symlink());
    assert_eq!(std::fs::read_to_string(&path).unwrap(), one().contents);
}

#[test]
fn a_planted_folder_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let elsewhere = dir.path().join("elsewhere");
    std::fs::create_dir(&elsewhere).unwrap();
    let planted = dir.path().join("udev");
    symlink(&elsewhere, &planted).unwrap();
    let error =
        write_file(&planted.join("99-rapid.rules"), one().contents.as_bytes(), 0o644, Links::Refused).unwrap_err();
    assert!(matches!(&error, ArtifactsError::Folder(FolderError::Link { path, .. }) if *path == planted), "{error}");
    assert_eq!(std::fs::read_dir(&elsewhere).unwrap().count(), 0);
    write_file(&planted.join("99-rapid.rules"), one().contents.as_bytes(), 0o644, Links::Own).unwrap();
    assert_eq!(std::fs::read_dir(&elsewhere).unwrap().count(), 1);
}

#[test]
fn an_installation_puts_each_file_where_it_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let mut out = Vec::new();
    install_below(&Registry::builtin(), dir.path(), &mut out).unwrap();
    for path in [
        "etc/udev/rules.d/99-rapid.rules",
        "etc/systemd/system/rapid.service",
        "etc/systemd/system/rapid-upload.service",
        "etc/systemd/system/rapid-upload.timer",
        "etc/systemd/system/rapid-upload-check.service",
        "etc/systemd/system/rapid-upload-check.timer",
        "etc/rapid/descriptors/cam_wrist.yaml",
        "etc/rapid/descriptors/motor_state.yaml",
        "etc/rapid/foxglove.json",
    ] {
        assert!(dir.path().join(path).is_file(), "{path}");
    }
}

#[test]
fn the_error_of_a_failing_udevadm_names_the_command() {
    let error = run("false", &["control", "--reload"]).unwrap_err().to_string();
    assert!(error.contains("`false control --reload` failed (exit status: 1"), "{error}");
    assert!(run("/nonexistent/udevadm", &[]).is_err());
    assert!(run("true", &[]).is_ok());
}
