//! Whether the previews of GoPros can be decoded.

use std::ffi::OsStr;

use rapid_registry::{DeviceSpec, LanProtocol, LanSpec, NodeSpec, PREVIEW_DECODER as DECODER};

use super::finding::Finding;

/// Whether there is such a program in the folders of `path`.
pub(super) fn is_on(path: Option<&OsStr>) -> bool {
    path.is_some_and(|path| std::env::split_paths(path).any(|folder| folder.join(DECODER).is_file()))
}

/// Of the entries that have a preview.
pub(super) fn decoder(is_there: bool, entries: &[DeviceSpec]) -> Option<Finding> {
    let has_preview = |entry: &&DeviceSpec| {
        let NodeSpec::Lan(LanSpec { protocol: LanProtocol::Gopro { preview, .. }, .. }) = &entry.node else {
            return false;
        };
        preview.is_some()
    };
    let names: Vec<_> = entries.iter().filter(has_preview).map(|entry| format!("[device.{}]", entry.name)).collect();
    if names.is_empty() {
        return None;
    }
    let names = names.join(", ");
    Some(if is_there {
        Finding::ok("preview", format!("{DECODER} decodes the preview of {names}"))
    } else {
        let what = format!("the preview of {names} needs {DECODER}, which is not on PATH: only clips are recorded");
        Finding::warn("preview", what, format!("sudo apt install {DECODER}"))
    })
}
