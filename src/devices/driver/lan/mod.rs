//! Devices on the network, and behind network adapters.
//!
//! A device's location comes with its attachment: the interface of its USB network adapter, or an address that was
//! found. Sockets are bound to the interface if there is one, so that a device behind an adapter is never confused with
//! another of the same address elsewhere.
//!
//! Nothing reports that a device on the network is gone: every wait here is bounded, and receptions are noted in the
//! node for the task that tracks its lease (`hotplug::lan`).
//!
//! Invariant: everything a server sends is bounded: headers, bodies, pictures, packets, and their duration.
//! Invariant: only the entry's own device is accepted.

mod address;
mod gopro;
mod http;
mod iphone;
mod jpeg;
mod mjpeg;
mod multipart;
mod remote;
mod udp;

use std::time::Duration;

use rapid_core::clip::ClipNotice;
use rapid_core::provenance::{Format, Negotiated};
use rapid_registry::device::DeviceNode;
use rapid_registry::{DeviceSpec, LanFind, LanPicture, LanProtocol, LanSpec, RemoteSamples};

use tokio::sync::mpsc;

use super::{Agreed, ClockOffset, DriverError, Reading};
use crate::link::{LinkState, LinkWatch, NetworkLink};
use address::DeviceAddress;

/// A camera or a phone that sends no complete sample for this long is reconnected. Six of these and the delays between
/// them fit into the minute in which five restarts are allowed.
const PATIENCE: Duration = Duration::from_secs(5);

/// A device on the network.
#[derive(Debug)]
pub struct Lan {
    protocol: Protocol,
    link: LinkWatch,
    pub(super) agreed: Agreed,
}

#[derive(Debug)]
enum Protocol {
    Mjpeg(mjpeg::Camera),
    Udp(udp::Packets),
    Gopro(gopro::Gopro),
    Iphone(iphone::Phone),
    Remote(Box<remote::Remote>),
}

impl Lan {
    /// If the link to the device at `node` is down, a future that ends when it is up again.
    pub fn unlinked(node: &DeviceNode) -> Option<impl Future<Output = ()> + Send + use<>> {
        let link = link_of(node);
        (link.state() == LinkState::Down).then_some(async move { link.restored().await })
    }

    /// Opens the device of `spec` at `node`.
    ///
    /// # Errors
    /// When it does not answer, sends an unexpected answer, or a local port is taken.
    pub async fn open(spec: &DeviceSpec, lan: &LanSpec, node: &DeviceNode) -> Result<Self, DriverError> {
        let host = match &lan.find {
            LanFind::Adapter { host } => *host,
            LanFind::Mdns { .. } | LanFind::Host { .. } => None,
        };
        let place = DeviceAddress::new(node, host)?;
        let at = place.to_string();
        let protocol = match &lan.protocol {
            LanProtocol::Mjpeg { port, path, picture } => {
                let server = place.server(port.unwrap_or_else(|| place.port().unwrap_or(80)))?;
                Protocol::Mjpeg(mjpeg::Camera::open(&spec.name, server, path, *picture, spec.max_bytes).await?)
            }
            LanProtocol::Udp { port } => Protocol::Udp(udp::Packets::open(place, *port, spec.max_bytes)?),
            LanProtocol::Gopro { port, download, reserve, preview } => {
                let clips = gopro::Clips { download: *download, reserve: *reserve };
                let preview = preview.map(|picture| (picture, spec.max_bytes));
                Protocol::Gopro(gopro::Gopro::open(&spec.name, &place, *port, clips, preview).await?)
            }
            LanProtocol::Iphone { port, stream, picture } => {
                Protocol::Iphone(iphone::Phone::open(&spec.name, place, *port, *stream, *picture, spec.max_bytes)?)
            }
            LanProtocol::Remote { host, device, port, samples } => {
                let server = place.server(*port)?;
                let wanted = remote::Wanted { host, device, samples: *samples, lease: lan.lease };
                Protocol::Remote(Box::new(remote::Remote::open(&spec.name, server, wanted, spec.max_bytes).await?))
            }
        };
        let (description, format) = describe(lan, &at);
        let card = if let Protocol::Gopro(gopro) = &protocol { gopro.card() } else { None };
        let negotiated = Negotiated { card, bus: Some(at), format, ..Negotiated::default() };
        Ok(Self { protocol, link: LinkWatch::new(link_of(node)), agreed: Agreed { description, negotiated } })
    }

