//! Files that follow from the registry: udev rules, module descriptors, the systemd unit.
//!
//! Pure: what to write, not where or how (`commands::artifacts` writes).
//!
//! Invariant: a serial number, which a device chose, can neither add a line to a file nor match
//! more than itself; where a format cannot say it, the file says so in a comment.

mod descriptor;
mod rules;
mod unit;

use std::path::PathBuf;

use super::spec::Registry;
pub use unit::SYSTEM_REGISTRY;

/// First line of every file written here: a file that begins otherwise is not ours to remove.
pub const HEADER: &str = "# Written by `rapid artifacts` from devices.toml: change that file and run it again.";

/// Folder of the descriptors among the artifacts.
pub const DESCRIPTORS: &str = "descriptors";

/// One file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Artifact {
    /// Relative to the folder of artifacts, `udev/` in the repository.
    pub path: PathBuf,
    /// Its text.
    pub contents: String,
    /// Its permissions.
    pub mode: u32,
    /// What it is for.
    pub kind: ArtifactKind,
}

/// What a file is for; decides where it is installed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArtifactKind {
    /// udev rules.
    Rules,
    /// systemd unit.
    Unit,
    /// Descriptor of one module.
    Descriptor,
}

/// Every file that follows from `registry`.
#[must_use]
pub fn artifacts(registry: &Registry) -> Vec<Artifact> {
    let artifact = |path: PathBuf, contents, kind| Artifact { path, contents, mode: 0o644, kind };
    let mut all = vec![
        artifact("99-rapid.rules".into(), rules::rules(registry), ArtifactKind::Rules),
        artifact("rapid.service".into(), unit::unit(registry), ArtifactKind::Unit),
    ];
    for device in &registry.devices {
        let path = PathBuf::from(DESCRIPTORS).join(format!("{}.yaml", device.name));
        let stable_path = rules::identify(registry, device).ok().map(|_| format!("/dev/rapid/{}", device.name));
        all.push(artifact(path, descriptor::descriptor(device, stable_path.as_deref()), ArtifactKind::Descriptor));
    }
    all
}

#[cfg(test)]
mod tests;
