//! The text format of an emulated device: `KIND:key=value,...`.
//!
//! ```text
//! uvc:port=0,vid=046d,pid=0825,serial=CAM00A1,product=Wrist,mode=MJPG-640x480@30,mode=YUYV-320x240@30/15
//! acm:port=2,vid=2e8a,pid=000a,serial=TOF1,hz=100
//! ftdi:port=3,vid=0403,pid=6001,serial=FT1,hz=50
//! uvc:mode=MJPG-96x96@10,feed=/tmp/bench/wrist.feed
//! uvc:mode=Z16-64x48@15,also=YUYV-64x48@15,mode=MJPG-64x48@15    two cameras, the second of two modes
//! gsusb:serial=CAN1,motor=5/15/DMH3510,motor=6/16/DM4310     slcan:..  damiao:..  the same bus behind a serial line
//! ecm:serial=C3441325012345,gopro=4,lidar=100                a network adapter, clips of 4 MB, packets a second
//! ```
//!
//! A comma, a per cent sign or a control character in a string is percent-encoded as in a URL: `%2c`.
//!
//! Invariant: `FromStr` parses what `Display` prints, so the harness and the emulator share one format.

use std::fmt;
use std::str::FromStr;

use thiserror::Error;

use super::can::adapter::Protocol;
use super::can::bus::MotorSpec;
use super::lan::ecm::NetSpec;

/// Ports `vhci_hcd.0` has for high-speed devices in Debian's kernels.
pub const PORTS: u8 = 15;

/// Maximum modes of a camera, and rates of a mode: far more than any test needs, far less than a descriptor holds.
const MODES: usize = 32;

/// Maximum cameras of a device; a RealSense D435 has two.
pub const CAMERAS: usize = 4;

/// A device to emulate.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceSpec {
    /// Its kind.
    pub kind: Kind,
    /// The port of its first plug; by default, the device's index in the list.
    pub port: Option<u8>,
    /// Its identity.
    pub identity: Identity,
    /// File of its feed, see `feed`; empty: the bench's own pictures and lines.
    pub feed: String,
}

/// What a device reports about itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// idVendor.
    pub vid: u16,
    /// idProduct.
    pub pid: u16,
    /// Serial number; empty means that the device has none.
    pub serial: String,
    /// Product string.
    pub product: String,
    /// Manufacturer string.
    pub manufacturer: String,
}

/// What a device does.
#[derive(Clone, Debug, PartialEq)]
pub enum Kind {
    /// A device of one camera or several, each with these modes, the first of them its default.
    Uvc(Vec<Vec<Mode>>),
    /// CDC-ACM (`/dev/ttyACM*`) that sends lines at `hz`.
    Acm {
        /// Lines per second.
        hz: f64,
    },
    /// An FTDI adapter (`/dev/ttyUSB*`) that sends lines at `hz`.
    Ftdi {
        /// Lines per second.
        hz: f64,
    },
    /// A CAN adapter.
    Can {
        /// Its protocol with the host.
        protocol: Protocol,
        /// The motors on its bus.
        motors: Vec<MotorSpec>,
    },
    /// A network adapter (CDC-ECM).
    Ecm(NetSpec),
    /// A chip with GPIO lines (CP2104).
    Gpio,
}

/// One picture size of a camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mode {
    /// Pixel format.
    pub format: Format,
    /// Pixels across.
    pub width: u16,
    /// Pixels down.
    pub height: u16,
    /// Frame rates offered, the first of them the default.
    pub fps: Vec<u32>,
}

/// Pixel format, named by its four-character code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Motion JPEG.
    Mjpg,
    /// YUV 4:2:2, packed.
    Yuyv,
    /// Depth of 16 bits.
    Z16,
}

/// A specification that cannot be read.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum SpecError {
    /// No such kind.
    #[error("unknown kind `{0}`: use uvc, acm, ftdi, gsusb, slcan, damiao, ecm or gpio")]
    Kind(String),
    /// A key this kind does not have, or no `=`.
    #[error("unknown key `{key}` for {kind}")]
    Key {
        /// The requested kind.
        kind: String,
        /// The offending text.
        key: String,
    },
    /// A value that does not fit its key.
    #[error("`{key}={value}`: expected {expected}")]
    Value {
        /// The key.
        key: String,
        /// What was given.
        value: String,
        /// What is expected.
        expected: &'static str,
    },
}

