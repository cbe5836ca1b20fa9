//! Registration: entries of `devices.toml` for connected devices, by a command or by a request to a run.
//!
//! Owns the file while it is changed. `registry::edit` makes the text, `registry::candidate` knows the units.
//!
//! Invariant: nothing is written that the parser rejects.
//! Invariant: the file is replaced atomically, and only if it has not changed since it was read.

pub mod settings;

use std::io;
use std::path::{Path, PathBuf};

use rapid_core::text;
use rapid_devices::driver::camera::query;
use rapid_registry::candidate::{Candidate, unregistered};
use rapid_registry::device::{Attachment, DeviceNode};
use rapid_registry::edit::{self, EditError, NewEntry, Setting};
use rapid_registry::{Loaded, Registry, RegistryErrors, name_problem, read_file};
use rapid_system::folder::{Folder, FolderError, Links, Missing, Sync};

/// Why the file was not written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// Another program changed the file meanwhile.
    #[error("{}: it has changed since it was read; nothing was written: try again", .0.display())]
    Changed(PathBuf),
    /// The file cannot be read or written.
    #[error("{}: {error}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// The file was made read-only.
    #[error("{}: it is read-only; nothing was written: `chmod u+w` it, or name another registry with --config", .0.display())]
    ReadOnly(PathBuf),
    /// The folder of the file cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
}

