//! `rapid artifacts`: writes the files that follow from the registry, and installs them.
//!
//! Invariant: as root no symbolic link is followed on the way to a file, and a file is replaced
//! whole, by rename.
//! Invariant: other programs are started with argument vectors, never through a shell.

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::path::{Component, Path, PathBuf};
use std::process::Command;

use rustix::fs::{AtFlags, Mode, OFlags};
use rustix::io::Errno;

use super::Format;
use crate::registry::Registry;
use crate::registry::artifacts::{Artifact, ArtifactKind, DESCRIPTORS, HEADER, SYSTEM_REGISTRY, artifacts};
use crate::time::realtime_ns;

/// Why the artifacts could not be written or installed.
#[derive(Debug, thiserror::Error)]
pub enum ArtifactsError {
    /// Only root may write where udev and systemd read.
    #[error("installing needs root: run `sudo rapid artifacts --install`")]
    NotRoot,
    /// A part of the path is a symbolic link and we are root.
    #[error("{path}: a part of this path is a symbolic link, which is not followed as root; name the real folder")]
    Link {
        /// Where.
        path: PathBuf,
    },
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
    let links = Links::for_this_user();
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

/// May folders on the way be symbolic links?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Links {
    Followed,
    Refused,
}

impl Links {
    /// A link planted in a folder others may write to would lead root's writing elsewhere.
    fn for_this_user() -> Self {
        if rustix::process::geteuid().is_root() { Self::Refused } else { Self::Followed }
    }
}

fn write_file(path: &Path, artifact: &Artifact, links: Links) -> Result<(), ArtifactsError> {
    let explain = |errno: Errno| explain(path, errno, links);
    let folder = open_folder(path.parent().unwrap_or(Path::new(".")), links).map_err(explain)?;
    let name = path.file_name().unwrap_or_default();
    let temporary = format!(".{}.{}.{}", name.to_string_lossy(), std::process::id(), realtime_ns());
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let mode = Mode::from_raw_mode(artifact.mode);
    let file = rustix::fs::openat(&folder, &temporary, flags, mode).map_err(explain)?;
    let written = fill(file, artifact, mode)
        .and_then(|()| rustix::fs::renameat(&folder, &temporary, &folder, name).map_err(io::Error::from));
    written.map_err(|error| {
        // What was begun is of no use to anyone; the first error is the one to tell.
        let _ = rustix::fs::unlinkat(&folder, &temporary, AtFlags::empty());
        ArtifactsError::Write { path: path.to_path_buf(), error }
    })
}

fn fill(file: OwnedFd, artifact: &Artifact, mode: Mode) -> io::Result<()> {
    let mut file = File::from(file);
    file.write_all(artifact.contents.as_bytes())?;
    // The umask may have taken bits away.
    rustix::fs::fchmod(&file, mode)?;
    file.sync_all()
}

/// Opens a folder, making what is missing of it.
fn open_folder(path: &Path, links: Links) -> Result<OwnedFd, Errno> {
    let mut flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
    let start = if path.is_absolute() { "/" } else { "." };
    let mut folder = rustix::fs::open(start, flags, Mode::empty())?;
    if links == Links::Refused {
        flags |= OFlags::NOFOLLOW;
    }
    for component in path.components() {
        let name = match component {
            Component::Normal(name) => name,
            Component::ParentDir => "..".as_ref(),
            _ => continue,
        };
        folder = match rustix::fs::openat(&folder, name, flags, Mode::empty()) {
            Err(Errno::NOENT) => {
                match rustix::fs::mkdirat(&folder, name, Mode::from_raw_mode(0o755)) {
                    Ok(()) | Err(Errno::EXIST) => {}
                    Err(error) => return Err(error),
                }
                rustix::fs::openat(&folder, name, flags, Mode::empty())?
            }
            opened => opened?,
        };
    }
    Ok(folder)
}

fn explain(path: &Path, errno: Errno, links: Links) -> ArtifactsError {
    // O_DIRECTORY with O_NOFOLLOW answers a link with either.
    let is_link = links == Links::Refused && matches!(errno, Errno::LOOP | Errno::NOTDIR);
    let linked = path.ancestors().skip(1).find(|part| part.is_symlink());
    match linked.filter(|_| is_link) {
        Some(part) => ArtifactsError::Link { path: part.to_path_buf() },
        None => ArtifactsError::Write { path: path.to_path_buf(), error: errno.into() },
    }
}

/// Removes descriptors that we wrote for entries that are no more.
fn remove_stale(folder: &Path, all: &[Artifact], links: Links, out: &mut dyn Write) -> Result<(), ArtifactsError> {
    let explain = |errno: Errno| explain(folder, errno, links);
    let opened = open_folder(folder, links).map_err(explain)?;
    let entries = rustix::fs::Dir::read_from(&opened).map_err(explain)?;
    for entry in entries {
        let entry = entry.map_err(explain)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let current = all.iter().any(|artifact| artifact.path.file_name().is_some_and(|file| *file == *name));
        if current
            || Path::new(&name).extension().is_none_or(|extension| extension != "yaml")
            || !is_ours(&opened, &name)
        {
            continue;
        }
        rustix::fs::unlinkat(&opened, &name, AtFlags::empty()).map_err(explain)?;
        writeln!(out, "removed {}: no such entry any more", folder.join(name.escape_debug().to_string()).display())?;
    }
    Ok(())
}

fn is_ours(folder: &OwnedFd, name: &str) -> bool {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let Ok(file) = rustix::fs::openat(folder, name, flags, Mode::empty()) else { return false };
    let mut begin = Vec::new();
    let read = File::from(file).take(HEADER.len() as u64).read_to_end(&mut begin);
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
