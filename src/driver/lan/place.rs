//! Where a device is reached: an interface, an address, or both.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fmt, fs, io};

use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::time::{Interval, MissedTickBehavior, interval, timeout};

use crate::driver::DriverError;
use crate::registry::{DeviceNode, LastReceived, own_side};

/// A device on the same network answers within milliseconds.
const CONNECT_LIMIT: Duration = Duration::from_secs(2);
/// Connections that wait to be taken; only one is meant.
const BACKLOG: u32 = 4;

/// See the module's comment.
#[derive(Debug, Clone)]
pub(super) struct Place {
    interface: Option<String>,
    /// With the scope of a link-local address.
    address: Option<SocketAddr>,
    last_received: LastReceived,
}

/// A server of a device.
#[derive(Debug, Clone)]
pub(super) struct Server {
    pub(super) place: Place,
    pub(super) address: SocketAddr,
}

impl Place {
    /// `host` is the device's address where the node is only an interface.
    pub(super) fn new(node: &DeviceNode, host: Option<IpAddr>) -> Result<Self, DriverError> {
        match node {
            DeviceNode::Net(interface) => {
                let address = host.map(|host| SocketAddr::new(host, 0));
                Ok(Self { interface: Some(interface.clone()), address, last_received: LastReceived::default() })
            }
            DeviceNode::Lan { address, last_received } => {
                Ok(Self { interface: None, address: Some(*address), last_received: last_received.clone() })
            }
            _ => Err(DriverError::Fatal(format!("{} is not on the network", node.label()))),
        }
    }

    pub(super) fn interface(&self) -> Option<&str> {
        self.interface.as_deref()
    }

    pub(super) fn peer(&self) -> Option<IpAddr> {
        Some(self.address?.ip())
    }

    /// The port it was found at.
    pub(super) fn port(&self) -> Option<u16> {
        self.address.map(|address| address.port()).filter(|port| *port > 0)
    }

    /// The device was received from, now.
    pub(super) fn received(&self) {
        self.last_received.now();
    }

    /// Is what comes from this address of the device?
    pub(super) fn means(&self, address: IpAddr) -> bool {
        self.peer().is_none_or(|peer| peer.to_canonical() == address.to_canonical())
    }

    /// Its server at this port.
    pub(super) fn server(&self, port: u16) -> Result<Server, DriverError> {
        let Some(mut address) = self.address else {
            let text = format!("{self}: write host = the device's address behind the network adapter");
            return Err(DriverError::Fatal(text));
        };
        address.set_port(port);
        Ok(Server { place: self.clone(), address })
    }

    /// The same place, with the device at this address.
    pub(super) fn at(&self, peer: IpAddr) -> Self {
        Self { address: Some(SocketAddr::new(peer, 0)), ..self.clone() }
    }

    /// Is the interface gone, and with it the device?
    pub(super) fn is_gone(&self) -> bool {
        let Some(interface) = &self.interface else { return false };
        !Path::new("/sys/class/net").join(interface).exists()
    }

    /// The error of a device that does not answer any more.
    pub(super) fn lost(&self, what: impl fmt::Display) -> DriverError {
        if self.is_gone() { DriverError::Gone } else { DriverError::Retry(format!("{self}: {what}")) }
    }

    /// Listens at a port of ours, on the interface alone if there is one.
    pub(super) fn listen(&self, port: u16) -> Result<TcpListener, DriverError> {
        let own = own_side(self.peer());
        let listen = || {
            let socket = self.socket(own)?;
            // A connection that ended a moment ago still has the port.
            socket.set_reuseaddr(true)?;
            socket.bind(SocketAddr::new(own, port))?;
            socket.listen(BACKLOG)
        };
        listen().map_err(|error| port_error(port, &error))
    }

    /// The address of ours on the interface for which `wanted` is true.
    pub(super) fn own_address(&self, wanted: impl Fn(Ipv4Addr) -> bool) -> Option<Ipv4Addr> {
        let interface = self.interface.as_deref()?;
        let of_it = if_addrs::get_if_addrs().ok()?.into_iter().filter(|own| own.name == interface);
        let addresses = of_it.filter_map(|own| if let IpAddr::V4(address) = own.ip() { Some(address) } else { None });
        addresses.into_iter().find(|address| wanted(*address))
    }

    fn socket(&self, family: IpAddr) -> io::Result<TcpSocket> {
        let socket = if family.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
        if let Some(interface) = &self.interface {
            socket.bind_device(Some(interface.as_bytes()))?;
        }
        socket.set_keepalive(true)?;
        Ok(socket)
    }
}