impl DeviceSpec {
    /// A camera; `mode` adds modes. Without any it has `MJPG-640x480@30`. `also` adds another camera to the device.
    pub fn uvc(vid: u16, pid: u16) -> Self {
        Self::new(Kind::Uvc(vec![Vec::new()]), vid, pid)
    }

    /// A CDC-ACM device sending `hz` lines per second.
    pub fn acm(vid: u16, pid: u16, hz: f64) -> Self {
        Self::new(Kind::Acm { hz }, vid, pid)
    }

    /// An FTDI adapter sending `hz` lines per second.
    pub fn ftdi(vid: u16, pid: u16, hz: f64) -> Self {
        Self::new(Kind::Ftdi { hz }, vid, pid)
    }

    /// A CAN adapter with its own bus; `motor` adds motors.
    pub fn can(protocol: Protocol) -> Self {
        // candleLight, CANable with its slcan firmware, and the vendor's own.
        let (vid, pid) = match protocol {
            Protocol::GsUsb => (0x1d50, 0x606f),
            Protocol::Slcan => (0xad50, 0x60c4),
            Protocol::Damiao => (0x2e88, 0x4603),
        };
        Self::new(Kind::Can { protocol, motors: Vec::new() }, vid, pid)
    }

    /// A network adapter with nothing behind it; `gopro` and `lidar` add devices.
    pub fn ecm() -> Self {
        Self::new(Kind::Ecm(NetSpec::default()), 0x2672, 0x0059)
    }

    /// A CP2104 with four GPIO lines.
    pub fn gpio() -> Self {
        Self::new(Kind::Gpio, 0x10c4, 0xea60)
    }

    /// Adds a Damiao motor to the bus. Ignored by other kinds.
    ///
    /// # Panics
    /// When there is no such type or an id is out of range: the caller is a test.
    #[must_use]
    pub fn motor(mut self, slave: u16, master: u16, kind: &str) -> Self {
        let text = format!("{slave:x}/{master:x}/{kind}");
        if let Kind::Can { motors, .. } = &mut self.kind {
            motors.push(MotorSpec::parse(&text).unwrap_or_else(|| panic!("{text} is not a motor")));
        }
        self
    }

    /// Puts a GoPro with clips of this many MB behind a network adapter; its address follows from the serial number.
    #[must_use]
    pub fn gopro(mut self, megabytes: u32) -> Self {
        if let Kind::Ecm(net) = &mut self.kind {
            net.gopro = Some(megabytes);
        }
        self
    }

    /// Puts a LiDAR that sends `hz` packets per second behind a network adapter.
    #[must_use]
    pub fn lidar(mut self, hz: f64) -> Self {
        if let Kind::Ecm(net) = &mut self.kind {
            net.lidar = Some(hz);
        }
        self
    }

    /// Gives it a serial number.
    #[must_use]
    pub fn serial(mut self, serial: &str) -> Self {
        self.identity.serial = serial.into();
        self
    }

    /// Sets its names in place of the bench's own.
    #[must_use]
    pub fn names(mut self, manufacturer: &str, product: &str) -> Self {
        self.identity.manufacturer = manufacturer.into();
        self.identity.product = product.into();
        self
    }

    /// Makes it send the records of this file of the guest: MJPEG pictures of a camera, lines of a serial device.
    #[must_use]
    pub fn feed(mut self, path: &str) -> Self {
        self.feed = path.into();
        self
    }

    /// Sets the port of its first plug.
    #[must_use]
    pub fn port(mut self, port: u8) -> Self {
        self.port = Some(port);
        self
    }

    /// Adds a mode to the last camera. Ignored by other kinds.
    #[must_use]
    pub fn mode(mut self, format: Format, width: u16, height: u16, fps: &[u32]) -> Self {
        if let Kind::Uvc(cameras) = &mut self.kind
            && let Some(modes) = cameras.last_mut()
        {
            modes.push(Mode { format, width, height, fps: fps.to_vec() });
        }
        self
    }

