use std::sync::Arc;

use insta::assert_snapshot;
use rapid_registry::device::UsbIdentity;
use rapid_registry::simulation::{SimDevice, SimSource};

use super::*;

/// A wrist camera by its serial number, two interchangeable cameras, a serial line by its port.
const REGISTRY: &str = r#"
[device.cam_wrist]
vid = "046d"
pid = "0825"
serial = "CAM00A1"
node = "camera"
bit = 0

[device.cam_left]
vid = "2bc5"
pid = "0501"
node = "camera"
bit = 1

[device.cam_right]
vid = "2bc5"
pid = "0501"
node = "camera"
bit = 2

[device.tof]
vid = "2e8a"
pid = "000a"
port = "1-4"
node = "serial"
bit = 3
[device.tof.tty]
channels = 1
"#;

fn registry() -> Registry {
    Registry::parse(REGISTRY, None).unwrap().registry
}

fn usb(ids: (u16, u16), serial: Option<&str>, port: &str, product: Option<&str>) -> UsbIdentity {
    let owned = |text: Option<&str>| text.map(str::to_owned);
    UsbIdentity {
        vid: ids.0,
        pid: ids.1,
        serial: owned(serial),
        port: port.to_owned(),
        product: owned(product),
        ..UsbIdentity::default()
    }
}

fn attachment(node: DeviceNode, usb: UsbIdentity) -> Attachment {
    let syspath = format!("/sys/{}/{}", usb.port, node.label().replace('/', "_"));
    Attachment { syspath: syspath.into(), node, unit: usb.into(), driver: None, formats: Vec::new() }
}

fn video(number: u8, ids: (u16, u16), serial: Option<&str>, port: &str) -> Attachment {
    let node = DeviceNode::Video(format!("/dev/video{number}").into());
    attachment(node, usb(ids, serial, port, Some("A camera")))
}

fn tty(port: &str) -> Attachment {
    attachment(DeviceNode::Tty("/dev/ttyACM0".into()), usb((0x2e8a, 0x000a), None, port, None))
}

fn text(entries: Entries<'_>, attached: &[Attachment]) -> String {
    printed(entries, attached, Format::Text)
}

fn printed(entries: Entries<'_>, attached: &[Attachment], format: Format) -> String {
    let plugged = list(entries, attached, Formats::Skip);
    let registry = if let Entries::Of(registry) = entries { Some(registry) } else { None };
    let mut out = Vec::new();
    print(&plugged, registry, format, &mut out).unwrap();
    String::from_utf8(out).unwrap()
}

const WRIST: (u16, u16) = (0x046d, 0x0825);
const TWIN: (u16, u16) = (0x2bc5, 0x0501);

#[test]
fn matches_name_their_rule_and_missing_devices_are_listed() {
    let attached = [video(0, WRIST, Some("CAM00A1"), "1-2"), video(2, TWIN, None, "1-3"), tty("1-4")];
    assert_snapshot!(text(Entries::Of(&registry()), &attached));
}

#[test]
fn mismatches_give_a_reason() {
    let attached = [
        video(0, WRIST, Some("CAM00B7"), "1-2"),
        video(2, WRIST, None, "1-3"),
        tty("1-5"),
        video(4, (0x1234, 0x5678), Some("X"), "1-6"),
    ];
    assert_snapshot!(text(Entries::Of(&registry()), &attached));
}

#[test]
fn a_third_unit_of_two_entries_waits_with_a_reason() {
    let attached = [video(0, TWIN, None, "1-1"), video(2, TWIN, None, "1-2"), video(4, TWIN, None, "1-3")];
    let text = text(Entries::Of(&registry()), &attached);
    let waiting = text.split_once("/dev/video4").unwrap().1;
    assert!(waiting.contains("every entry of this model is taken (cam_left, cam_right)"), "{text}");
}

#[test]
fn a_second_node_of_a_camera_is_not_used() {
    let attached = [video(0, WRIST, Some("CAM00A1"), "1-2"), video(1, WRIST, Some("CAM00A1"), "1-2")];
    let text = text(Entries::Of(&registry()), &attached);
    let second = text.split_once("/dev/video1").unwrap().1;
    assert!(second.contains("[device.cam_wrist] already reads another node of this device"), "{text}");
}

#[test]
fn without_a_registry_plugged_devices_are_still_listed() {
    let attached = [video(0, WRIST, Some("CAM00A1"), "1-2")];
    let none = text(Entries::NoFile, &attached);
    assert!(none.contains("/dev/video0") && none.contains("there is no registry; write a devices.toml"), "{none}");
    let wrong = text(Entries::Wrong, &attached);
    assert!(wrong.contains("/dev/video0") && wrong.contains("the registry is invalid"), "{wrong}");
    assert_eq!(text(Entries::NoFile, &[]), "No camera and no serial device is plugged in.\n");
}

#[test]
fn json_distinguishes_plugged_and_missing() {
    let source = SimSource::Serial { channels: 1, hz: 100, seed: 1 };
    let sim = DeviceNode::Sim(Arc::new(SimDevice::new("tof", source, rapid_core::time::Stamp(0))));
    let attached = [attachment(sim, usb((0x2e8a, 0x000a), None, "1-4", None)), video(0, WRIST, None, "1-2")];
    let text = printed(Entries::Of(&registry()), &attached, Format::Json);
    let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(
        (&lines[0]["plugged"], &lines[0]["entry"], &lines[0]["node"]),
        (&true.into(), &"tof".into(), &"sim:tof".into())
    );
    assert_eq!((&lines[1]["plugged"], &lines[1]["entry"]), (&true.into(), &serde_json::Value::Null));
    for (line, name) in lines[2..].iter().zip(["cam_wrist", "cam_left", "cam_right"]) {
        assert_eq!((&line["plugged"], &line["entry"]), (&false.into(), &name.into()), "{text}");
    }
    assert_eq!(lines.len(), 5, "{text}");
}

#[test]
fn text_of_a_device_is_sanitized_and_keeps_the_columns() {
    let hostile = usb((0x046d, 0x0825), Some("A\x1b[2J\"\n"), "1-2", Some("red\x1b[31m\nline"));
    let attached = [attachment(DeviceNode::Video("/dev/video0".into()), hostile)];
    let text = text(Entries::NoFile, &attached);
    assert_eq!(text.lines().count(), 2, "{text:?}");
    assert!(!text.contains('\x1b'), "{text:?}");
}
