//! Where the registry lies that no option names.

use std::path::PathBuf;

use super::failure::Failure;
use crate::cli::Global;

/// The registry that is used.
///
/// # Errors
/// When there is none.
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

fn usual_places() -> Vec<PathBuf> {
    let home = || std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".config"));
    let config = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|path| path.is_absolute());
    let mut places = vec![PathBuf::from("devices.toml")];
    places.extend(config.or_else(home).map(|folder| folder.join("rapid/devices.toml")));
    places.push(PathBuf::from("/etc/rapid/devices.toml"));
    places
}
