//! `rapid devices`: the devices that are plugged in, and the registry entry each matches, or why none.

use std::io::{self, Write};
use std::path::PathBuf;

use rapid_core::text;
use rapid_devices::driver::camera::{CameraInfo, cameras, is_on_usb, name, query};
use rapid_registry::device::{Attachment, DeviceNode, Unit};
use rapid_registry::{Assigner, Assignment, DeviceSpec, IdentitySpec, Registry, UsbSpec};
use serde::Serialize;

use super::{Format, json_line};

/// A node that is plugged in.
#[derive(Debug, Clone, Serialize)]
pub struct Plugged {
    /// Node, for example `/dev/video0`.
    pub node: String,
    /// Its device, as the device describes itself; none of a camera that is not on USB.
    #[serde(flatten)]
    pub unit: Option<Unit>,
    /// The entry it matches, if any.
    pub entry: Option<String>,
    /// Why it matches that entry, or none.
    pub reasons: Vec<String>,
    /// Formats and controls of a camera, if requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraInfo>,
    /// Why they cannot be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_error: Option<String>,
}

/// Whether to query cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Formats {
    /// Open them and query formats and controls.
    Ask,
    /// Do not open them.
    Skip,
}

/// The entries to match against.
#[derive(Debug, Clone, Copy)]
pub enum Entries<'a> {
    /// The entries of a registry.
    Of(&'a Registry),
    /// None: there is no registry.
    NoFile,
    /// None: the registry is invalid.
    Wrong,
}

/// Matches what is attached against the registry, as a starting rig would.
pub fn list(entries: Entries<'_>, attached: &[Attachment], formats: Formats) -> Vec<Plugged> {
    let mut assigner = match entries {
        Entries::Of(registry) => Some((Assigner::new(registry), registry)),
        Entries::NoFile | Entries::Wrong => None,
    };
    let plugged = |attachment: &Attachment| {
        let (entry, reasons) = match (&mut assigner, entries) {
            (Some((assigner, registry)), _) => explain(assigner, registry, attachment),
            (None, Entries::Wrong) => (None, vec!["the registry is invalid; its mistakes are listed below".to_owned()]),
            (None, _) => (None, vec!["there is no registry; write a devices.toml".to_owned()]),
        };
        let (camera, camera_error) = match (&attachment.node, formats) {
            (DeviceNode::Video(path), Formats::Ask) => match query(path) {
                Ok(info) => (Some(info), None),
                Err(error) => (None, Some(error.to_string())),
            },
            _ => (None, None),
        };
        let unit = Some(attachment.unit.clone());
        Plugged { node: attachment.node.label(), unit, entry, reasons, camera, camera_error }
    };
    attached.iter().filter(|attachment| is_listed(entries, attachment)).map(plugged).collect()
}

/// Cameras that are not on USB, such as those on a board or of a loopback driver: no entry can match them.
pub fn other_cameras(formats: Formats) -> Vec<Plugged> {
    let other = |path: PathBuf| {
        let asked = match formats {
            Formats::Ask => name(&path).and_then(|name| name.map(|_| query(&path)).transpose()).transpose()?.map(Some),
            Formats::Skip => name(&path).transpose()?.map(|_| None),
        };
        let (camera, camera_error) = match asked {
            Ok(camera) => (camera, None),
            Err(error) => (None, Some(error.to_string())),
        };
        let reason = "it is not on USB: an entry matches a camera by its USB identity".to_owned();
        let node = path.display().to_string();
        Some(Plugged { node, unit: None, entry: None, reasons: vec![reason], camera, camera_error })
    };
    cameras().into_iter().filter(|path| !is_on_usb(path)).filter_map(other).collect()
}

/// Every hub and mouse is a USB device: only those that an entry matches are listed as such.
fn is_listed(entries: Entries<'_>, attachment: &Attachment) -> bool {
    match (&attachment.node, entries) {
        (DeviceNode::Usb(_), Entries::Of(registry)) => !Assigner::new(registry).explain(attachment).fits.is_empty(),
        (DeviceNode::Usb(_), Entries::NoFile | Entries::Wrong) => false,
        _ => true,
    }
}

fn explain(assigner: &mut Assigner, registry: &Registry, attachment: &Attachment) -> (Option<String>, Vec<String>) {
    let mut why = assigner.explain(attachment).reasons;
    match assigner.attach(attachment) {
        Assignment::Entry(id) => (registry.device(id).map(|device| device.name.clone()), why),
        // It matches, but something prevents its use.
        Assignment::Waiting { reason } | Assignment::WrongNode { reason } => {
            why.push(reason);
            (None, why)
        }
        Assignment::Unregistered { reason } => (None, if why.is_empty() { vec![reason] } else { why }),
    }
}

