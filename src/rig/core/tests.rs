//! The core: an added entry, and long random sequences of inputs.

mod simulator;

use std::path::PathBuf;

use rapid_registry::device::{DeviceNode, UsbIdentity};

use super::*;

fn registry(entries: &[(&str, u8)]) -> Registry {
    let entry = |(serial, bit): &(&str, u8)| {
        format!(
            "[device.d{bit}]\nvid = \"0001\"\npid = \"0001\"\nserial = \"{serial}\"\nnode = \"camera\"\nbit = {bit}\n"
        )
    };
    let text: String = entries.iter().map(entry).collect();
    Registry::parse(&text, None).expect("a registry").registry
}

fn plugged(serial: &str) -> Input {
    let usb = UsbIdentity {
        vid: 1,
        pid: 1,
        serial: Some(serial.to_owned()),
        port: serial.to_owned(),
        ..UsbIdentity::default()
    };
    let (syspath, node) = (PathBuf::from("/sys").join(serial), DeviceNode::Video(format!("/dev/{serial}").into()));
    Input::Hotplug(HotplugEvent::Added(Attachment {
        syspath,
        node,
        unit: usb.into(),
        driver: None,
        formats: Vec::new(),
    }))
}

#[test]
fn an_added_entry_starts_the_device_that_is_plugged_in_and_touches_no_other() {
    let id = |bit| ModalityId::new(bit).expect("a bit");
    let (mut core, now) = (Core::new(&registry(&[("A", 0), ("B", 5)])), Stamp(1_000_000_000_000));
    let step = |core: &mut Core, input| {
        let mut effects = Vec::new();
        core.step(input, now, &mut effects);
        effects
    };
    for serial in ["A", "B", "S"] {
        step(&mut core, plugged(serial));
    }
    for bit in [0, 5] {
        step(&mut core, Input::Stream { id: id(bit), epoch: Epoch(1), event: StreamEvent::Started });
    }
    assert_eq!(core.mask(), PhysicalMask(0b10_0001));
    let added = Arc::new(registry(&[("S", 3)]).devices.remove(0));
    let effects = step(&mut core, Input::Register(Arc::clone(&added)));
    let started = |effect: &Effect| matches!(effect, Effect::Device(_, DeviceEffect::Start(Epoch(1), _)));
    let bits = Bits { mask: PhysicalMask(0b10_0001), plugged: PhysicalMask(0b10_1001) };
    assert_eq!(effects.first(), Some(&Effect::Publish(bits)), "plugged in, and not running yet");
    assert!(
        effects.iter().skip(1).all(|effect| matches!(effect, Effect::Device(of, _) if *of == id(3))),
        "{effects:?}"
    );
    assert_eq!(effects.iter().filter(|effect| started(effect)).count(), 1, "{effects:?}");
    let effects = step(&mut core, Input::Stream { id: id(3), epoch: Epoch(1), event: StreamEvent::Started });
    assert_eq!(effects.first(), Some(&Effect::Publish(PhysicalMask(0b10_1001).into())));
    assert_eq!(core.state(id(5)), (DeviceState::Streaming, Epoch(1)));
    assert_eq!(step(&mut core, Input::Register(added)), [], "it is there");
}
