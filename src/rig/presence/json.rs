//! The mask for people: JSON beside the binary record (paper, appendix "Physical Mask Data Format").

use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::PresenceError;
use crate::mask::PhysicalMask;
use crate::modality::ModalityId;
use crate::status::SlotState;
use crate::time::{realtime_ns, rfc3339};

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
    /// State of its slot.
    pub state: SlotState,
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
#[must_use]
pub fn json_path(mask: &Path) -> PathBuf {
    let mut name = mask.as_os_str().to_owned();
    name.push(".json");
    PathBuf::from(name)
}

/// Writes a temporary file and renames it: a reader sees a whole document or the one before.
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
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(format!(".{}.tmp", std::process::id()));
    let temporary = PathBuf::from(temporary);
    // A leftover of a process that had this pid before, or a link planted by somebody else, goes;
    // `create_new` follows none.
    let _ = std::fs::remove_file(&temporary);
    let mut file = std::fs::OpenOptions::new().write(true).create_new(true).open(&temporary).map_err(io)?;
    let written = file.write_all(&text).and_then(|()| std::fs::rename(&temporary, path));
    if written.is_err() {
        // Shared memory may be full: leave it no fuller than it was.
        let _ = std::fs::remove_file(&temporary);
    }
    written.map_err(io)
}
