//! The words `devices.toml` uses for our types: read by the parser, written by everything that
//! shows an entry.

use std::fmt;

use super::spec::{CanAdapter, CanProtocol, Framing, Mount, NodeSpec, Opens, Parse, PixelFormat, Stop, WhenStale};
use crate::modality::ModalityKind;

impl PixelFormat {
    /// Every format and its V4L2 name.
    pub const WORDS: [(&str, Self); 3] = [("MJPG", Self::Mjpg), ("YUYV", Self::Yuyv), ("GREY", Self::Grey)];
}

impl Parse {
    /// Every kind of content and its name.
    pub const WORDS: [(&str, Self); 4] =
        [("csv", Self::Csv), ("json", Self::Json), ("f32le", Self::F32le), ("raw", Self::Raw)];
}

impl Mount {
    /// Every slot and its name.
    pub const WORDS: [(&str, Self); 4] =
        [("front", Self::Front), ("tip", Self::Tip), ("top", Self::Top), ("bottom", Self::Bottom)];
}

impl CanAdapter {
    /// Every kind of adapter and its name.
    pub const WORDS: [(&str, Self); 3] =
        [("socketcan", Self::SocketCan), ("slcan", Self::Slcan), ("damiao", Self::Damiao)];

    /// The word for it.
    #[must_use]
    pub fn word(self) -> &'static str {
        word(&Self::WORDS, &self)
    }
}

impl Stop {
    /// Every way to stop and its name.
    pub const WORDS: [(&str, Self); 4] =
        [("limp", Self::Limp), ("damp", Self::Damp), ("hold", Self::Hold), ("brake", Self::Brake)];

    /// The word for it.
    #[must_use]
    pub fn word(self) -> &'static str {
        word(&Self::WORDS, &self)
    }
}

impl Opens {
    /// Every node a program may open and its name.
    pub const WORDS: [(&str, Self); 3] = [("video", Self::Video), ("tty", Self::Tty), ("usb", Self::Usb)];

    /// The word for it.
    #[must_use]
    pub fn word(self) -> &'static str {
        if self == Self::Net { "net" } else { word(&Self::WORDS, &self) }
    }
}

/// What the samples of a program may hold.
pub(super) const KINDS: [(&str, ModalityKind); 3] =
    [("scalars", ModalityKind::Scalars), ("image", ModalityKind::Image), ("bytes", ModalityKind::Bytes)];

impl WhenStale {
    /// Every policy and its name.
    pub const WORDS: [(&str, Self); 2] = [("hold", Self::Hold), ("zero", Self::Zero)];
}

fn word<T: PartialEq>(words: &[(&'static str, T)], value: &T) -> &'static str {
    words.iter().find(|(_, named)| named == value).map_or("", |(word, _)| word)
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(word(&Self::WORDS, self))
    }
}

impl fmt::Display for Parse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(word(&Self::WORDS, self))
    }
}

impl fmt::Display for Mount {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(word(&Self::WORDS, self))
    }
}

impl fmt::Display for WhenStale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(word(&Self::WORDS, self))
    }
}

impl fmt::Display for CanAdapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(word(&Self::WORDS, self))
    }
}

impl fmt::Display for Opens {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

impl fmt::Display for Framing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line => f.write_str("line"),
            Self::Cobs => f.write_str("cobs"),
            Self::Fixed(bytes) => write!(f, "fixed {bytes}"),
        }
    }
}

impl NodeSpec {
    /// The kind of node: `camera`, `serial`, `can`, `lan` or `process`.
    #[must_use]
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::Camera(_) => "camera",
            Self::Serial(_) => "serial",
            Self::Process(_) => "process",
            Self::Can(_) => "can",
            Self::Lan(_) => "lan",
        }
    }

    /// The format on one line: `640x480@30 MJPG`, `115200 baud line csv x3`, `tactile_publisher scalars x16`.
    #[must_use]
    pub fn format(&self) -> String {
        match self {
            Self::Camera(camera) => format!("{}x{}@{} {}", camera.width, camera.height, camera.fps, camera.format),
            Self::Serial(serial) if serial.parse == Parse::Raw => {
                format!("{} baud {} raw", serial.baud, serial.framing)
            }
            Self::Can(can) => match &can.protocol {
                CanProtocol::Raw => format!("{} {} bit/s raw", can.adapter, can.bitrate),
                CanProtocol::Damiao(damiao) => {
                    format!("{} {} bit/s damiao x{}", can.adapter, can.bitrate, damiao.motors.len())
                }
            },
            Self::Lan(lan) => lan.format(),
            Self::Serial(serial) => {
                format!("{} baud {} {} x{}", serial.baud, serial.framing, serial.parse, serial.channels)
            }
            Self::Process(process) => {
                let name = process.program.file_name().unwrap_or(process.program.as_os_str()).display();
                match process.shape.as_slice() {
                    [height, width] => format!("{name} {width}x{height}"),
                    [channels] => format!("{name} scalars x{channels}"),
                    _ => format!("{name} {}", word(&KINDS, &process.kind)),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_has_a_word() {
        let formats = [PixelFormat::Mjpg, PixelFormat::Yuyv, PixelFormat::Grey].map(|format| format.to_string());
        assert_eq!(formats, ["MJPG", "YUYV", "GREY"]);
        let parses = [Parse::Csv, Parse::Json, Parse::F32le, Parse::Raw].map(|parse| parse.to_string());
        assert_eq!(parses, ["csv", "json", "f32le", "raw"]);
        let mounts = [Mount::Front, Mount::Tip, Mount::Top, Mount::Bottom].map(|mount| mount.to_string());
        assert_eq!(mounts, ["front", "tip", "top", "bottom"]);
        assert_eq!([WhenStale::Hold, WhenStale::Zero].map(|stale| stale.to_string()), ["hold", "zero"]);
        assert_eq!(Framing::Fixed(12).to_string(), "fixed 12");
    }
}
