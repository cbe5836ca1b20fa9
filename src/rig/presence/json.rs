//! The mask for people: JSON beside the binary record (paper, appendix "Physical Mask Data Format").

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rapid_core::mask::PhysicalMask;
use rapid_core::modality::ModalityId;
use rapid_core::time::{realtime_ns, rfc3339};
use rapid_status::DeviceState;
use rapid_system::folder::{Folder, Links, Missing, Sync};
use serde::Serialize;

use super::PresenceError;

/// One device of the JSON file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JsonDevice {
    /// Name of the modality.
    pub name: String,
    /// Its bit.
    pub bit: ModalityId,
    /// Is the bit set?
    pub online: bool,
    /// Is the device attached?
    pub usb_connected: bool,
    /// State of its device.
    pub state: DeviceState,
}

#[derive(Serialize)]
struct Document<'a> {
    timestamp: String,
    pid: u32,
    device_count: usize,
    online_count: u32,
    mask: String,
    mask_binary: String,
    sequence: u64,
    devices: &'a [JsonDevice],
}

/// The JSON file that belongs to a mask file.
pub fn json_path(mask: &Path) -> PathBuf {
    let mut name = mask.as_os_str().to_owned();
    name.push(".json");
    PathBuf::from(name)
}

/// Writes the document atomically: a reader sees this document or the previous one, never a part.
pub(super) fn write(
    path: &Path,
    mask: PhysicalMask,
    sequence: u64,
    devices: &[JsonDevice],
) -> Result<(), PresenceError> {
    let document = Document {
        timestamp: rfc3339(realtime_ns()),
        pid: std::process::id(),
        device_count: devices.len(),
        online_count: mask.online_count(),
        mask: mask.hex(devices.len()),
        mask_binary: mask.binary(devices.len()),
        sequence,
        devices,
    };
    let io = |error| PresenceError::Io { path: path.to_owned(), error };
    let mut text = serde_json::to_vec_pretty(&document).map_err(|error| io(error.into()))?;
    text.push(b'\n');
    folder(path)?.replace(path.file_name().unwrap_or_default(), &text, 0o644, Sync::Skip).map_err(io)
}

/// Whether the name is free, or held by a file of ours that may be replaced.
pub(super) fn claim(path: &Path) -> Result<(), PresenceError> {
    let foreign = |what| Err(PresenceError::Foreign { path: path.to_owned(), what });
    // Anything planted between this check and the first document is found by the write.
    match std::fs::symlink_metadata(path) {
        Ok(there) if !there.is_file() => foreign("it is not an ordinary file".to_owned()),
        Ok(there) if there.uid() != rustix::process::geteuid().as_raw() => {
            foreign(format!("it belongs to user {}: another user's rapid left it behind", there.uid()))
        }
        _ => Ok(()),
    }
}

fn folder(path: &Path) -> Result<Folder, PresenceError> {
    Ok(Folder::open(path.parent().unwrap_or(Path::new("/")), Links::Own, Missing::Refused)?)
}
