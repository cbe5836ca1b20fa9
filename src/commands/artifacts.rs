//! `rapid artifacts`: writes the files derived from the registry, and installs them.
//!
//! Invariant: as root no symbolic link is followed on the way to a file, and files are replaced
//! atomically, by rename.
//! Invariant: other programs are started with argument vectors, never through a shell.

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

use rapid_registry::Registry;
use rapid_registry::system_files::{DESCRIPTORS, HEADER, SYSTEM_REGISTRY, SystemFile, SystemFileKind, system_files};
use rapid_system::folder::{Folder, FolderError, Links, Missing, Sync};

/// Why the system files could not be written or installed.
#[derive(Debug, thiserror::Error)]
pub enum ArtifactsError {
    /// Only root may write where udev and systemd read.
    #[error("installing needs root: run `sudo rapid artifacts --install`")]
    NotRoot,
    /// The folder cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A file could not be written.
    #[error("{path}: {error}")]
    Write {
        /// Which.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// udev did not accept the rules.
    #[error("the files are installed, but `{command}` failed ({error}): run it by hand, or restart the machine")]
    Reload {
        /// What was run.
        command: String,
        /// How it ended.
        error: String,
    },
    /// The listing could not be written.
    #[error("output: {0}")]
    Output(#[from] io::Error),
}

/// Writes the system files below `folder` (`udev` by default) and deletes descriptors of entries that no longer
/// exist.
///
/// # Errors
/// When a file cannot be written.
pub fn write(registry: &Registry, folder: &Path, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    let place = |file: &SystemFile| folder.join(&file.path);
    put(registry, place, &folder.join(DESCRIPTORS), links_for_this_user(), "wrote", out)
}

/// Installs the system files where udev and systemd read them, and makes udev apply the rules.
///
/// # Errors
/// When not root, or when a file cannot be written, or when udev does not accept the rules.
pub fn install(registry: &Registry, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    if !rustix::process::geteuid().is_root() {
        return Err(ArtifactsError::NotRoot);
    }
    install_below(registry, Path::new("/"), out)?;
    for arguments in [
        ["control", "--reload"].as_slice(),
        &["trigger", "--action=change", "--subsystem-match=video4linux", "--subsystem-match=tty"],
        // Only CAN interfaces: the rules match no others.
        &["trigger", "--action=add", "--subsystem-match=net", "--attr-match=type=280"],
    ] {
        run("udevadm", arguments)?;
    }
    writeln!(out, "udev applies the rules")?;
    let current = std::fs::read_to_string(SYSTEM_REGISTRY).unwrap_or_default();
    if current != registry.text {
        writeln!(out, "the service reads {SYSTEM_REGISTRY}, which is not this registry: copy it there")?;
    }
    writeln!(out, "to record from boot: systemctl daemon-reload && systemctl enable --now rapid")?;
    Ok(())
}

/// Installs below `root`, which is `/` except in tests.
fn install_below(registry: &Registry, root: &Path, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    let descriptors = root.join("etc/rapid").join(DESCRIPTORS);
    let place = |file: &SystemFile| {
        let folder = match file.kind {
            SystemFileKind::Rules => root.join("etc/udev/rules.d"),
            SystemFileKind::Unit => root.join("etc/systemd/system"),
            SystemFileKind::Descriptor => descriptors.clone(),
            SystemFileKind::Layout => root.join("etc/rapid"),
        };
        folder.join(file.path.file_name().unwrap_or_default())
    };
    put(registry, place, &descriptors, Links::Refused, "installed", out)
}

/// Writes each file to its place, and deletes descriptors of entries that no longer exist.
fn put(
    registry: &Registry,
    place: impl Fn(&SystemFile) -> PathBuf,
    descriptors: &Path,
    links: Links,
    done: &str,
    out: &mut dyn Write,
) -> Result<(), ArtifactsError> {
    let all = system_files(registry);
    for file in &all {
        let path = place(file);
        write_file(&path, file.contents.as_bytes(), file.mode, links)?;
        writeln!(out, "{done} {}", path.display())?;
    }
    remove_stale(descriptors, &all, links, out)
}

/// A link planted in a folder that others may write to would redirect the writes of root.
pub(super) fn links_for_this_user() -> Links {
    if rustix::process::geteuid().is_root() { Links::Refused } else { Links::Own }
}

pub(super) fn write_file(path: &Path, contents: &[u8], mode: u32, links: Links) -> Result<(), ArtifactsError> {
    let folder = Folder::open(path.parent().unwrap_or(Path::new(".")), links, Missing::All)?;
    let name = path.file_name().unwrap_or_default();
    let written = folder.replace(name, contents, mode, Sync::Wait);
    written.map_err(|error| ArtifactsError::Write { path: path.to_path_buf(), error })
}

/// Deletes descriptors written for entries that no longer exist.
fn remove_stale(path: &Path, all: &[SystemFile], links: Links, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    let explain = |error: io::Error| ArtifactsError::Write { path: path.to_path_buf(), error };
    let folder = Folder::open(path, links, Missing::All)?;
    let entries = rustix::fs::Dir::read_from(folder.descriptor()).map_err(|errno| explain(errno.into()))?;
    for entry in entries {
        let entry = entry.map_err(|errno| explain(errno.into()))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let current = all.iter().any(|file| file.path.file_name().is_some_and(|file| *file == *name));
        if current
            || Path::new(&name).extension().is_none_or(|extension| extension != "yaml")
            || !is_ours(&folder, &name)
        {
            continue;
        }
        folder.remove(&name).map_err(explain)?;
        writeln!(out, "removed {}: the entry no longer exists", path.join(name.escape_debug().to_string()).display())?;
    }
    Ok(())
}

fn is_ours(folder: &Folder, name: &str) -> bool {
    let Ok(file) = folder.open_file(name) else { return false };
    let mut begin = Vec::new();
    let read = file.take(HEADER.len() as u64).read_to_end(&mut begin);
    read.is_ok() && begin == HEADER.as_bytes()
}

fn run(program: &str, arguments: &[&str]) -> Result<(), ArtifactsError> {
    let command = format!("{program} {}", arguments.join(" "));
    match Command::new(program).args(arguments).output() {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => {
            let stderr = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            Err(ArtifactsError::Reload { command, error: format!("{}: {stderr}", output.status) })
        }
        Err(error) => Err(ArtifactsError::Reload { command, error: error.to_string() }),
    }
}

#[cfg(test)]
mod tests;
