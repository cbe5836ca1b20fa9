//! `rapid artifacts`: writes the files that follow from the registry, and installs them.
//!
//! Invariant: as root no symbolic link is followed on the way to a file, and a file is replaced
//! whole, by rename.
//! Invariant: other programs are started with argument vectors, never through a shell.

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

use super::Format;
use crate::folder::{Folder, FolderError, Links, Missing, Sync};
use crate::registry::Registry;
use crate::registry::artifacts::{Artifact, ArtifactKind, DESCRIPTORS, HEADER, SYSTEM_REGISTRY, artifacts};

/// Why the artifacts could not be written or installed.
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
    /// udev did not take the rules.
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

/// Writes the artifacts' names and texts to `out`, and nothing else.
///
/// # Errors
/// When `out` cannot be written to.
pub fn list(registry: &Registry, format: Format, out: &mut dyn Write) -> io::Result<()> {
    for artifact in artifacts(registry) {
        if format == Format::Json {
            let path = artifact.path.to_string_lossy();
            let line = serde_json::json!({ "kind": "artifact", "path": path, "contents": artifact.contents });
            writeln!(out, "{line}")?;
            continue;
        }
        writeln!(out, "--- {}", artifact.path.display())?;
        out.write_all(artifact.contents.as_bytes())?;
    }
    Ok(())
}

/// Writes the artifacts below `folder` (`udev` by default) and removes descriptors of entries that
/// are gone.
///
/// # Errors
/// When a file cannot be written.
pub fn write(registry: &Registry, folder: &Path, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    let links = links_for_this_user();
    let all = artifacts(registry);
    for artifact in &all {
        write_file(&folder.join(&artifact.path), artifact, links)?;
        writeln!(out, "wrote {}", folder.join(&artifact.path).display())?;
    }
    remove_stale(&folder.join(DESCRIPTORS), &all, links, out)
}

/// Installs the artifacts where udev and systemd read them, and makes udev apply the rules.
///
/// # Errors
/// When not root, or when a file cannot be written, or when udev does not take the rules.
pub fn install(registry: &Registry, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    if !rustix::process::geteuid().is_root() {
        return Err(ArtifactsError::NotRoot);
    }
    install_below(registry, Path::new("/"), out)?;
    for arguments in [
        ["control", "--reload"].as_slice(),
        &["trigger", "--action=change", "--subsystem-match=video4linux", "--subsystem-match=tty"],
        // CAN interfaces alone: others are none of ours.
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
    let all = artifacts(registry);
    let descriptors = root.join("etc/rapid").join(DESCRIPTORS);
    for artifact in &all {
        let folder = match artifact.kind {
            ArtifactKind::Rules => root.join("etc/udev/rules.d"),
            ArtifactKind::Unit => root.join("etc/systemd/system"),
            ArtifactKind::Descriptor => descriptors.clone(),
        };
        let path = folder.join(artifact.path.file_name().unwrap_or_default());
        write_file(&path, artifact, Links::Refused)?;
        writeln!(out, "installed {}", path.display())?;
    }
    remove_stale(&descriptors, &all, Links::Refused, out)
}

/// A link planted in a folder others may write to would lead root's writing elsewhere.
fn links_for_this_user() -> Links {
    if rustix::process::geteuid().is_root() { Links::Refused } else { Links::Own }
}

fn write_file(path: &Path, artifact: &Artifact, links: Links) -> Result<(), ArtifactsError> {
    let folder = Folder::open(path.parent().unwrap_or(Path::new(".")), links, Missing::All)?;
    let name = path.file_name().unwrap_or_default();
    let written = folder.replace(name, artifact.contents.as_bytes(), artifact.mode, Sync::Wait);
    written.map_err(|error| ArtifactsError::Write { path: path.to_path_buf(), error })
}

/// Removes descriptors that we wrote for entries that are no more.
fn remove_stale(path: &Path, all: &[Artifact], links: Links, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    let explain = |error: io::Error| ArtifactsError::Write { path: path.to_path_buf(), error };
    let folder = Folder::open(path, links, Missing::All)?;
    let entries = rustix::fs::Dir::read_from(folder.descriptor()).map_err(|errno| explain(errno.into()))?;
    for entry in entries {
        let entry = entry.map_err(|errno| explain(errno.into()))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let current = all.iter().any(|artifact| artifact.path.file_name().is_some_and(|file| *file == *name));
        if current
            || Path::new(&name).extension().is_none_or(|extension| extension != "yaml")
            || !is_ours(&folder, &name)
        {
            continue;
        }
        folder.remove(&name).map_err(explain)?;
        writeln!(out, "removed {}: no such entry any more", path.join(name.escape_debug().to_string()).display())?;
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
            let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            Err(ArtifactsError::Reload { command, error: format!("{}: {said}", output.status) })
        }
        Err(error) => Err(ArtifactsError::Reload { command, error: error.to_string() }),
    }
}

#[cfg(test)]
mod tests;