    /// Adds another camera with this mode, a capture node of its own; `mode` adds modes to it. Ignored by other kinds.
    ///
    /// # Panics
    /// When the device has as many cameras as it can have: the caller is a test.
    #[must_use]
    pub fn also(mut self, format: Format, width: u16, height: u16, fps: &[u32]) -> Self {
        if let Kind::Uvc(cameras) = &mut self.kind {
            assert!(cameras.len() < CAMERAS, "a device has at most {CAMERAS} cameras");
            cameras.push(Vec::new());
        }
        self.mode(format, width, height, fps)
    }

    fn new(kind: Kind, vid: u16, pid: u16) -> Self {
        let product = format!("Virtual {}", kind.name());
        let identity = Identity { vid, pid, serial: String::new(), product, manufacturer: "Bench".into() };
        Self { kind, port: None, identity, feed: String::new() }
    }
}

impl Kind {
    /// The word for the kind.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Uvc(_) => "uvc",
            Self::Acm { .. } => "acm",
            Self::Ftdi { .. } => "ftdi",
            Self::Can { protocol: Protocol::GsUsb, .. } => "gsusb",
            Self::Can { protocol: Protocol::Slcan, .. } => "slcan",
            Self::Can { protocol: Protocol::Damiao, .. } => "damiao",
            Self::Ecm(_) => "ecm",
            Self::Gpio => "gpio",
        }
    }
}

impl FromStr for DeviceSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let (kind, fields) = text.split_once(':').unwrap_or((text, ""));
        let mut spec = match kind {
            "uvc" => Self::uvc(0x1d6b, 0x0102),
            "acm" => Self::acm(0x1d6b, 0x0104, 100.0),
            "ftdi" => Self::ftdi(0x0403, 0x6001, 100.0),
            "gsusb" => Self::can(Protocol::GsUsb),
            "slcan" => Self::can(Protocol::Slcan),
            "damiao" => Self::can(Protocol::Damiao),
            "ecm" => Self::ecm(),
            "gpio" => Self::gpio(),
            other => return Err(SpecError::Kind(other.into())),
        };
        for field in fields.split(',').filter(|field| !field.is_empty()) {
            let unknown = || SpecError::Key { kind: kind.into(), key: field.into() };
            let (key, value) = field.split_once('=').ok_or_else(unknown)?;
            let wrong = |expected| SpecError::Value { key: key.into(), value: value.into(), expected };
            let hex = || u16::from_str_radix(value, 16).map_err(|_| wrong("four hexadecimal digits"));
            let string = || unescaped(value).ok_or_else(|| wrong("text, with %25 for a per cent sign"));
            let mode = || parse_mode(value).ok_or_else(|| wrong("FORMAT-WxH@FPS[/FPS..], FORMAT MJPG, YUYV or Z16"));
            match (key, &mut spec.kind) {
                ("port", _) => {
                    let port = value.parse().ok().filter(|port| *port < PORTS);
                    spec.port = Some(port.ok_or_else(|| wrong("a port from 0 to 14"))?);
                }
                ("vid", _) => spec.identity.vid = hex()?,
                ("pid", _) => spec.identity.pid = hex()?,
                ("serial", _) => spec.identity.serial = string()?,
                ("product", _) => spec.identity.product = string()?,
                ("manufacturer", _) => spec.identity.manufacturer = string()?,
                ("feed", _) => spec.feed = string()?,
                ("mode", Kind::Uvc(cameras)) => match cameras.last_mut() {
                    Some(modes) if modes.len() < MODES => modes.push(mode()?),
                    _ => return Err(unknown()),
                },
                ("also", Kind::Uvc(cameras)) if cameras.len() < CAMERAS => cameras.push(vec![mode()?]),
                ("motor", Kind::Can { motors, .. }) if motors.len() < MODES => {
                    let expected = "SLAVE/MASTER/TYPE, ids in hexadecimal, such as 5/15/DMH3510";
                    motors.push(MotorSpec::parse(value).ok_or_else(|| wrong(expected))?);
                }
                ("gopro", Kind::Ecm(net)) => {
                    let size = value.parse().ok().filter(|megabytes| (1..=64).contains(megabytes));
                    net.gopro = Some(size.ok_or_else(|| wrong("1 to 64 MB a clip"))?);
                }
                ("lidar", Kind::Ecm(net)) => {
                    let hz = value.parse().ok().filter(|hz| (0.1..=5000.0).contains(hz));
                    net.lidar = Some(hz.ok_or_else(|| wrong("0.1 to 5000 packets a second"))?);
                }
                ("hz", Kind::Acm { hz } | Kind::Ftdi { hz }) => {
                    *hz = value
                        .parse()
                        .ok()
                        .filter(|hz| (0.01..=2000.0).contains(hz))
                        .ok_or_else(|| wrong("0.01 to 2000"))?;
                }
                _ => return Err(unknown()),
            }
        }
        Ok(spec)
    }
}