impl Server {
    /// Connects within [`CONNECT_LIMIT`].
    pub(super) async fn connect(&self) -> Result<TcpStream, DriverError> {
        let connect = async {
            let socket = self.place.socket(self.address.ip())?;
            socket.connect(self.address).await
        };
        match timeout(CONNECT_LIMIT, connect).await {
            Ok(Ok(stream)) => Ok(stream),
            Ok(Err(error)) => Err(self.place.lost(format_args!("port {}: {error}", self.address.port()))),
            Err(_) => Err(self.place.lost(format_args!("port {} does not answer", self.address.port()))),
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.peer(), &self.interface) {
            (Some(peer), Some(interface)) => write!(f, "{peer} at {interface}"),
            (Some(peer), None) => write!(f, "{peer}"),
            (None, Some(interface)) => f.write_str(interface),
            (None, None) => f.write_str("anywhere"),
        }
    }
}

/// Why a port of ours cannot be had.
pub(super) fn port_error(port: u16, error: &io::Error) -> DriverError {
    match error.kind() {
        io::ErrorKind::AddrInUse => DriverError::Retry(format!(
            "port {port} is held by another program or entry: end it (`ss -lntup` names it), or write another port"
        )),
        io::ErrorKind::PermissionDenied => {
            DriverError::Fatal(format!("port {port} may not be used: those under 1024 are root's; write another port"))
        }
        _ if error.raw_os_error() == Some(libc::ENODEV) => DriverError::Gone,
        _ => DriverError::Retry(format!("port {port}: {error}")),
    }
}

/// How often it is looked at.
const EVERY: Duration = Duration::from_millis(100);

/// The link of a network adapter: whether a cable, or the device, is at its other end. The adapter itself stays plugged
/// in when that goes, so nothing else reports it.
#[derive(Debug)]
pub(super) struct Carrier {
    /// Of an adapter: `1` with a link (Documentation/ABI/testing/sysfs-class-net, `carrier`).
    file: Option<PathBuf>,
    /// Adapters that never report are assumed to have one.
    was_up: bool,
    beat: Interval,
}

impl Carrier {
    /// That of the adapter at `node`, if it is one.
    pub(super) fn of(node: &DeviceNode) -> Self {
        let file = match node {
            DeviceNode::Net(interface) => Some(PathBuf::from("/sys/class/net").join(interface).join("carrier")),
            _ => None,
        };
        Self::watching(file)
    }

    fn watching(file: Option<PathBuf>) -> Self {
        let mut beat = interval(EVERY);
        beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Self { file, was_up: false, beat }
    }

    /// Is it known to be down?
    pub(super) fn is_down(&self) -> bool {
        self.file.as_ref().is_some_and(|file| matches!(fs::read(file).as_deref(), Ok([b'0', ..])))
    }

    /// Waits until it is up, or the adapter is gone. Cancel-safe.
    pub(super) async fn up(&mut self) {
        let Some(file) = &self.file else { return };
        loop {
            self.beat.tick().await;
            match fs::read(file) {
                Ok(reported) if reported.starts_with(b"1") => return,
                Err(error) if error.kind() == io::ErrorKind::NotFound => return,
                // Of an interface that is down nothing is known.
                _ => {}
            }
        }
    }

    /// Waits until it is lost, after it was there. Cancel-safe.
    pub(super) async fn lost(&mut self) {
        let Some(file) = &self.file else { return std::future::pending().await };
        loop {
            self.beat.tick().await;
            match fs::read(file).ok().as_deref() {
                Some([b'1', ..]) => self.was_up = true,
                Some([b'0', ..]) if self.was_up => return,
                // An interface that is down or gone has none to report; the latter is reported by others.
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::timeout;

    use super::*;

    #[tokio::test]
    async fn a_link_that_is_down_is_waited_for() {
        let file = tempfile::NamedTempFile::new().expect("file");
        fs::write(file.path(), "0\n").expect("written");
        let mut carrier = Carrier::watching(Some(file.path().to_owned()));
        assert!(carrier.is_down());
        assert!(timeout(Duration::from_millis(350), carrier.up()).await.is_err(), "it is down");
        fs::write(file.path(), "1\n").expect("written");
        carrier.up().await;
        assert!(!carrier.is_down());
        // The adapter is unplugged meanwhile.
        fs::write(file.path(), "0\n").expect("written");
        file.close().expect("removed");
        carrier.up().await;
        assert!(!carrier.is_down() && !Carrier::watching(None).is_down());
    }

    #[tokio::test]
    async fn only_a_link_that_was_there_is_lost() {
        let file = tempfile::NamedTempFile::new().expect("file");
        fs::write(file.path(), "0\n").expect("written");
        let mut carrier = Carrier::watching(Some(file.path().to_owned()));
        assert!(timeout(Duration::from_millis(350), carrier.lost()).await.is_err(), "it never was there");
        fs::write(file.path(), "1\n").expect("written");
        assert!(timeout(Duration::from_millis(350), carrier.lost()).await.is_err(), "it is there");
        fs::write(file.path(), "0\n").expect("written");
        carrier.lost().await;
        assert!(timeout(Duration::from_millis(350), Carrier::watching(None).lost()).await.is_err());
    }
}
