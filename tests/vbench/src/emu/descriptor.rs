//! USB descriptors and the setup packet: the parts that every kind of device shares.
//!
//! Invariant: `wTotalLength` and `bNumInterfaces` are computed from the bytes, never written by hand.

use super::spec::Identity;

/// Descriptor types of chapter 9 that the host asks for by number.
pub const DEVICE: u8 = 1;
/// See `DEVICE`.
pub const CONFIGURATION: u8 = 2;
/// See `DEVICE`.
pub const STRING: u8 = 3;
const INTERFACE: u8 = 4;
/// Class-specific interface descriptor.
pub const CS_INTERFACE: u8 = 0x24;

/// Bulk packets at high speed are always this long.
pub const BULK_PACKET: u16 = 512;

/// The 8 bytes that open a control transfer.
#[derive(Clone, Copy, Debug)]
pub struct Setup {
    /// bmRequestType.
    pub kind: u8,
    /// bRequest.
    pub request: u8,
    /// wValue.
    pub value: u16,
    /// wIndex.
    pub index: u16,
    /// wLength.
    pub length: u16,
}

impl Setup {
    /// Reads a setup packet.
    pub fn parse(bytes: &[u8; 8]) -> Self {
        let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        Self { kind: bytes[0], request: bytes[1], value: word(2), index: word(4), length: word(6) }
    }

    /// Whether data flows to the host.
    pub fn is_in(self) -> bool {
        self.kind & 0x80 != 0
    }

    /// Whether it is one of chapter 9's requests, as opposed to a class's or vendor's.
    pub fn is_standard(self) -> bool {
        self.kind & 0x60 == 0
    }
}

/// A device's answer to a control request.
#[derive(Debug, PartialEq, Eq)]
pub enum Answer {
    /// Data to the host, truncated to the requested length.
    Data(Vec<u8>),
    /// Accepted.
    Done,
    /// Not understood.
    Stall,
}

/// Class, subclass, protocol and release of the device descriptor.
#[derive(Clone, Copy, Debug)]
pub struct DeviceClass {
    /// bDeviceClass, bDeviceSubClass, bDeviceProtocol.
    pub class: [u8; 3],
    /// bcdDevice.
    pub release: u16,
}

/// The device descriptor. An empty serial means there is no serial descriptor at all, as on many cheap devices.
pub fn device(identity: &Identity, class: DeviceClass) -> Vec<u8> {
    let [vid, pid, release] = [identity.vid, identity.pid, class.release].map(u16::to_le_bytes);
    let [c, s, p] = class.class;
    let serial_index = if identity.serial.is_empty() { 0 } else { 3 };
    vec![
        18,
        DEVICE,
        0x00,
        0x02,
        c,
        s,
        p,
        64,
        vid[0],
        vid[1],
        pid[0],
        pid[1],
        release[0],
        release[1],
        1,
        2,
        serial_index,
        1,
    ]
}

/// String descriptor `index`, if the device has it.
pub fn string(identity: &Identity, index: u8) -> Option<Vec<u8>> {
    const ENGLISH_US: [u8; 2] = [0x09, 0x04];
    let text = match index {
        0 => return Some([&[4, STRING], &ENGLISH_US[..]].concat()),
        1 => &identity.manufacturer,
        2 => &identity.product,
        3 if !identity.serial.is_empty() => &identity.serial,
        _ => return None,
    };
    Some(self::text(text))
}

/// A string descriptor.
pub fn text(text: &str) -> Vec<u8> {
    // bLength is one byte: at most 126 UTF-16 units.
    let units: Vec<u8> = text.encode_utf16().take(126).flat_map(u16::to_le_bytes).collect();
    let length = u8::try_from(units.len() + 2).expect("126 units fit a byte");
    [&[length, STRING], &units[..]].concat()
}

/// A configuration under construction.
#[derive(Debug, Default)]
pub struct Configuration {
    body: Vec<u8>,
}

impl Configuration {
    /// Appends one descriptor given without its bLength.
    pub fn push(&mut self, descriptor: &[u8]) -> &mut Self {
        let length = u8::try_from(descriptor.len() + 1).expect("descriptors are shorter than 256 bytes");
        self.body.push(length);
        self.body.extend_from_slice(descriptor);
        self
    }

