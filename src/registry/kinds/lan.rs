//! `[device.NAME.lan]`: a device on the network, or behind a network adapter.

mod keys;

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use rapid_core::modality::ModalityKind;
use rapid_core::remote;

use super::camera::PixelFormat;
use super::{Kind, STALL_AFTER, compressed};
use crate::spec::{Opens, VerdictSpec};
use crate::system_files::{Needs, quoted};

pub(crate) use keys::{TABLE, check_gopros, check_instances, check_ports, read};

/// See the module's comment.
#[derive(Debug, Clone, PartialEq)]
pub struct LanSpec {
    /// Its protocol.
    pub protocol: LanProtocol,
    /// How it is found.
    pub find: LanFind,
    /// How long it counts as present after data was last received from it, 500 ms to 60 s, default 3 s; of a device of
    /// another computer 1 s.
    pub lease: Duration,
}

/// The protocol of a device on the network.
#[derive(Debug, Clone, PartialEq)]
pub enum LanProtocol {
    /// Pictures over HTTP, `multipart/x-mixed-replace`; one sample per picture.
    Mjpeg {
        /// Port of its HTTP server; `None` is what mDNS reported, or 80.
        port: Option<u16>,
        /// The requested path, beginning with `/`, default `/`.
        path: String,
        /// The format of the pictures.
        picture: LanPicture,
    },
    /// Packets sent to a port of this computer, one sample each.
    Udp {
        /// The port.
        port: u16,
    },
    /// A GoPro, which records by itself; one sample per query of its state.
    Gopro {
        /// Port of its HTTP server, default 8080.
        port: u16,
        /// Whether its clips are downloaded after the episode. Default no.
        download: bool,
        /// `disk_reserve` of the rig, bytes: downloads leave this space free, plus room for an episode.
        reserve: Option<u64>,
        /// The format of the pictures of its preview stream, if they are its samples. Default: its state is.
        preview: Option<LanPicture>,
    },
    /// A phone that connects to this computer and sends pictures with the camera's pose.
    Iphone {
        /// The port of this computer that it connects to, default 5555.
        port: u16,
        /// Which part is the sample.
        stream: PhoneStream,
        /// The format of the pictures, default 1920x1440 at 30.
        picture: LanPicture,
    },
    /// A device of a `rapid` on another computer; one sample per sample there.
    Remote {
        /// The name of that computer.
        host: String,
        /// The name of the device there, default that of the entry.
        device: String,
        /// Port of `rapid-remote` on this computer, default [`remote::PORT`].
        port: u16,
        /// Its samples.
        samples: RemoteSamples,
    },
}

/// The samples of a device of another computer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RemoteSamples {
    /// Pictures in this format.
    Pictures(LanPicture, PixelFormat),
    /// So many numbers each, `1..=1024`.
    Numbers(u32),
    /// Bytes.
    Bytes,
}

/// The format of the pictures of a network camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LanPicture {
    /// Pixels, `1..=8192`, default 640.
    pub width: u32,
    /// Pixels, `1..=8192`, default 480.
    pub height: u32,
    /// Frames per second, `1..=1000`, default 30.
    pub fps: u32,
}

/// Which part of a phone's data is the sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PhoneStream {
    /// The picture, with the pose in a comment.
    Image,
    /// The pose: 16 values, 4 by 4, column by column.
    Pose,
}

/// How a device on the network is found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LanFind {
    /// It is a network adapter with the USB identity of the entry, or is behind one.
    Adapter {
        /// Its address, if the protocol does not report it.
        host: Option<IpAddr>,
    },
    /// It announces a service.
    Mdns {
        /// The service, for example `_iphonevio._tcp`.
        service: String,
        /// The instance of it, if only one is to match.
        instance: Option<String>,
    },
    /// It has a fixed address, which is probed.
    Host {
        /// The address.
        host: IpAddr,
        /// How it is probed.
        probe: Probe,
        /// Which port is probed; for [`Probe::Udp`] the one of this computer that receives its packets.
        port: u16,
    },
}

/// How the presence of a device at a fixed address is checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Probe {
    /// It accepts a TCP connection.
    Tcp,
    /// It answers an HTTP request with any answer.
    Http,
    /// Its packets arrive.
    Udp,
    /// `rapid-remote` reports that it is present.
    Remote,
}

/// The program that decodes the preview of a GoPro.
pub const PREVIEW_DECODER: &str = "ffmpeg";
/// Port of a server whose port is not reported.
const HTTP_PORT: u16 = 80;
/// The pose of a phone's camera is a matrix of 4 by 4.
const POSE: u32 = 16;

impl LanFind {
    /// Whether the device is a network adapter, or behind one.
    pub const fn is_adapter(&self) -> bool {
        matches!(self, Self::Adapter { .. })
    }

    /// The service that announces it, and the instance if only one is to match; both without regard to case.
    pub(crate) fn announced(&self) -> Option<(&str, Option<&str>)> {
        match self {
            Self::Mdns { service, instance } => Some((service.as_str(), instance.as_deref())),
            Self::Adapter { .. } | Self::Host { .. } => None,
        }
    }

