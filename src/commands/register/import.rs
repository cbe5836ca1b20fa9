//! Importing the devices of `rapid_driver`.
//!
//! Its registry contains only how a device is found and what to run. The driver is derived from the device if
//! it is plugged in, or given by `--node`; an entry without either is written as a comment.

use std::path::Path;

use rapid_core::text;
use rapid_devices::driver::camera::query;
use rapid_registry::candidate::kind;
use rapid_registry::device::{Attachment, DeviceNode, UsbIdentity};
use rapid_registry::edit::{NewEntry, Setting};
use rapid_registry::import::{Foreign, devices, layout};
use rapid_registry::{RegistryErrors, like_a_name, name_problem, read_file};

use crate::registration::settings::suggested;
use crate::registration::{Target, free_bit};

/// Service types and their protocols (`aod321/iPhoneVIO`; OpenGoPro, "mDNS").
const PROTOCOLS: [(&str, &str); 2] = [("_iphonevio._tcp", "iphone"), ("_gopro-web._tcp", "gopro")];

/// Why nothing was imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// A file is invalid.
    #[error("{0}")]
    File(#[from] RegistryErrors),
    /// It lists no device.
    #[error("{0}: it lists no device")]
    Empty(String),
}

/// The entries for the devices of `file`.
pub(super) fn read(
    file: &Path,
    order: Option<&Path>,
    node: Option<&str>,
    attached: &[Attachment],
    target: &Target,
) -> Result<Vec<NewEntry>, ImportError> {
    let missing = "name the registry.toml of rapid_driver, usually ~/.config/rapid_driver/registry.toml";
    let found = devices(&read_file(file, missing)?, file)?;
    if found.is_empty() {
        return Err(ImportError::Empty(file.display().to_string()));
    }
    let order = match order {
        Some(path) => layout(&read_file(path, "name the mask_layout.toml beside the registry.toml")?, path)?,
        None => Vec::new(),
    };
    let position = |name: &str| order.iter().position(|known| known == name).and_then(|at| u8::try_from(at).ok());
    let mut bits: Vec<u8> = found.iter().filter_map(|device| position(&device.name)).collect();
    let mut entries = Vec::new();
    for device in &found {
        let reader = Reader::for_device(device, node, attached);
        // A device that cannot be used yet keeps its bit, and gets no new one.
        let free = || free_bit(target.registry.as_ref(), &bits).filter(|_| reader.is_ok());
        let bit = position(&device.name).or_else(free);
        bits.extend(bit);
        entries.push(entry(device, bit, reader));
    }
    Ok(entries)
}

/// The driver of a device, and its settings.
struct Reader {
    node: String,
    settings: Vec<(String, Setting)>,
}

impl Reader {
    /// The driver and settings of a device, or why they are unknown.
    fn for_device(device: &Foreign, node: Option<&str>, attached: &[Attachment]) -> Result<Self, String> {
        if let Some(service) = &device.service {
            let Some((_, protocol)) = PROTOCOLS.iter().find(|(known, _)| known == service) else {
                return Err(format!("it is found by mDNS ({service}), whose protocol is unknown"));
            };
            let text = |key: &str, value: &str| (format!("lan.{key}"), Setting::Text(value.to_owned()));
            // Its pictures are large and few: a size computed from their pixels would use most of the shared memory.
            let size = (*protocol == "iphone").then(|| ("max_bytes".to_owned(), Setting::Text("2MiB".to_owned())));
            return Ok(Self {
                node: "lan".to_owned(),
                settings: vec![text("protocol", protocol), text("mdns", service)].into_iter().chain(size).collect(),
            });
        }
        let is_it = |attachment: &&Attachment| {
            let is_unit = |usb: &UsbIdentity| {
                Some((usb.vid, usb.pid)) == device.usb && (device.serial.is_none() || usb.serial == device.serial)
            };
            attachment.unit.usb().is_some_and(is_unit)
        };
        let read = attached.iter().filter(is_it).find_map(|attachment| Some((kind(attachment)?, attachment)));
        let settings = |attachment: &Attachment| {
            let camera = if let DeviceNode::Video(path) = &attachment.node { query(path).ok() } else { None };
            suggested(&attachment.node, camera.as_ref())
        };
        match (read, node) {
            (Some((word, attachment)), requested) if requested.is_none_or(|requested| requested == word) => {
                Ok(Self { node: word.to_owned(), settings: settings(attachment) })
            }
            (_, Some(node)) => Ok(Self { node: node.to_owned(), settings: Vec::new() }),
            (_, None) => {
                Err("its driver is unknown: plug it in and import again, give --node, or complete the entry".to_owned())
            }
        }
    }
}

fn entry(device: &Foreign, bit: Option<u8>, reader: Result<Reader, String>) -> NewEntry {
    let renamed = if name_problem(&device.name).is_none() { None } else { like_a_name(&device.name) };
    let name = renamed.clone().unwrap_or_else(|| device.name.clone());
    let mut comments = Vec::new();
    if renamed.is_some() {
        comments.push(format!("rapid_driver called it {:?}.", text::plain(&device.name)));
    }
    for (key, command) in &device.commands {
        comments.push(format!("rapid_driver ran {key}: {}", text::plain(command)));
    }
    let (node, settings, held_back) = match reader {
        Ok(reader) => (reader.node, reader.settings, None),
        Err(reason) => (if device.service.is_some() { "lan" } else { "camera" }.to_owned(), Vec::new(), Some(reason)),
    };
    let mut keys = Vec::new();
    let mut put = |key: &str, value: Option<Setting>| keys.extend(value.map(|value| (key.to_owned(), value)));
    put("vid", device.usb.map(|(vid, _)| Setting::Text(format!("{vid:04x}"))));
    put("pid", device.usb.map(|(_, pid)| Setting::Text(format!("{pid:04x}"))));
    put("serial", device.serial.clone().map(Setting::Text));
    put("node", Some(Setting::Text(node)));
    put("bit", bit.map(|bit| Setting::Whole(bit.into())));
    keys.extend(settings);
    NewEntry { name, comments, keys, held_back }
}