    /// Appends an interface (alternate setting 0).
    pub fn interface(&mut self, number: u8, endpoints: u8, class: [u8; 3]) -> &mut Self {
        self.setting(number, 0, endpoints, class)
    }

    /// Appends an alternate setting of an interface.
    pub fn setting(&mut self, number: u8, setting: u8, endpoints: u8, class: [u8; 3]) -> &mut Self {
        let [c, s, p] = class;
        self.push(&[INTERFACE, number, setting, endpoints, c, s, p, 0])
    }

    /// Appends a bulk endpoint; bit 7 of the address is set for data to the host.
    pub fn bulk(&mut self, address: u8) -> &mut Self {
        let [low, high] = BULK_PACKET.to_le_bytes();
        self.push(&[5, address, 2, low, high, 0])
    }

    /// Appends descriptors of this configuration that were built elsewhere, lengths included.
    pub fn append(&mut self, descriptors: &[u8]) -> &mut Self {
        self.body.extend_from_slice(descriptors);
        self
    }

    /// Only the descriptors, for a part that is appended elsewhere.
    pub fn into_body(self) -> Vec<u8> {
        self.body
    }

    /// The complete configuration descriptor.
    pub fn finish(&self) -> Vec<u8> {
        let interfaces = walk(&self.body).filter(|d| d[1] == INTERFACE && d[3] == 0).count();
        let total = u16::try_from(self.body.len() + 9).expect("configurations stay far below 64 KiB").to_le_bytes();
        let count = u8::try_from(interfaces).expect("a handful of interfaces");
        let head = [9, CONFIGURATION, total[0], total[1], count, 1, 0, 0x80, 250];
        [&head[..], &self.body].concat()
    }
}

/// Iterates over the descriptors in a byte string; stops at one that does not fit.
pub fn walk(mut bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let length = usize::from(*bytes.first()?);
        if length < 2 || length > bytes.len() {
            return None;
        }
        let (descriptor, rest) = bytes.split_at(length);
        bytes = rest;
        Some(descriptor)
    })
}

/// Test helper for every kind: the descriptors fill the configuration exactly and its counts are right.
#[cfg(test)]
pub(crate) fn check_configuration(bytes: &[u8]) {
    assert_eq!(walk(bytes).map(<[u8]>::len).sum::<usize>(), bytes.len(), "descriptors do not add up");
    assert_eq!(usize::from(u16::from_le_bytes([bytes[2], bytes[3]])), bytes.len(), "wTotalLength");
    let endpoints = walk(bytes).filter(|d| d[1] == 5).count();
    let declared: usize = walk(bytes).filter(|d| d[1] == INTERFACE).map(|d| usize::from(d[4])).sum();
    assert_eq!(endpoints, declared, "bNumEndpoints");
    let interfaces = walk(bytes).filter(|d| d[1] == INTERFACE && d[3] == 0).count();
    assert_eq!(interfaces, usize::from(bytes[4]), "bNumInterfaces");
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity(serial: &str) -> Identity {
        Identity {
            vid: 0x046d,
            pid: 0x0825,
            serial: serial.into(),
            product: "Wrist".into(),
            manufacturer: "Bench".into(),
        }
    }

    #[test]
    fn device_descriptor_has_a_serial_only_when_named() {
        let class = DeviceClass { class: [0xef, 2, 1], release: 0x0100 };
        let with = device(&identity("A1"), class);
        assert_eq!((with.len(), with[0], with[16]), (18, 18, 3));
        assert_eq!(with[8..12], [0x6d, 0x04, 0x25, 0x08]);
        assert_eq!(device(&identity(""), class)[16], 0);
        assert_eq!(string(&identity(""), 3), None);
    }

    #[test]
    fn strings_are_utf16_and_bounded() {
        assert_eq!(string(&identity("A1"), 3), Some(vec![6, 3, b'A', 0, b'1', 0]));
        let long = string(&identity(&"x".repeat(500)), 3).unwrap();
        assert_eq!((long.len(), long[0]), (254, 254));
    }

    #[test]
    fn walk_stops_at_nonsense() {
        assert_eq!(walk(&[2, 1, 0, 9]).count(), 1);
        assert_eq!(walk(&[3, 1, 0, 200, 1]).count(), 1);
    }
}
