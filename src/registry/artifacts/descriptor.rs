//! `descriptors/<name>.yaml`: what a module is, for people and for other programs (paper, appendix
//! "Module Catalog": module, slot, sensors, bring-up).

use std::fmt::Write as _;

use super::HEADER;
use crate::registry::spec::{DeviceSpec, Framing, NodeSpec, Parse, PixelFormat};

/// The descriptor of one entry; `stable` when the rules give it a name under /dev/rapid.
pub(super) fn descriptor(device: &DeviceSpec, stable: bool) -> String {
    let usb = &device.identity;
    let slot = device.mount.map_or("null", |mount| match mount {
        crate::registry::Mount::Front => "\"front\"",
        crate::registry::Mount::Tip => "\"tip\"",
        crate::registry::Mount::Top => "\"top\"",
        crate::registry::Mount::Bottom => "\"bottom\"",
    });
    let path = if stable { quoted(&format!("/dev/rapid/{}", device.name)) } else { "null".to_owned() };
    let optional = |text: Option<&String>| text.map_or_else(|| "null".to_owned(), |text| quoted(text));
    format!(
        "{HEADER}\n\
         module: {}\n\
         slot: {slot}\n\
         sensors:\n{}\
         bring_up: \"usb\"\n\
         identity:\n  \
           vid: \"{:04x}\"\n  \
           pid: \"{:04x}\"\n  \
           serial: {}\n  \
           port: {}\n\
         path: {path}\n\
         topic: {}\n\
         bit: {}\n",
        quoted(&device.name),
        sensor(&device.node),
        usb.vid,
        usb.pid,
        optional(usb.serial.as_ref()),
        optional(usb.port.as_ref()),
        quoted(&device.topic),
        device.id,
    )
}

fn sensor(node: &NodeSpec) -> String {
    match node {
        NodeSpec::Camera(camera) => {
            let format = match camera.format {
                PixelFormat::Mjpg => "MJPG",
                PixelFormat::Yuyv => "YUYV",
                PixelFormat::Grey => "GREY",
            };
            format!(
                "  - kind: \"camera\"\n    width: {}\n    height: {}\n    fps: {}\n    format: \"{format}\"\n",
                camera.width, camera.height, camera.fps
            )
        }
        NodeSpec::Serial(serial) => {
            let framing = match serial.framing {
                Framing::Line => "line".to_owned(),
                Framing::Cobs => "cobs".to_owned(),
                Framing::Fixed(bytes) => format!("fixed {bytes}"),
            };
            let parse = match serial.parse {
                Parse::Csv => "csv",
                Parse::Json => "json",
                Parse::F32le => "f32le",
                Parse::Raw => "raw",
            };
            format!(
                "  - kind: \"serial\"\n    baud: {}\n    framing: \"{framing}\"\n    parse: \"{parse}\"\n    channels: {}\n",
                serial.baud, serial.channels
            )
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
