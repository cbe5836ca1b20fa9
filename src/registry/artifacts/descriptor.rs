//! `descriptors/<name>.yaml`: what a module is, for people and for other programs (paper, appendix
//! "Module Catalog": module, slot, sensors, bring-up).

use std::fmt::Write as _;

use super::HEADER;
use crate::modality::ModalityKind;
use crate::registry::spec::{DeviceSpec, IdentitySpec, NodeSpec};

/// The descriptor of one entry; `stable_path` is the name the rules give it, if they can.
pub(super) fn descriptor(device: &DeviceSpec, stable_path: Option<&str>) -> String {
    let slot = device.mount.map_or_else(|| "null".to_owned(), |mount| quoted(&mount.to_string()));
    format!(
        "{HEADER}\n\
         module: {}\n\
         slot: {slot}\n\
         sensors:\n{}\
         bring_up: \"{}\"\n\
         {}\
         path: {}\n\
         topic: {}\n\
         bit: {}\n",
        quoted(&device.name),
        sensor(&device.node),
        if device.identity.usb().is_some() { "usb" } else { "lan" },
        identity(&device.identity),
        optional(stable_path),
        quoted(&device.topic),
        device.id,
    )
}

fn optional(text: Option<&str>) -> String {
    text.map_or_else(|| "null".to_owned(), quoted)
}

fn identity(identity: &IdentitySpec) -> String {
    let Some(usb) = identity.usb() else { return "identity: null\n".to_owned() };
    format!(
        "identity:\n  vid: \"{:04x}\"\n  pid: \"{:04x}\"\n  serial: {}\n  port: {}\n",
        usb.vid,
        usb.pid,
        optional(usb.serial.as_deref()),
        optional(usb.port.as_deref()),
    )
}

fn sensor(node: &NodeSpec) -> String {
    let kind = node.kind();
    match node {
        NodeSpec::Camera(camera) => format!(
            "  - kind: \"{kind}\"\n    width: {}\n    height: {}\n    fps: {}\n    format: \"{}\"\n",
            camera.width, camera.height, camera.fps, camera.format
        ),
        NodeSpec::Serial(serial) => format!(
            "  - kind: \"{kind}\"\n    baud: {}\n    framing: \"{}\"\n    parse: \"{}\"\n    channels: {}\n",
            serial.baud, serial.framing, serial.parse, serial.channels
        ),
        NodeSpec::Can(can) => {
            format!("  - kind: \"{kind}\"\n    adapter: \"{}\"\n    bitrate: {}\n", can.adapter, can.bitrate)
        }
        NodeSpec::Lan(lan) => format!("  - kind: \"{kind}\"\n    format: {}\n", quoted(&lan.format())),
        NodeSpec::Process(process) => {
            let program = process.program.file_name().unwrap_or_default().to_string_lossy();
            let shape = match (process.kind, process.shape.as_slice()) {
                (ModalityKind::Image, [height, width]) => format!("    width: {width}\n    height: {height}\n"),
                (ModalityKind::Scalars, [channels]) => format!("    channels: {channels}\n"),
                _ => String::new(),
            };
            format!("  - kind: \"{kind}\"\n    program: {}\n{shape}", quoted(&program))
        }
    }
}

/// A YAML double-quoted scalar (YAML 1.2.2 section 7.3.1), in ASCII: readers disagree about line
/// separators and non-characters.
fn quoted(text: &str) -> String {
    let mut quoted = String::with_capacity(text.len() + 2);
    quoted.push('"');
    for c in text.chars() {
        // Writing to a String cannot fail.
        let _ = match (c, u32::from(c)) {
            ('"' | '\\', _) => write!(quoted, "\\{c}"),
            (' '..='~', _) => write!(quoted, "{c}"),
            (_, code @ 0..=0xffff) => write!(quoted, "\\u{code:04x}"),
            (_, code) => write!(quoted, "\\U{code:08x}"),
        };
    }
    quoted.push('"');
    quoted
}
