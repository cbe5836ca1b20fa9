//! `99-rapid.rules`: a stable name `/dev/rapid/<name>` for the node of every entry.
//!
//! Rule syntax: udev(7). A match value in double quotes is a shell glob if it contains `*`, `?` or
//! `[`, alternatives are separated by `|`, and `\"` stands for a quote (systemd,
//! `src/udev/udev-rules.c`: `rule_line_add_token`, `udev_rule_parse_value`). Match values undergo
//! no `%` or `$` substitution; assigned values do, but those are only names that have been validated.
//!
//! A network interface has no node and gets no name here. That of a CAN adapter is brought up with the bit rate of its
//! entry at each plug, which only root may do. `RUN` starts the program itself, without a shell, with arguments split
//! at spaces; the only argument from outside is `$name`, the name that the interface has after udev's rules, for which
//! the kernel permits neither spaces nor `/` and which no device chooses.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use super::HEADER;
use crate::spec::{CanProtocol, CanSpec, DeviceSpec, GpioInput, InputSpec, NodeSpec, Opens, Registry, UsbSpec};

/// The rules of a whole registry.
pub(super) fn rules(registry: &Registry) -> String {
    let mut text = format!(
        "{HEADER}\n\
         # Stable names for the rig's devices: /dev/rapid/<name>.\n\
         # The uaccess builtin is named here because 73-seat-late.rules, which runs it for the tag, is\n\
         # read before this file.\n"
    );
    for device in &registry.devices {
        let Some(usb) = device.identity.usb() else { continue };
        // Writing to a String cannot fail.
        let _ = writeln!(text, "\n# {}: {:04x}:{:04x}", device.name, usb.vid, usb.pid);
        let _ = match device.node.of_kind().on_plug() {
            Some(plug) => match single_out(registry, device, usb) {
                Ok(identity) => writeln!(text, "{}", bring_up(usb, &identity, &plug)),
                Err(reason) => writeln!(text, "# Not brought up: {reason}."),
            },
            None => match identify(registry, device) {
                Ok(identity) if registry.shares_unit(device) => {
                    writeln!(text, "{}\n{}", STREAM, rule(device, usb, &identity, false))
                }
                Ok(identity) => writeln!(text, "{}", rule(device, usb, &identity, true)),
                Err(reason) => writeln!(text, "# No stable name: {reason}."),
            },
        };
    }
    for (chip, users) in chips(registry) {
        // The kernel's name of a chip; any other is a link created by an operator's rule.
        let chip = chip.to_str().and_then(|chip| chip.strip_prefix("/dev/gpiochip"));
        if let Some(number) =
            chip.filter(|number| (1..=5).contains(&number.len()) && number.bytes().all(|byte| byte.is_ascii_digit()))
        {
            let rule = format!("SUBSYSTEM==\"gpio\", KERNEL==\"gpiochip{number}\", GROUP=\"gpio\", MODE=\"0660\"");
            let _ = writeln!(text, "\n# {}\n{rule}", users.join(", "));
        }
    }
    text
}

/// GPIO chips with their users: several lines of one may be in use.
fn chips(registry: &Registry) -> BTreeMap<&Path, Vec<String>> {
    let inputs = registry.inputs().filter_map(|(user, input)| match input {
        InputSpec::Gpio(GpioInput { chip, .. }) => Some((user, chip.as_path())),
        _ => None,
    });
    let buses = registry.devices.iter().filter_map(|device| match &device.node {
        NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(bus), .. }) => Some(&bus.motors),
        _ => None,
    });
    let brakes = buses.flatten().filter_map(|motor| Some((motor, motor.brake.as_ref()?)));
    let mut chips = BTreeMap::<_, Vec<_>>::new();
    for (user, chip) in
        inputs.chain(brakes.map(|(motor, brake)| (format!("brake of {}", motor.name), brake.chip.as_path())))
    {
        chips.entry(chip).or_default().push(user);
    }
    chips
}

/// The matches that identify the node of an entry's unit, or why there are none.
pub(super) fn identify(registry: &Registry, device: &DeviceSpec) -> Result<String, String> {
    let Some(usb) = device.identity.usb() else { return Err("it is not a USB device".to_owned()) };
    if device.node.opens() == Opens::Net {
        return Err("a network interface has no path".to_owned());
    }
    single_out(registry, device, usb)
}

