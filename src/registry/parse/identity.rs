//! Which device an entry means: the keys `vid`, `pid`, `serial` and `port`.

use super::device::Kind;
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{IdentitySpec, UsbSpec};

pub(super) fn identity(kind: Option<Kind>, section: &Section<'_>, problems: &mut Problems<'_>) -> Option<IdentitySpec> {
    // A device on the network has none; one behind a USB adapter of its own has that adapter's.
    if kind == Some(Kind::Lan) && !["vid", "pid", "serial", "serial_number", "port"].iter().any(|key| section.has(key))
    {
        return Some(IdentitySpec::Lan {});
    }
    for key in ["vid", "pid"] {
        if !section.has(key) {
            let fix = format!("write the four hexadecimal digits lsusb shows, for example {key} = \"046d\"");
            section.missing(problems, key, &fix);
        }
    }
    let vid = section.usb_id(problems, "vid");
    let pid = section.usb_id(problems, "pid");
    let serial = serial_number(section, problems);
    let port = section.text(problems, "port").filter(|port| {
        let legal = is_port(port.value);
        if !legal {
            let fix = "write it as the kernel does, bus-port.port, for example port = \"1-2.3\"; `lsusb -t` shows it";
            section.report(problems, "port", format!("{:?} is not a USB port path", port.value), fix);
        }
        legal
    });
    let port = port.map(|port| port.value.to_owned());
    Some(IdentitySpec::Usb(UsbSpec { vid: vid?, pid: pid?, serial, port }))
}

/// `serial = "..."`, or `serial_number = "..."` where `serial` is the table of the serial line: in
/// TOML one key cannot be both.
fn serial_number(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<String> {
    let as_text = section.has("serial") && !section.is_table("serial");
    if as_text && section.has("serial_number") {
        let message = "serial and serial_number are the same thing".to_owned();
        section.report(problems, "serial_number", message, "keep one of the two");
    }
    let key = if as_text { "serial" } else { "serial_number" };
    let serial = section.text(problems, key)?.value;
    match check_serial(serial) {
        Ok(()) => Some(serial.to_owned()),
        Err((message, fix)) => {
            section.report(problems, key, message, fix);
            None
        }
    }
}

/// A serial number ends up in rules and descriptors: it must at least be one line of text.
fn check_serial(serial: &str) -> Result<(), (String, &'static str)> {
    /// A USB string descriptor holds at most 126 UTF-16 units.
    const LONGEST: usize = 126;
    if serial.is_empty() {
        return Err(("the serial number is empty".to_owned(), "remove the key if the device has none"));
    }
    if serial.chars().any(|c| c.is_control() || matches!(c, '\u{2028}' | '\u{2029}' | '\u{feff}')) {
        return Err((
            format!("the serial number {serial:?} contains control characters"),
            "identify the device by its port instead: port = \"1-2.3\"",
        ));
    }
    if serial.encode_utf16().count() > LONGEST {
        return Err((
            "the serial number is longer than a USB device can report".to_owned(),
            "copy it from `rapid devices` or `lsusb -v`: at most 126 characters",
        ));
    }
    Ok(())
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