    /// Whether sockets of IPv4, and whether those of IPv6, are opened for such a device. Behind an adapter without a
    /// `host` the addresses are IPv4; mDNS uses both.
    pub const fn families(&self) -> [bool; 2] {
        match self {
            Self::Mdns { .. } => [true, true],
            Self::Adapter { host: None } => [true, false],
            Self::Adapter { host: Some(host) } | Self::Host { host, .. } => [host.is_ipv4(), host.is_ipv6()],
        }
    }
}

/// The local address at which a device at `peer` reaches this computer. A device on this machine has a loopback
/// address, and so does the local side: nothing from outside gets there. For any other device it is the wildcard
/// address: a broadcast, as LiDARs send, is not received at a specific one.
pub fn own_side(peer: Option<IpAddr>) -> IpAddr {
    match peer {
        Some(peer) if peer.to_canonical().is_loopback() => peer,
        Some(IpAddr::V6(_)) => IpAddr::V6(Ipv6Addr::UNSPECIFIED),
        Some(IpAddr::V4(_)) | None => IpAddr::V4(Ipv4Addr::UNSPECIFIED),
    }
}

impl LanPicture {
    /// Pictures of a phone unless the entry states otherwise.
    pub(crate) const OF_A_PHONE: Self = Self { width: 1920, height: 1440, fps: 30 };
    /// Pictures of a camera unless the entry states otherwise.
    pub(crate) const OF_A_CAMERA: Self = Self { width: 640, height: 480, fps: 30 };

    /// Of such pictures, what is kept for a reader: about two seconds.
    pub(crate) fn depth(self) -> u64 {
        (2 * u64::from(self.fps)).clamp(16, 1024)
    }

    /// Ten periods of a slow camera, or what is usual.
    pub(crate) fn stall_after(self) -> Duration {
        (Duration::from_secs(10) / self.fps.max(1)).max(STALL_AFTER)
    }
}

impl LanSpec {
    /// Whether its samples are the states of a GoPro.
    const fn is_state_of_a_gopro(&self) -> bool {
        matches!(self.protocol, LanProtocol::Gopro { preview: None, .. })
    }

    const fn is_remote(&self) -> bool {
        matches!(self.protocol, LanProtocol::Remote { .. })
    }

    /// Applies the rig's settings for the disk.
    pub(crate) fn keep_free(&mut self, disk_reserve: Option<u64>) {
        if let LanProtocol::Gopro { reserve, .. } = &mut self.protocol {
            *reserve = disk_reserve;
        }
    }

    /// Image: `[height, width]`. Scalars: how many. Bytes: empty.
    pub fn shape(&self) -> Vec<u32> {
        match (self.modality_kind(), self.picture()) {
            (ModalityKind::Image | ModalityKind::Depth, Some(picture)) => vec![picture.height, picture.width],
            (ModalityKind::Scalars, _) => vec![self.numbers()],
            _ => Vec::new(),
        }
    }

    /// How many numbers a sample of numbers has.
    const fn numbers(&self) -> u32 {
        match &self.protocol {
            LanProtocol::Remote { samples: RemoteSamples::Numbers(count), .. } => *count,
            _ => POSE,
        }
    }

    /// The line that `rapid-remote` is sent for it, if it is a device of another computer.
    pub fn request(&self) -> Option<String> {
        let LanProtocol::Remote { host, device, .. } = &self.protocol else { return None };
        Some(remote::request(host, device))
    }

    /// The port at which the device is reached, or at which it reaches this computer, if the entry states it.
    pub const fn port(&self) -> Option<u16> {
        match &self.protocol {
            LanProtocol::Mjpeg { port, .. } => *port,
            LanProtocol::Udp { port }
            | LanProtocol::Gopro { port, .. }
            | LanProtocol::Iphone { port, .. }
            | LanProtocol::Remote { port, .. } => Some(*port),
        }
    }

    /// The socket address of a device at this address.
    pub fn server(&self, host: IpAddr) -> SocketAddr {
        SocketAddr::new(host, self.port().unwrap_or(HTTP_PORT))
    }

    /// The port of this computer that it needs: whether it is UDP, and its number.
    pub const fn own_port(&self) -> Option<(bool, u16)> {
        match &self.protocol {
            LanProtocol::Udp { port } => Some((true, *port)),
            LanProtocol::Iphone { port, .. } => Some((false, *port)),
            LanProtocol::Mjpeg { .. } | LanProtocol::Gopro { .. } | LanProtocol::Remote { .. } => None,
        }
    }
}