/// Prints the list, and the entries without a connected device.
///
/// # Errors
/// When `out` cannot be written.
pub fn print(plugged: &[Plugged], registry: Option<&Registry>, format: Format, out: &mut dyn Write) -> io::Result<()> {
    let entries = registry.map(|registry| registry.devices.as_slice()).unwrap_or_default();
    let is_missing = |entry: &&DeviceSpec| !plugged.iter().any(|device| device.entry.as_ref() == Some(&entry.name));
    let missing: Vec<&DeviceSpec> = entries.iter().filter(is_missing).collect();
    match format {
        Format::Json => print_json(plugged, &missing, out),
        Format::Text => print_text(plugged, &missing, out),
    }
}

/// One object of the list as JSON.
#[derive(Serialize)]
struct Line<T> {
    plugged: bool,
    #[serde(flatten)]
    what: T,
}

/// An entry without a connected device.
#[derive(Serialize)]
struct Missing<'a> {
    entry: &'a str,
    #[serde(flatten)]
    identity: &'a IdentitySpec,
}

fn print_json(plugged: &[Plugged], missing: &[&DeviceSpec], out: &mut dyn Write) -> io::Result<()> {
    for what in plugged {
        writeln!(out, "{}", json_line("plugged", &Line { plugged: true, what })?)?;
    }
    for entry in missing {
        let what = Missing { entry: &entry.name, identity: &entry.identity };
        writeln!(out, "{}", json_line("missing", &Line { plugged: false, what })?)?;
    }
    Ok(())
}

fn print_text(plugged: &[Plugged], missing: &[&DeviceSpec], out: &mut dyn Write) -> io::Result<()> {
    if plugged.is_empty() {
        writeln!(out, "No camera and no serial device is plugged in.")?;
    }
    let cells = |device: &Plugged| {
        let entry = device.entry.as_ref().map_or("not used".to_owned(), |entry| format!("[device.{entry}]"));
        let Some(unit) = &device.unit else {
            let name = device.camera.as_ref().map(|camera| camera.name.clone()).unwrap_or_default();
            let cells = [entry, device.node.clone(), "no USB".to_owned(), String::new(), String::new(), name];
            return cells.map(|cell| text::plain(&cell).into_owned());
        };
        let serial = unit.serial().map_or("no serial".to_owned(), |serial| format!("serial {serial:?}"));
        let port = unit.location();
        let product = unit.usb().and_then(|usb| usb.product.as_deref()).unwrap_or("(no product name)");
        let model = unit.model();
        [entry, device.node.clone(), model, port, serial, product.to_owned()]
            .map(|cell| text::plain(&cell).into_owned())
    };
    let rows: Vec<_> = plugged.iter().map(cells).collect();
    let width = |column: usize| rows.iter().filter_map(|row| row.get(column)).map(|cell| text::width(cell)).max();
    let widths: [usize; 6] = std::array::from_fn(|column| width(column).unwrap_or(0).min(WIDEST));
    for (device, row) in plugged.iter().zip(&rows) {
        let row = row.iter().zip(widths).map(|(cell, width)| {
            let missing = width.saturating_sub(text::width(cell));
            format!("{cell}{:missing$}", "")
        });
        writeln!(out, "{}", row.collect::<Vec<_>>().join("  ").trim_end())?;
        for reason in &device.reasons {
            writeln!(out, "    {}", text::plain(reason))?;
        }
        if let Some(camera) = &device.camera {
            for line in camera.to_string().lines() {
                writeln!(out, "    {}", text::plain(line))?;
            }
        }
        if let Some(error) = &device.camera_error {
            writeln!(out, "    formats unknown: {}", text::plain(error))?;
        }
    }
    for entry in missing {
        let Some(UsbSpec { vid, pid, serial, port }) = entry.identity.usb() else {
            // It is searched for while `rapid` runs.
            writeln!(out, "[device.{}] is on the network", entry.name)?;
            continue;
        };
        let unit = match (serial, port) {
            (Some(serial), _) => format!(" serial {serial:?}"),
            (None, Some(port)) => format!(" at port {port}"),
            (None, None) => String::new(),
        };
        writeln!(out, "[device.{}] {vid:04x}:{pid:04x}{unit} is not plugged in", entry.name)?;
    }
    Ok(())
}

/// Columns to which a column is padded at most: one long serial number does not move all the others.
const WIDEST: usize = 28;

#[cfg(test)]
mod tests;
