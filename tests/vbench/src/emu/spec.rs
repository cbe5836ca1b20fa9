//! The words that describe an emulated device: `KIND:key=value,...`.
//!
//! ```text
//! uvc:port=0,vid=046d,pid=0825,serial=CAM00A1,product=Wrist,mode=MJPG-640x480@30,mode=YUYV-320x240@30/15
//! acm:port=2,vid=2e8a,pid=000a,serial=TOF1,hz=100
//! ftdi:port=3,vid=0403,pid=6001,serial=FT1,hz=50
//! uvc:mode=MJPG-96x96@10,feed=/tmp/bench/wrist.feed
//! ```
//!
//! A comma, a per cent sign or a control character in a string is written as in a URL: `%2c`.
//!
//! Invariant: `Display` prints what `FromStr` reads, so the harness and the emulator share one vocabulary.

use std::fmt;
use std::str::FromStr;

use thiserror::Error;

/// Ports `vhci_hcd.0` has for high-speed devices in Debian's kernels.
pub const PORTS: u8 = 15;

/// Modes of one camera, and rates of one mode: far more than any test wants, far less than a descriptor holds.
const MODES: usize = 32;

/// A device to emulate.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceSpec {
    /// What it is.
    pub kind: Kind,
    /// Port it is plugged into first; without one, the device's place in the list.
    pub port: Option<u8>,
    /// How it names itself.
    pub identity: Identity,
    /// File of what it sends, see `feed`; empty: the bench's own pictures and lines.
    pub feed: String,
}

/// What a device says about itself.
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
    /// A camera with these modes, the first of them its default.
    Uvc(Vec<Mode>),
    /// CDC-ACM (`/dev/ttyACM*`) that sends lines at `hz`.
    Acm {
        /// Lines a second.
        hz: f64,
    },
    /// An FTDI adapter (`/dev/ttyUSB*`) that sends lines at `hz`.
    Ftdi {
        /// Lines a second.
        hz: f64,
    },
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
}

/// A specification that cannot be read.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum SpecError {
    /// No such kind.
    #[error("unknown kind `{0}`: use uvc, acm or ftdi")]
    Kind(String),
    /// A key this kind does not have, or no `=`.
    #[error("unknown key `{key}` for {kind}")]
    Key {
        /// The kind asked for.
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
        /// What is wanted.
        expected: &'static str,
    },
}

impl DeviceSpec {
    /// A camera; add modes with `mode`. Without any it is `MJPG-640x480@30`.
    pub fn uvc(vid: u16, pid: u16) -> Self {
        Self::new(Kind::Uvc(Vec::new()), vid, pid)
    }

    /// A CDC-ACM device sending `hz` lines a second.
    pub fn acm(vid: u16, pid: u16, hz: f64) -> Self {
        Self::new(Kind::Acm { hz }, vid, pid)
    }

    /// An FTDI adapter sending `hz` lines a second.
    pub fn ftdi(vid: u16, pid: u16, hz: f64) -> Self {
        Self::new(Kind::Ftdi { hz }, vid, pid)
    }

    /// Gives it a serial number.
    #[must_use]
    pub fn serial(mut self, serial: &str) -> Self {
        self.identity.serial = serial.into();
        self
    }

    /// Gives it these names instead of the bench's own.
    #[must_use]
    pub fn names(mut self, manufacturer: &str, product: &str) -> Self {
        self.identity.manufacturer = manufacturer.into();
        self.identity.product = product.into();
        self
    }

    /// Lets it send the records of this file of the guest: MJPEG pictures of a camera, lines of a serial device.
    #[must_use]
    pub fn feed(mut self, path: &str) -> Self {
        self.feed = path.into();
        self
    }

    /// Plugs it into this port first.
    #[must_use]
    pub fn port(mut self, port: u8) -> Self {
        self.port = Some(port);
        self
    }

    /// Adds a camera mode. Other kinds have none and ignore it.
    #[must_use]
    pub fn mode(mut self, format: Format, width: u16, height: u16, fps: &[u32]) -> Self {
        if let Kind::Uvc(modes) = &mut self.kind {
            modes.push(Mode { format, width, height, fps: fps.to_vec() });
        }
        self
    }

    fn new(kind: Kind, vid: u16, pid: u16) -> Self {
        let product = format!("Virtual {}", kind.name());
        let identity = Identity { vid, pid, serial: String::new(), product, manufacturer: "Bench".into() };
        Self { kind, port: None, identity, feed: String::new() }
    }
}

impl Kind {
    /// The word that names it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Uvc(_) => "uvc",
            Self::Acm { .. } => "acm",
            Self::Ftdi { .. } => "ftdi",
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
            other => return Err(SpecError::Kind(other.into())),
        };
        for field in fields.split(',').filter(|field| !field.is_empty()) {
            let unknown = || SpecError::Key { kind: kind.into(), key: field.into() };
            let (key, value) = field.split_once('=').ok_or_else(unknown)?;
            let wrong = |expected| SpecError::Value { key: key.into(), value: value.into(), expected };
            let hex = || u16::from_str_radix(value, 16).map_err(|_| wrong("four hexadecimal digits"));
            let string = || unescaped(value).ok_or_else(|| wrong("text, with %25 for a per cent sign"));
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
                ("mode", Kind::Uvc(modes)) if modes.len() < MODES => {
                    modes.push(parse_mode(value).ok_or_else(|| wrong("FORMAT-WxH@FPS[/FPS..], FORMAT MJPG or YUYV"))?);
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
        })
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
            Kind::Uvc(modes) => modes.iter().try_for_each(|mode| {
                let rates: Vec<String> = mode.fps.iter().map(u32::to_string).collect();
                write!(f, ",mode={}-{}x{}@{}", mode.format, mode.width, mode.height, rates.join("/"))
            }),
            Kind::Acm { hz } | Kind::Ftdi { hz } => write!(f, ",hz={hz}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_printed_is_read_back() {
        let camera = DeviceSpec::uvc(0x046d, 0x0825)
            .serial("CAM00A1")
            .port(3)
            .mode(Format::Mjpg, 640, 480, &[30])
            .mode(Format::Yuyv, 320, 240, &[30, 15]);
        let hostile = DeviceSpec::uvc(1, 2).serial("a,b=%2c\n\"'\\ \0相").names("\u{1b}[2J,", "%");
        for spec in [
            camera,
            hostile,
            DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1").feed("/tmp/bench/a,b"),
            DeviceSpec::ftdi(0x0403, 0x6001, 0.5),
        ] {
            assert_eq!(spec.to_string().parse(), Ok(spec));
        }
    }

    #[test]
    fn mistakes_are_named() {
        let cases = [
            ("cam:", "unknown kind `cam`: use uvc, acm or ftdi"),
            ("uvc:hz=3", "unknown key `hz=3` for uvc"),
            ("acm:serial=%4", "`serial=%4`: expected text, with %25 for a per cent sign"),
            ("acm:port=15", "`port=15`: expected a port from 0 to 14"),
            ("uvc:mode=MJPG-640@30", "`mode=MJPG-640@30`: expected FORMAT-WxH@FPS[/FPS..], FORMAT MJPG or YUYV"),
        ];
        for (text, message) in cases {
            assert_eq!(text.parse::<DeviceSpec>().unwrap_err().to_string(), message);
        }
    }
}