/// The matches that identify an entry's unit among all others, or why there are none.
fn single_out(registry: &Registry, device: &DeviceSpec, usb: &UsbSpec) -> Result<String, String> {
    if let Some(serial) = &usb.serial {
        return match quoted_match(serial) {
            Some(serial) => Ok(format!(", {}{{serial}}==\"{serial}\"", keys(device).0)),
            None => Err("its serial number contains characters that a udev rule cannot match exactly; \
                         identify it by its port to get one"
                .to_owned()),
        };
    }
    if let Some(port) = &usb.port {
        // Validated to consist of digits, `-` and `.`.
        return Ok(format!(", {}==\"{port}\"", keys(device).1));
    }
    let same_model = |other: &&DeviceSpec| {
        let is_model = other.identity.usb().is_some_and(|other| (other.vid, other.pid) == (usb.vid, usb.pid));
        is_model && subsystem(other) == subsystem(device)
    };
    if registry.devices.iter().filter(same_model).count() == 1 {
        return Ok(String::new());
    }
    Err("several entries are of this model and this one has neither serial number nor port".to_owned())
}

/// Their capture nodes have the same identity.
const STREAM: &str = "# No stable name: one of several streams of a camera.";

fn rule(device: &DeviceSpec, usb: &UsbSpec, identity: &str, is_named: bool) -> String {
    // A camera has several nodes; index 0 is the one that captures pictures.
    let (index, group) = match device.node.opens() {
        Opens::Video if is_named => (", ATTR{index}==\"0\"", "video"),
        Opens::Video => ("", "video"),
        Opens::Tty => ("", "dialout"),
        Opens::Usb | Opens::Net => (", ENV{DEVTYPE}==\"usb_device\"", "plugdev"),
    };
    let attr = keys(device).0;
    let link = if is_named { format!("SYMLINK+=\"rapid/{}\", ", device.name) } else { String::new() };
    format!(
        "SUBSYSTEM==\"{}\"{index}, {attr}{{idVendor}}==\"{:04x}\", {attr}{{idProduct}}==\"{:04x}\"{identity}, \
         {link}GROUP=\"{group}\", MODE=\"0660\", TAG+=\"uaccess\", RUN{{builtin}}+=\"uaccess\"",
        subsystem(device),
        usb.vid,
        usb.pid,
    )
}

/// Brings up the interface of a unit when it is plugged in.
fn bring_up(usb: &UsbSpec, identity: &str, [matches, commands]: &[String; 2]) -> String {
    format!(
        "ACTION==\"add\", SUBSYSTEM==\"net\", {matches}, ATTRS{{idVendor}}==\"{:04x}\", \
         ATTRS{{idProduct}}==\"{:04x}\"{identity}, {commands}",
        usb.vid, usb.pid,
    )
}

fn subsystem(device: &DeviceSpec) -> &'static str {
    match device.node.opens() {
        Opens::Video => "video4linux",
        other => other.word(),
    }
}

/// The keys that match an attribute of the USB device and its name. Keys that also match parents
/// would match the devices behind a hub by the hub's attributes.
fn keys(device: &DeviceSpec) -> (&'static str, &'static str) {
    match device.node.opens() {
        Opens::Usb => ("ATTR", "KERNEL"),
        Opens::Video | Opens::Tty | Opens::Net => ("ATTRS", "KERNELS"),
    }
}

/// `value` as a pattern that matches exactly itself. `None` if it cannot be written in a way
/// that every version of udev parses identically: quotes and backslashes, whose treatment changed between
/// versions, `|`, which always separates, and everything but printable ASCII.
fn quoted_match(value: &str) -> Option<String> {
    // An empty pattern matches devices without the attribute.
    if value.is_empty() {
        return None;
    }
    let mut pattern = String::with_capacity(value.len());
    for c in value.chars() {
        match c {
            '"' | '\\' | '|' => return None,
            '*' | '?' | '[' => {
                pattern.push('[');
                pattern.push(c);
                pattern.push(']');
            }
            ' '..='~' => pattern.push(c),
            _ => return None,
        }
    }
    Some(pattern)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pattern_matches_only_itself_or_is_omitted() {
        for (value, expected) in [
            ("CAM00A1", Some("CAM00A1")),
            ("a b%k$env{X}'#,=", Some("a b%k$env{X}'#,=")),
            ("A*", Some("A[*]")),
            ("?[x]", Some("[?][[]x]")),
            ("a\"b", None),
            ("a\\", None),
            ("a|b", None),
            ("\u{fc}", None),
            ("a\nb", None),
        ] {
            assert_eq!(quoted_match(value).as_deref(), expected, "{value:?}");
        }
    }
}
