//! `rapid devices`: what is plugged in, which entry of the registry it is, and if none, why not.

use std::io::{self, Write};

use serde::Serialize;

use crate::driver::camera::{CameraInfo, query};
use crate::registry::{Assigner, Assignment, Attachment, DeviceNode, Registry, UsbIdentity};

/// One node that is plugged in.
#[derive(Debug, Clone, Serialize)]
pub struct Plugged {
    /// Node, for example `/dev/video0`.
    pub node: String,
    /// What its device says it is.
    #[serde(flatten)]
    pub usb: UsbIdentity,
    /// The entry it is, if any.
    pub entry: Option<String>,
    /// Why it is that entry, or none.
    pub reasons: Vec<String>,
    /// Formats and controls, if asked for and it is a camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraInfo>,
    /// Why the camera does not tell them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_error: Option<String>,
}

/// What to tell of cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Formats {
    /// Open them and ask for formats and controls.
    Ask,
    /// Leave them alone.
    Skip,
}

/// Matches what is attached against the registry, as a starting rig would.
#[must_use]
pub fn list(registry: Option<&Registry>, attached: &[Attachment], formats: Formats) -> Vec<Plugged> {
    let mut assigner = registry.map(Assigner::new);
    let plugged = |attachment: &Attachment| {
        let (entry, reasons) = match (&mut assigner, registry) {
            (Some(assigner), Some(registry)) => explain(assigner, registry, attachment),
            _ => (None, vec!["there is no registry; write a devices.toml".to_owned()]),
        };
        let (camera, camera_error) = match (&attachment.node, formats) {
            (DeviceNode::Video(path), Formats::Ask) => match query(path) {
                Ok(info) => (Some(info), None),
                Err(error) => (None, Some(error.to_string())),
            },
            _ => (None, None),
        };
        Plugged { node: attachment.node.label(), usb: attachment.usb.clone(), entry, reasons, camera, camera_error }
    };
    attached.iter().map(plugged).collect()
}

fn explain(assigner: &mut Assigner, registry: &Registry, attachment: &Attachment) -> (Option<String>, Vec<String>) {
    let why = assigner.explain(attachment).reasons;
    match assigner.attach(attachment) {
        Assignment::Entry(id) => (registry.device(id).map(|device| device.name.clone()), why),
        Assignment::Waiting { reason } | Assignment::Unregistered { reason } | Assignment::WrongNode { reason } => {
            let reasons = if why.is_empty() { vec![reason] } else { why };
            (None, reasons)
        }
    }
}

/// Prints the list for people.
///
/// # Errors
/// When `out` cannot be written.
pub fn print(plugged: &[Plugged], registry: Option<&Registry>, out: &mut dyn Write) -> io::Result<()> {
    if plugged.is_empty() {
        writeln!(out, "No camera and no serial device is plugged in.")?;
    }
    for device in plugged {
        let usb = &device.usb;
        let product = crate::text::plain(usb.product.as_deref().unwrap_or("(no product name)"));
        let serial = usb.serial.as_ref().map(|serial| format!("serial {serial:?}"));
        let entry = device.entry.as_ref().map_or("not used".to_owned(), |entry| format!("[device.{entry}]"));
        writeln!(
            out,
            "{:<14} {:04x}:{:04x}  port {:<8} {:<22} {:<20} {product}",
            device.node,
            usb.vid,
            usb.pid,
            usb.port,
            serial.unwrap_or_else(|| "no serial".to_owned()),
            entry,
        )?;
        for reason in &device.reasons {
            writeln!(out, "               {}", crate::text::plain(reason))?;
        }
        if let Some(camera) = &device.camera {
            for line in camera.to_string().lines() {
                writeln!(out, "               {line}")?;
            }
        }
        if let Some(error) = &device.camera_error {
            writeln!(out, "               formats unknown: {error}")?;
        }
    }
    let Some(registry) = registry else { return Ok(()) };
    let missing = registry
        .devices
        .iter()
        .filter(|entry| !plugged.iter().any(|device| device.entry.as_deref() == Some(entry.name.as_str())));
    for entry in missing {
        let identity = &entry.identity;
        writeln!(out, "[device.{}] {:04x}:{:04x} is not plugged in", entry.name, identity.vid, identity.pid)?;
    }
    Ok(())
}