fn escaped(text: &str) -> String {
    let escape =
        |c: char| if c.is_ascii_control() || matches!(c, ',' | '%') { format!("%{:02x}", c as u32) } else { c.into() };
    text.chars().map(escape).collect()
}

fn unescaped(text: &str) -> Option<String> {
    let mut parts = text.split('%');
    let mut bytes = parts.next()?.as_bytes().to_vec();
    for part in parts {
        bytes.push(u8::from_str_radix(part.get(..2)?, 16).ok()?);
        bytes.extend_from_slice(&part.as_bytes()[2..]);
    }
    String::from_utf8(bytes).ok()
}

fn parse_mode(text: &str) -> Option<Mode> {
    let (format, rest) = text.split_once('-')?;
    let (size, rates) = rest.split_once('@')?;
    let (width, height) = size.split_once('x')?;
    let format = match format {
        "MJPG" => Format::Mjpg,
        "YUYV" => Format::Yuyv,
        "Z16" => Format::Z16,
        _ => return None,
    };
    let fps: Vec<u32> =
        rates.split('/').map(|rate| rate.parse().ok().filter(|fps| (1..=240).contains(fps))).collect::<Option<_>>()?;
    if fps.len() > MODES {
        return None;
    }
    let side = |text: &str| text.parse().ok().filter(|side| (16..=1920).contains(side) && side % 2 == 0);
    Some(Mode { format, width: side(width)?, height: side(height)?, fps })
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Mjpg => "MJPG",
            Self::Yuyv => "YUYV",
            Self::Z16 => "Z16",
        })
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rates: Vec<String> = self.fps.iter().map(u32::to_string).collect();
        write!(f, "{}-{}x{}@{}", self.format, self.width, self.height, rates.join("/"))
    }
}

impl fmt::Display for DeviceSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Identity { vid, pid, .. } = self.identity;
        let [serial, product, manufacturer] =
            [&self.identity.serial, &self.identity.product, &self.identity.manufacturer].map(|text| escaped(text));
        write!(
            f,
            "{}:vid={vid:04x},pid={pid:04x},serial={serial},product={product},manufacturer={manufacturer}",
            self.kind.name()
        )?;
        if let Some(port) = self.port {
            write!(f, ",port={port}")?;
        }
        if !self.feed.is_empty() {
            write!(f, ",feed={}", escaped(&self.feed))?;
        }
        match &self.kind {
            Kind::Uvc(cameras) => cameras.iter().enumerate().try_for_each(|(place, modes)| {
                let keys = std::iter::once(if place == 0 { "mode" } else { "also" }).chain(std::iter::repeat("mode"));
                keys.zip(modes).try_for_each(|(key, mode)| write!(f, ",{key}={mode}"))
            }),
            Kind::Acm { hz } | Kind::Ftdi { hz } => write!(f, ",hz={hz}"),
            Kind::Can { motors, .. } => motors.iter().try_for_each(|motor| write!(f, ",motor={motor}")),
            Kind::Ecm(net) => {
                net.gopro.map_or(Ok(()), |megabytes| write!(f, ",gopro={megabytes}"))?;
                net.lidar.map_or(Ok(()), |hz| write!(f, ",lidar={hz}"))
            }
            Kind::Gpio => Ok(()),
        }
    }
}

#[cfg(test)]
#[path = "spec_tests.rs"]
mod tests;
