//! Which registry is meant.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::failure::Failure;
use super::stderr_palette;
use crate::cli::Global;
use crate::registry::Registry;

pub(super) fn registry_or_builtin(global: &Global) -> Result<Registry, Failure> {
    find_registry(global).map_or_else(|| Ok(Registry::builtin()), |path| load(&path))
}

/// Reads a registry; its warnings go to standard error.
pub(super) fn load(path: &Path) -> Result<Registry, Failure> {
    let loaded = Registry::load(path)?;
    for warning in &loaded.warnings {
        let _ = writeln!(io::stderr(), "{} {warning}", stderr_palette().warn("warning:"));
    }
    Ok(loaded.registry)
}

pub(super) fn registry_path(global: &Global) -> Result<PathBuf, Failure> {
    find_registry(global).ok_or_else(|| Failure::NoRegistry(usual_places()))
}

/// The registry named, or the first of the usual places where there is one.
pub(super) fn find_registry(global: &Global) -> Option<PathBuf> {
    if let Some(path) = &global.config {
        return Some(path.clone());
    }
    usual_places().into_iter().find(|path| path.exists())
}

pub(super) fn usual_places() -> Vec<PathBuf> {
    let home = || std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".config"));
    let config = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|path| path.is_absolute());
    let mut places = vec![PathBuf::from("devices.toml")];
    places.extend(config.or_else(home).map(|folder| folder.join("rapid/devices.toml")));
    places.push(PathBuf::from("/etc/rapid/devices.toml"));
    places
}
