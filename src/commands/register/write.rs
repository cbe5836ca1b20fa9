//! Writing `devices.toml`, and the files that follow from it.
//!
//! Invariant: nothing is written that the parser does not take.
//! Invariant: the file is replaced whole, and only if it still says what was read.

use std::io::Write;
use std::path::{Path, PathBuf};

use super::RegisterError;
use crate::commands::artifacts;
use crate::folder::{Folder, Links, Missing, Sync};
use crate::registry::{Loaded, Registry, RegistryErrors, edit, read_file};

/// What a `devices.toml` begins with that we make.
const FIRST_LINES: &str = "\
# The devices of this rig: the one place where a device is made known to rapid. `rapid check` says what
# is wrong with it, `rapid artifacts` writes the udev rules that follow from it.
";

/// The registry to be changed.
#[derive(Debug)]
pub struct Target {
    /// The file.
    pub path: PathBuf,
    /// What it says; empty if it is to be made.
    pub text: String,
    /// What that means; `None` as long as no device is registered.
    pub registry: Option<Registry>,
}

impl Target {
    /// Reads the file at `path`; one that is not there is to be made.
    ///
    /// # Errors
    /// When it cannot be read or is wrong already.
    pub fn read(path: PathBuf) -> Result<Self, RegistryErrors> {
        if !path.exists() {
            return Ok(Self { path, text: String::new(), registry: None });
        }
        let text = read_file(&path, "name another with --config FILE")?;
        let registry = match Registry::parse(&text, Some(&path)) {
            Ok(loaded) => Some(loaded.registry),
            // It says what holds for all devices, and names none yet.
            Err(_) if edit::has_no_entries(&text) => None,
            Err(wrong) => return Err(wrong),
        };
        Ok(Self { path, text, registry })
    }

    /// The text that a new entry is added to.
    pub(super) fn base(&self) -> &str {
        if self.text.is_empty() { FIRST_LINES } else { &self.text }
    }

    /// What the file would mean if it said `new`.
    pub(super) fn parse(&self, new: &str) -> Result<Loaded, RegistryErrors> {
        Registry::parse(new, Some(&self.path))
    }

    /// Gives the file this text, and writes the artifacts beside it.
    pub(super) fn write(&self, new: &str, registry: &Registry, out: &mut dyn Write) -> Result<(), RegisterError> {
        let io = |error| RegisterError::File { path: self.path.clone(), error };
        // A link to the file stays one.
        let path = if self.path.exists() { self.path.canonicalize().map_err(io)? } else { self.path.clone() };
        let parent = path.parent().filter(|parent| *parent != Path::new("")).unwrap_or(Path::new("."));
        let name = path.file_name().unwrap_or_default();
        let folder = Folder::open(parent, Links::Own, Missing::Last)?;
        let (mode, owner) = match folder.open_file(name).and_then(|file| file.metadata()) {
            Ok(found) => {
                use std::os::unix::fs::MetadataExt;
                (found.mode() & 0o777, Some((found.uid(), found.gid())))
            }
            Err(_) => (0o644, None),
        };
        let now = if owner.is_some() { std::fs::read_to_string(&path).map_err(io)? } else { String::new() };
        if now != self.text {
            return Err(RegisterError::Changed(self.path.clone()));
        }
        folder.replace(name, new.as_bytes(), mode, Sync::Wait).map_err(io)?;
        if let Some((user, group)) = owner.filter(|_| rustix::process::geteuid().is_root()) {
            // The file of a user stays theirs when root changes it.
            let (user, group) = (rustix::fs::Uid::from_raw(user), rustix::fs::Gid::from_raw(group));
            let flags = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
            rustix::fs::chownat(folder.descriptor(), name, Some(user), Some(group), flags).map_err(|e| io(e.into()))?;
        }
        writeln!(out, "wrote {}", self.path.display())?;
        Ok(artifacts::write(registry, &parent.join("udev"), out)?)
    }
}