/// Why a device was not registered by a request.
#[derive(Debug, thiserror::Error)]
pub enum RegistrationError {
    /// The file cannot be read, or the new text would not be a registry.
    #[error("{0}\nnothing was written")]
    Registry(#[from] RegistryErrors),
    /// A key cannot be written.
    #[error(transparent)]
    Edit(#[from] EditError),
    /// The name is not allowed, or taken.
    #[error("{0}: {1}")]
    Name(String, String),
    /// It is not connected any more, or registered meanwhile.
    #[error("{0}: it is not plugged in, or it is already registered")]
    NoDevice(String),
    /// Only a program could read it.
    #[error("{0}: no driver reads it; write its entry with `rapid register`, with a program as its node")]
    NoDriver(String),
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// The first lines of a new `devices.toml`.
const FIRST_LINES: &str = "\
# The devices of this rig, declared here and nowhere else. `rapid check` lists mistakes, `rapid artifacts`
# writes the udev rules.
";

/// The registry to be changed.
#[derive(Debug)]
pub struct Target {
    /// The file.
    pub path: PathBuf,
    /// Its text; empty if it does not exist yet.
    pub text: String,
    /// The parsed text; `None` while no device is registered.
    pub registry: Option<Registry>,
}

impl Target {
    /// Reads the file at `path`, which may be missing: it is created later.
    ///
    /// # Errors
    /// When it cannot be read or is already invalid.
    pub fn read(path: PathBuf) -> Result<Self, RegistryErrors> {
        if !path.exists() {
            return Ok(Self { path, text: String::new(), registry: None });
        }
        let text = read_file(&path, "name another with --config FILE")?;
        let registry = match Registry::parse(&text, Some(&path)) {
            Ok(loaded) => Some(loaded.registry),
            // It has settings for all devices, and no device yet.
            Err(_) if edit::has_no_entries(&text) => None,
            Err(wrong) => return Err(wrong),
        };
        Ok(Self { path, text, registry })
    }

    /// The text that a new entry is added to.
    pub fn base(&self) -> String {
        if self.text.is_empty() { FIRST_LINES.to_owned() } else { edit::renamed(&self.text) }
    }

    /// Parses `new` as the text of the file.
    ///
    /// # Errors
    /// All problems of the text.
    pub fn parse(&self, new: &str) -> Result<Loaded, RegistryErrors> {
        Registry::parse(new, Some(&self.path))
    }

    /// Writes this text, which the parser accepts, to the file. Returns its folder.
    ///
    /// # Errors
    /// When the file has changed since it was read, or cannot be written.
    pub fn write(&self, new: &str) -> Result<PathBuf, WriteError> {
        let io = |error| WriteError::File { path: self.path.clone(), error };
        // A symbolic link to the file is kept.
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
        // It would be replaced, and root may write to anything: the mode is the wish of whoever set it.
        if mode & 0o222 == 0 {
            return Err(WriteError::ReadOnly(self.path.clone()));
        }
        let now = if owner.is_some() { std::fs::read_to_string(&path).map_err(io)? } else { String::new() };
        if now != self.text {
            return Err(WriteError::Changed(self.path.clone()));
        }
        folder.replace(name, new.as_bytes(), mode, Sync::Wait).map_err(io)?;
        if let Some((user, group)) = owner.filter(|_| rustix::process::geteuid().is_root()) {
            // A user's file keeps its owner when root changes it.
            let (user, group) = (rustix::fs::Uid::from_raw(user), rustix::fs::Gid::from_raw(group));
            let flags = rustix::fs::AtFlags::SYMLINK_NOFOLLOW;
            rustix::fs::chownat(folder.descriptor(), name, Some(user), Some(group), flags).map_err(|e| io(e.into()))?;
        }
        Ok(parent.to_owned())
    }
}

/// Adds an entry `name` to the registry at `path` for the connected unit that [`Candidate::describe`] describes as
/// `device`, in plain text, with what the unit itself suggests. Blocks: it reads and writes files, and asks a camera for its formats.
///
/// # Errors
/// When there is no such unit among `attached`, or the entry cannot be added; then nothing is written.
pub fn register(path: &Path, attached: &[Attachment], device: &str, name: &str) -> Result<(), RegistrationError> {
    let target = Target::read(path.to_owned())?;
    let units = unregistered(target.registry.as_ref(), attached);
    let unit = units.iter().find(|unit| text::plain(&unit.describe()) == device);
    let unit = unit.ok_or_else(|| RegistrationError::NoDevice(device.to_owned()))?;
    if let Some((message, fix)) = name_problem(name) {
        return Err(RegistrationError::Name(message, fix));
    }
    if target.registry.as_ref().is_some_and(|registry| registry.named(name).is_some()) {
        return Err(RegistrationError::Name(
            format!("[device.{name}] already exists"),
            "choose another name".to_owned(),
        ));
    }
    let node = unit.guess().ok_or_else(|| RegistrationError::NoDriver(device.to_owned()))?;
    let text = |key: &str, value: String| (key.to_owned(), Setting::Text(value));
    let mut keys = vec![text("vid", format!("{:04x}", unit.usb.vid)), text("pid", format!("{:04x}", unit.usb.pid))];
    keys.extend(unit.identity().map(|(key, value)| text(key, value)));
    keys.push(text("node", node.to_owned()));
    keys.extend(free_bit(target.registry.as_ref(), &[]).map(|bit| ("bit".to_owned(), Setting::Whole(bit.into()))));
    if let Some(attachment) = unit.node(node) {
        let camera = if let DeviceNode::Video(path) = &attachment.node { query(path).ok() } else { None };
        let suggested = settings::suggested(&attachment.node, camera.as_ref());
        if suggested.is_empty() && matches!(attachment.node, DeviceNode::Tty(_)) {
            // Its lines are not known: its bytes are recorded as they come.
            keys.push(text("tty.parse", "raw".to_owned()));
        }
        keys.extend(suggested);
    }
    let entry = NewEntry { name: name.to_owned(), comments: comments(Some(unit)), keys, held_back: None };
    let new = edit::append(&target.base(), &[entry])?;
    target.parse(&new)?;
    target.write(&new)?;
    Ok(())
}

/// The comment above the entry of a unit: its product.
pub fn comments(unit: Option<&Candidate>) -> Vec<String> {
    let product =
        unit.and_then(|unit| unit.usb.product.as_deref()).map(|product| text::plain(product).trim().to_owned());
    product.filter(|product| !product.is_empty()).into_iter().collect()
}

/// The lowest unused bit.
pub fn free_bit(registry: Option<&Registry>, besides: &[u8]) -> Option<u8> {
    let devices = registry.map(|registry| registry.devices.as_slice()).unwrap_or_default();
    (0..64).find(|bit| !besides.contains(bit) && !devices.iter().any(|device| device.id.bit() == *bit))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rapid_core::time::Stamp;
    use rapid_registry::BUILTIN;
    use rapid_registry::device::{Unit, UsbIdentity};
    use rapid_registry::simulation::{SimDevice, SimSource};

    use super::*;

    #[test]
    fn a_registry_that_was_made_read_only_is_not_replaced() {
        use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("devices.toml");
        std::fs::write(&path, BUILTIN).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o444)).unwrap();
        let before = path.metadata().unwrap().ino();
        let target = Target::read(path.clone()).unwrap();
        let why = target.write(&format!("{BUILTIN}# more\n")).unwrap_err().to_string();
        assert!(why.contains("devices.toml: it is read-only; nothing was written: `chmod u+w`"), "{why}");
        assert_eq!(path.metadata().unwrap().ino(), before);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), BUILTIN);
    }

    #[test]
    fn a_described_unit_is_registered_once_with_what_it_suggests() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("devices.toml");
        std::fs::write(&path, BUILTIN).unwrap();
        let text = || std::fs::read_to_string(&path).unwrap();
        let source = SimSource::Camera { width: 320, height: 240, fps: 15, seed: 1, bytes: 0 };
        let node = DeviceNode::Sim(Arc::new(SimDevice::new("spare", source, Stamp::now())));
        let product = Some("Spare\u{1b}[2J Camera".to_owned());
        let usb = UsbIdentity {
            vid: 7,
            pid: 8,
            serial: Some("S".into()),
            port: "1-4".into(),
            product,
            ..UsbIdentity::default()
        };
        let attached =
            [Attachment { syspath: "/sim/1-4".into(), node, unit: Unit::Usb(usb), driver: None, formats: Vec::new() }];
        let units = unregistered(Some(&Registry::builtin()), &attached);
        // As the board shows it.
        let device = text::plain(&units[0].describe()).into_owned();
        for (device, name, reason) in [
            ("0007:0008", "spare", "it is not plugged in, or it is already registered"),
            (device.as_str(), "Not a Name", "Not a Name"),
            (&device, "cam_wrist", "[device.cam_wrist] already exists"),
        ] {
            let why = register(&path, &attached, device, name).unwrap_err().to_string();
            assert!(why.contains(reason), "{why}");
            assert_eq!(text(), BUILTIN);
        }
        register(&path, &attached, &device, "spare").unwrap();
        let added = text().strip_prefix(BUILTIN).unwrap().to_owned();
        let keys = "vid = \"0007\"\npid = \"0008\"\nserial = \"S\"\nnode = \"camera\"\nbit = 3\n";
        assert!(added.contains(&format!("[device.spare]\n{keys}")) && added.contains("fps = 15"), "{added}");
        let again = register(&path, &attached, &device, "other").unwrap_err();
        assert!(matches!(again, RegistrationError::NoDevice(_)), "{again}");
    }
}
