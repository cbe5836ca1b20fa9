//! Valid names of entries and modules, and which device an entry identifies: the keys `vid`, `pid`, `serial` and
//! `port`.

use super::device::IDENTITY_KEYS;
use crate::kinds::Word;
use crate::section::Section;
use crate::spec::{IdentitySpec, UsbSpec};

/// In bytes.
const LONGEST_NAME: usize = 64;

/// Why `name` cannot be a modality's name, and what to do about it; `None` if it can.
pub fn name_problem(name: &str) -> Option<(String, String)> {
    let begins = name.starts_with(|c: char| c.is_ascii_lowercase());
    if begins && name.len() <= LONGEST_NAME && name.chars().all(in_a_name) {
        return None;
    }
    let fix = match like_a_name(name) {
        Some(better) => {
            format!("use lower-case letters, digits and `_`, at most {LONGEST_NAME}, for example [device.{better}]")
        }
        None => {
            format!("begin with a lower-case letter; then lower-case letters, digits and `_`, at most {LONGEST_NAME}")
        }
    };
    Some((format!("{name:?} cannot be a modality's name"), fix))
}

/// The valid name nearest to a text, if there is one.
pub fn like_a_name(text: &str) -> Option<String> {
    let better: String =
        text.to_lowercase().chars().map(|c| if in_a_name(c) { c } else { '_' }).take(LONGEST_NAME).collect();
    better.starts_with(|c: char| c.is_ascii_lowercase()).then_some(better)
}

const fn in_a_name(c: char) -> bool {
    c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_'
}

pub(super) fn identity(kind: Option<Word>, section: &Section<'_>) -> Option<IdentitySpec> {
    // A device on the network has none; one behind its USB adapter has that of the adapter.
    if kind == Some(Word::Lan) && !IDENTITY_KEYS.iter().any(|key| section.has(key)) {
        return Some(IdentitySpec::Lan {});
    }
    for key in ["vid", "pid"] {
        section.need(key, &format!("write the four hexadecimal digits lsusb shows, for example {key} = \"046d\""));
    }
    let vid = section.usb_id("vid");
    let pid = section.usb_id("pid");
    let serial = serial_number(section);
    let port = section.text("port").and_then(|port| {
        if is_port(port) {
            return Some(port.to_owned());
        }
        let fix = "write it as the kernel does, bus-port.port, for example port = \"1-2.3\"; `lsusb -t` shows it";
        section.refuse("port", format!("{port:?} is not a USB port path"), fix)
    });
    Some(IdentitySpec::Usb(UsbSpec { vid: vid?, pid: pid?, serial, port }))
}

/// `serial = "..."`, or `serial_number = "..."`, the name for entries whose table of the serial line is still called
/// `serial`: in TOML one key cannot be both. It is written to rules and descriptors: it must at least be one line of
/// text.
fn serial_number(section: &Section<'_>) -> Option<String> {
    /// A USB string descriptor holds at most 126 UTF-16 units.
    const LONGEST: usize = 126;
    let as_text = section.has("serial") && !section.is_table("serial");
    if as_text && section.has("serial_number") {
        let message = "serial and serial_number are the same thing".to_owned();
        section.report("serial_number", message, "keep one of the two");
    }
    let key = if as_text { "serial" } else { "serial_number" };
    let serial = section.text(key)?;
    let (message, fix) = if serial.is_empty() {
        ("the serial number is empty".to_owned(), "remove the key if the device has none")
    } else if serial.chars().any(|c| c.is_control() || matches!(c, '\u{2028}' | '\u{2029}' | '\u{feff}')) {
        let message = format!("the serial number {serial:?} contains control characters");
        (message, "identify the device by its port instead: port = \"1-2.3\"")
    } else if serial.encode_utf16().count() > LONGEST {
        let message = "the serial number is longer than a USB device can report".to_owned();
        (message, "copy it from `rapid devices` or `lsusb -v`: at most 126 characters")
    } else {
        return Some(serial.to_owned());
    };
    section.refuse(key, message, fix)
}

/// `1-2.3`: bus, port at the root hub, ports at the hubs below (at most 5 hubs in a row, USB 2.0
/// section 4.1.1).
pub(crate) fn is_port(text: &str) -> bool {
    let number = |part: &str| {
        (1..=3).contains(&part.len()) && part.bytes().all(|byte| byte.is_ascii_digit()) && !part.starts_with('0')
    };
    let Some((bus, ports)) = text.split_once('-') else { return false };
    number(bus) && ports.split('.').count() <= 6 && ports.split('.').all(number)
}
