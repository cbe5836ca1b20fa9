//! Getting the text of a configuration file, safely.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use crate::registry::diagnostic::RegistryErrors;
use crate::registry::section::file_label;
use crate::registry::trust::distrust;

/// No registry is this large; the wrong file may be.
const LARGEST: u64 = 1 << 20;

/// The text of a file a person wrote. `when_missing` is the fix when there is none.
///
/// # Errors
/// When it cannot be read, is no ordinary file of text, or may be changed by others while we are root.
pub fn read_file(path: &Path, when_missing: &str) -> Result<String, RegistryErrors> {
    let label = file_label(Some(path), "");
    let problem = |message: String, fix: String| RegistryErrors::whole_file(label.clone(), message, fix);
    // Without waiting: opening a named pipe would wait for its writer.
    let opened = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(path);
    let mut file: File = opened.map_err(|error| match error.kind() {
        ErrorKind::NotFound => problem("there is no such file".to_owned(), when_missing.to_owned()),
        ErrorKind::PermissionDenied => problem(
            "it may not be read by this user".to_owned(),
            format!("ls -l {label} shows who may; chmod a+r {label} lets everyone"),
        ),
        _ => problem(format!("it cannot be opened: {error}"), "name another file".to_owned()),
    })?;
    let cannot_read =
        |error: std::io::Error| problem(format!("it cannot be read: {error}"), "name another file".into());
    let metadata = file.metadata().map_err(cannot_read)?;
    if metadata.is_dir() {
        return Err(problem("it is a directory".to_owned(), format!("name the file in it: {label}/devices.toml")));
    }
    if !metadata.is_file() {
        return Err(problem("it is not a regular file".to_owned(), "name a file on disk".to_owned()));
    }
    // As root we run with rights that whoever may change the file would gain.
    if rustix::process::geteuid().is_root()
        && let Some(reason) = distrust(path).map_err(cannot_read)?
    {
        return Err(problem(reason.to_string(), reason.fix()));
    }
    let mut bytes = Vec::new();
    file.by_ref().take(LARGEST + 1).read_to_end(&mut bytes).map_err(cannot_read)?;
    if bytes.len() as u64 > LARGEST {
        return Err(problem("it is larger than 1MiB".to_owned(), "is it the right file?".to_owned()));
    }
    String::from_utf8(bytes).map_err(|error| {
        let line = error.as_bytes().iter().take(error.utf8_error().valid_up_to()).filter(|b| **b == b'\n').count() + 1;
        problem(format!("it is not UTF-8 text (line {line})"), format!("iconv -f latin1 -t utf-8 {label}"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_text_file_is_refused_with_a_reason() {
        let dir = tempfile::tempdir().unwrap();
        let message = |path: &Path| read_file(path, "write one").unwrap_err().to_string();
        let missing = dir.path().join("none.toml");
        assert_eq!(message(&missing), format!("{}: there is no such file\n    fix: write one", missing.display()));
        assert!(message(dir.path()).contains("it is a directory"));
        let path = dir.path().join("devices.toml");
        std::fs::write(&path, b"a = 1\nb = \"\xff\"\n").unwrap();
        assert!(message(&path).contains("it is not UTF-8 text (line 2)"), "{}", message(&path));
        std::fs::write(&path, vec![b'#'; 1 + (1 << 20)]).unwrap();
        assert!(message(&path).contains("larger than 1MiB"));
        std::fs::write(&path, "a = 1\n").unwrap();
        assert_eq!(read_file(&path, "").unwrap(), "a = 1\n");
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o666)).unwrap();
        let is_root = rustix::process::geteuid().is_root();
        assert_eq!(read_file(&path, "").is_err(), is_root, "only root distrusts a file all may write");
        let pipe = dir.path().join("pipe");
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, 0o600.into(), 0).unwrap();
        assert!(message(&pipe).contains("not a regular file"));
    }
}
