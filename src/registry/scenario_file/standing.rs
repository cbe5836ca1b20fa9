//! What stands for an entry of the registry in a simulation.

use crate::registry::attachment::{LanIdentity, UsbIdentity};
use crate::registry::scenario::{ScenarioDevice, SimFaults, SimSource};
use crate::registry::spec::{DeviceSpec, LanPicture, NodeSpec};

/// Rate of a simulated serial line, Hz: that of a usual motor controller's state.
const SERIAL_HZ: u32 = 100;

/// A simulated device with an entry's identity and format; its port may still be empty.
pub(super) fn standing_for(spec: &DeviceSpec, name: &str) -> ScenarioDevice {
    let seed = u64::from(spec.id.bit());
    let source = match &spec.node {
        NodeSpec::Camera(camera) => {
            SimSource::Camera { width: camera.width, height: camera.height, fps: camera.fps, seed, bytes: 0 }
        }
        // What sends bytes has no channels: a number of its messages a second is all that is said here.
        NodeSpec::Serial(serial) => SimSource::Serial { channels: serial.channels.max(1), hz: SERIAL_HZ, seed },
        NodeSpec::Process(_) => SimSource::Process,
        NodeSpec::Can(can) => SimSource::Serial { channels: can.channels().max(1), hz: SERIAL_HZ, seed },
        NodeSpec::Lan(lan) => match (lan.picture(), lan.shape().as_slice()) {
            (Some(LanPicture { width, height, fps }), [_, _]) => {
                SimSource::Camera { width, height, fps, seed, bytes: 0 }
            }
            (_, [channels]) => SimSource::Serial { channels: *channels as usize, hz: SERIAL_HZ, seed },
            _ => SimSource::Serial { channels: 1, hz: SERIAL_HZ, seed },
        },
    };
    let wished = spec.identity.usb();
    let lan = wished.is_none().then(|| LanIdentity {
        entry: spec.name.clone(),
        address: format!("sim:{name}"),
        instance: None,
    });
    let usb = UsbIdentity {
        vid: wished.map_or(0, |wished| wished.vid),
        pid: wished.map_or(0, |wished| wished.pid),
        serial: Some(spec.identity.serial().map_or_else(|| format!("SIM-{name}"), str::to_owned)),
        port: wished.and_then(|wished| wished.port.clone()).unwrap_or_default(),
        product: Some(format!("simulated {}", spec.name)),
        manufacturer: Some("rapid".to_owned()),
        firmware: Some("1.00".to_owned()),
    };
    ScenarioDevice { name: name.to_owned(), usb, lan, source, plugged: true, faults: SimFaults::default() }
}

/// Ports of a bus no rig has, for devices whose port nothing says.
pub(super) fn invent_ports(devices: &mut [ScenarioDevice]) {
    let mut taken: Vec<String> = devices.iter().map(|device| device.usb.port.clone()).collect();
    for device in devices.iter_mut().filter(|device| device.usb.port.is_empty()) {
        let port = (1..=taken.len() + 1).map(|number| format!("9-{number}")).find(|port| !taken.contains(port));
        device.usb.port = port.unwrap_or_default();
        taken.push(device.usb.port.clone());
    }
}