    /// The next sample.
    ///
    /// # Errors
    /// [`DriverError::Gone`] when the network adapter was unplugged, [`DriverError::Unlinked`] when its link went
    /// down, [`DriverError::Retry`] when the device ended its stream or fell silent.
    pub async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let Self { protocol, link, .. } = self;
        let read = async {
            match protocol {
                Protocol::Mjpeg(camera) => camera.read().await,
                Protocol::Udp(packets) => packets.read().await,
                Protocol::Gopro(gopro) => gopro.read().await,
                Protocol::Iphone(phone) => phone.read().await,
                Protocol::Remote(remote) => remote.read().await,
            }
        };
        tokio::select! {
            biased;
            reading = read => reading,
            () = link.lost() => Err(DriverError::Unlinked),
        }
    }

    /// The clock of the phone, or of the computer that the device is on, if that is another one.
    pub fn clock(&self) -> Option<ClockOffset> {
        match &self.protocol {
            Protocol::Remote(remote) => remote.clock(),
            Protocol::Iphone(phone) => phone.clock(),
            Protocol::Mjpeg(_) | Protocol::Udp(_) | Protocol::Gopro(_) => None,
        }
    }

    /// What a camera that records by itself does; `Some` at the first call only.
    pub fn clips(&mut self) -> Option<mpsc::Receiver<ClipNotice>> {
        if let Protocol::Gopro(gopro) = &mut self.protocol { gopro.clips() } else { None }
    }

    /// The episode with this file begins, or with `None` the one in progress ends: a camera that records by itself
    /// follows it. Returns at once.
    ///
    /// # Errors
    /// When the device does not accept it.
    pub fn record(&mut self, episode: Option<std::path::PathBuf>) -> Result<(), DriverError> {
        if let Protocol::Gopro(gopro) = &self.protocol {
            gopro.record(episode);
        }
        Ok(())
    }

    /// Ends in order the device's own activities.
    pub async fn close(self) {
        if let Protocol::Gopro(gopro) = self.protocol {
            gopro.close().await;
        }
    }
}

/// The link of a network adapter, which stays plugged in when its cable, or the device behind it, is pulled. For a
/// device found on the network, discovery monitors the link.
fn link_of(node: &DeviceNode) -> NetworkLink {
    if let DeviceNode::Net(interface) = node { NetworkLink::of_interface(interface) } else { NetworkLink::default() }
}

fn describe(lan: &LanSpec, at: &str) -> (String, Option<Format>) {
    let pictures = |picture: LanPicture| {
        let LanPicture { width, height, .. } = picture;
        // The rate of pictures is not negotiated.
        Some(Format::Pictures { fourcc: "MJPG".to_owned(), width, height, fps: None })
    };
    match &lan.protocol {
        LanProtocol::Mjpeg { path, picture, .. } => {
            (format!("camera at {at}, MJPG {}x{} from {path}", picture.width, picture.height), pictures(*picture))
        }
        LanProtocol::Udp { port } => (format!("packets from {at} to port {port}"), None),
        LanProtocol::Gopro { preview: None, .. } => (format!("GoPro at {at}"), None),
        LanProtocol::Gopro { preview: Some(picture), .. } => {
            (format!("GoPro at {at}, preview {}x{}", picture.width, picture.height), pictures(*picture))
        }
        LanProtocol::Iphone { port, picture, .. } => {
            let shape = lan.shape();
            let format = if shape.len() == 2 { pictures(*picture) } else { None };
            (format!("phone at {at}, which connects to port {port}"), format)
        }
        LanProtocol::Remote { host, device, samples, .. } => {
            let format = match *samples {
                RemoteSamples::Pictures(LanPicture { width, height, .. }, format) => {
                    Some(Format::Pictures { fourcc: format.to_string(), width, height, fps: None })
                }
                RemoteSamples::Numbers(_) | RemoteSamples::Bytes => None,
            };
            (format!("{device} of {host}"), format)
        }
    }
}

#[doc(hidden)]
pub mod fuzzing;
