//! Which units could be registered.

use std::path::PathBuf;

use super::*;
use crate::BUILTIN;
use crate::device::Unit;

fn usb(ids: (u16, u16), serial: Option<&str>, port: &str) -> UsbIdentity {
    UsbIdentity {
        vid: ids.0,
        pid: ids.1,
        serial: serial.map(str::to_owned),
        port: port.into(),
        ..UsbIdentity::default()
    }
}

fn node(usb: &UsbIdentity, node: DeviceNode) -> Attachment {
    let syspath = PathBuf::from("/sys/none").join(&usb.port).join(node.label().replace('/', "_"));
    Attachment { syspath, node, unit: Unit::Usb(usb.clone()), driver: None, formats: Vec::new() }
}

fn video(usb: &UsbIdentity, path: &str) -> Attachment {
    node(usb, DeviceNode::Video(path.into()))
}

#[test]
fn a_node_that_an_entry_reads_is_not_listed_but_other_nodes_of_its_device_may_be() {
    let registry = Registry::parse(BUILTIN, None).unwrap().registry;
    let known = usb((0x046d, 0x0825), Some("CAM00A1"), "1-1");
    let new = usb((0x046d, 0x0825), Some("OTHER"), "1-2");
    let bare = usb((0x1209, 1), None, "1-3");
    let attached = [
        node(&bare, DeviceNode::Usb("/dev/bus/usb/001/009".into())),
        video(&known, "/dev/video0"),
        video(&known, "/dev/video1"),
        node(&known, DeviceNode::Usb("/dev/bus/usb/001/002".into())),
        node(&known, DeviceNode::Tty("/dev/ttyACM0".into())),
        video(&new, "/dev/video2"),
        node(&new, DeviceNode::Usb("/dev/bus/usb/001/003".into())),
    ];
    let found = unregistered(Some(&registry), &attached);
    let listed: Vec<String> = found
        .iter()
        .map(|unit| {
            let nodes: Vec<String> = unit.nodes.iter().map(|node| node.node.label()).collect();
            format!("{} {:?} {}", unit.usb.port, unit.guess(), nodes.join(" "))
        })
        .collect();
    assert_eq!(
        listed,
        [
            "1-1 Some(\"serial\") /dev/ttyACM0",
            "1-2 Some(\"camera\") /dev/video2 /dev/bus/usb/001/003",
            "1-3 None /dev/bus/usb/001/009",
        ]
    );
    assert!(found[1].has_twin);
    assert_eq!(found[1].identity(), Some(("serial", "OTHER".to_owned())));
    assert_eq!(found[2].identity(), None, "the only one of its model");
    assert_eq!(unregistered(None, &attached).len(), 3);
}

#[test]
fn units_with_equal_serial_numbers_are_distinguished_by_port() {
    for (serials, expected) in [
        ([Some("A"), Some("B")], [("serial", "A"), ("serial", "B")]),
        ([Some("A"), Some("A")], [("port", "1-1"), ("port", "1-2")]),
        ([None, None], [("port", "1-1"), ("port", "1-2")]),
        ([None, Some("B")], [("port", "1-1"), ("serial", "B")]),
        // A serial number with a line break cannot identify a device.
        ([Some("evil\nline"), Some("B")], [("port", "1-1"), ("serial", "B")]),
    ] {
        let units = [usb((1, 2), serials[0], "1-1"), usb((1, 2), serials[1], "1-2")];
        let attached = [video(&units[0], "/dev/video0"), video(&units[1], "/dev/video1")];
        let found: Vec<_> = unregistered(None, &attached).iter().filter_map(Candidate::identity).collect();
        assert_eq!(found, expected.map(|(key, value)| (key, value.to_owned())), "{serials:?}");
    }
}