impl Kind for LanSpec {
    fn modality_kind(&self) -> ModalityKind {
        match &self.protocol {
            LanProtocol::Mjpeg { .. }
            | LanProtocol::Iphone { stream: PhoneStream::Image, .. }
            | LanProtocol::Gopro { preview: Some(_), .. } => ModalityKind::Image,
            LanProtocol::Iphone { stream: PhoneStream::Pose, .. } => ModalityKind::Scalars,
            LanProtocol::Udp { .. } | LanProtocol::Gopro { preview: None, .. } => ModalityKind::Bytes,
            LanProtocol::Remote { samples, .. } => match samples {
                RemoteSamples::Pictures(_, PixelFormat::Z16) => ModalityKind::Depth,
                RemoteSamples::Pictures(..) => ModalityKind::Image,
                RemoteSamples::Numbers(_) => ModalityKind::Scalars,
                RemoteSamples::Bytes => ModalityKind::Bytes,
            },
        }
    }

    fn shape(&self) -> Vec<u32> {
        self.shape()
    }

    fn opens(&self) -> Opens {
        Opens::Net
    }

    fn picture(&self) -> Option<LanPicture> {
        match &self.protocol {
            LanProtocol::Mjpeg { picture, .. }
            | LanProtocol::Iphone { picture, .. }
            | LanProtocol::Remote { samples: RemoteSamples::Pictures(picture, _), .. } => Some(*picture),
            LanProtocol::Gopro { preview, .. } => *preview,
            LanProtocol::Udp { .. } | LanProtocol::Remote { .. } => None,
        }
    }

    fn format(&self) -> String {
        match &self.protocol {
            LanProtocol::Mjpeg { path, picture: LanPicture { width, height, fps }, .. } => {
                format!("mjpeg {width}x{height} {fps} fps {path}")
            }
            LanProtocol::Udp { port } => format!("udp port {port}"),
            LanProtocol::Gopro { preview: None, .. } => "gopro".to_owned(),
            LanProtocol::Gopro { preview: Some(LanPicture { width, height, fps }), .. } => {
                format!("gopro preview {width}x{height} {fps} fps")
            }
            LanProtocol::Iphone { stream: PhoneStream::Pose, port, .. } => format!("iphone pose port {port}"),
            LanProtocol::Iphone { port, picture: LanPicture { width, height, fps }, .. } => {
                format!("iphone {width}x{height} {fps} fps port {port}")
            }
            LanProtocol::Remote { host, device, samples, .. } => {
                let samples = match samples {
                    RemoteSamples::Pictures(LanPicture { width, height, fps }, format) => {
                        format!("{format} {width}x{height} {fps} fps")
                    }
                    RemoteSamples::Numbers(count) => format!("{count} values"),
                    RemoteSamples::Bytes => "bytes".to_owned(),
                };
                format!("{device} of {host}, {samples}")
            }
        }
    }

    fn descriptor(&self) -> String {
        format!("    format: {}\n", quoted(&self.format()))
    }

    fn sizes(&self) -> (u64, u64) {
        match (self.modality_kind(), self.picture()) {
            (ModalityKind::Image | ModalityKind::Depth, Some(picture)) => {
                let pixels = u64::from(picture.width) * u64::from(picture.height);
                // A phone compresses to about a fifth of a byte per pixel (quality 0.7), and its pictures are large.
                let is_phone = matches!(self.protocol, LanProtocol::Iphone { .. });
                (compressed(if is_phone { pixels / 2 } else { 2 * pixels }), 4096)
            }
            (ModalityKind::Scalars, _) => (8 * u64::from(self.numbers()), 8 * u64::from(self.numbers())),
            (ModalityKind::Bytes, _) if self.is_remote() => (64 << 10, 1),
            // The payload of an Ethernet frame is under 1500.
            _ => (2048, 64),
        }
    }

    fn depth(&self) -> u64 {
        match self.picture() {
            Some(picture) => picture.depth(),
            None if self.is_state_of_a_gopro() => 16,
            None if self.is_remote() && self.modality_kind() == ModalityKind::Bytes => 60,
            None => 2048,
        }
    }

    fn stall_after(&self) -> Duration {
        match self.picture() {
            Some(picture) => picture.stall_after(),
            // Its state is read every 3 s.
            None if self.is_state_of_a_gopro() => Duration::from_secs(10),
            None => STALL_AFTER,
        }
    }

    fn judge(&self, limits: &mut VerdictSpec, sync_window: Duration) {
        if self.is_state_of_a_gopro() {
            // Its samples report its state once a second, and are not observations: its pictures are in the clip.
            (limits.suspect.valid, limits.bad.valid) = (None, None);
        }
        if matches!(self.protocol, LanProtocol::Gopro { .. }) {
            *limits = limits.of_a_recorder();
        }
        if self.is_remote() || matches!(self.protocol, LanProtocol::Iphone { .. }) {
            *limits = limits.of_another_clock(sync_window);
        }
    }

    fn bytes_per_second(&self, max_bytes: usize) -> Option<f64> {
        Some(f64::from(self.picture()?.fps) * max_bytes as f64)
    }

    fn need(&self, needs: &mut Needs) {
        let families = ["AF_INET", "AF_INET6"].into_iter().zip(self.find.families());
        needs.sockets.extend(families.filter(|(_, is_needed)| *is_needed).map(|(family, _)| family));
    }
}
