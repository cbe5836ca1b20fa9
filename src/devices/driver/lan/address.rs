//! Where a device is reached: through an interface, at an address, or both.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;
use std::{fmt, io};

use rapid_registry::device::{DeviceNode, LastReceived};
use rapid_registry::own_side;
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::time::timeout;

use crate::driver::DriverError;
use crate::link::{LinkState, NetworkLink};

/// A device on the same network answers within milliseconds.
const CONNECT_LIMIT: Duration = Duration::from_secs(2);
/// Pending connections; only one is expected.
const BACKLOG: u32 = 4;

#[derive(Debug, Clone)]
pub(super) struct DeviceAddress {
    interface: Option<String>,
    /// With the scope of a link-local address.
    address: Option<SocketAddr>,
    last_received: LastReceived,
}

/// A server of a device.
#[derive(Debug, Clone)]
pub(super) struct Server {
    pub(super) place: DeviceAddress,
    pub(super) address: SocketAddr,
}

impl DeviceAddress {
    /// `host` is the device's address if the node is only an interface.
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

    /// The port at which the device was found.
    pub(super) fn port(&self) -> Option<u16> {
        self.address.map(|address| address.port()).filter(|port| *port > 0)
    }

    /// Something was received from the device just now.
    pub(super) fn received(&self) {
        self.last_received.now();
    }

    /// Whether this address belongs to the device.
    pub(super) fn means(&self, address: IpAddr) -> bool {
        self.peer().is_none_or(|peer| peer.to_canonical() == address.to_canonical())
    }

    /// The device's server at this port.
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

    /// Whether the interface, and so the device, is gone.
    pub(super) fn is_gone(&self) -> bool {
        self.interface.as_ref().is_some_and(|interface| NetworkLink::of_interface(interface).state() == LinkState::Gone)
    }

    /// The error for a device that no longer answers.
    pub(super) fn lost(&self, what: impl fmt::Display) -> DriverError {
        if self.is_gone() { DriverError::Gone } else { DriverError::Retry(format!("{self}: {what}")) }
    }

    /// Listens at a local port, only on the interface if there is one.
    pub(super) fn listen(&self, port: u16) -> Result<TcpListener, DriverError> {
        let own = own_side(self.peer());
        let listen = || {
            let socket = self.socket(own)?;
            // A connection that ended a moment ago still holds the port.
            socket.set_reuseaddr(true)?;
            socket.bind(SocketAddr::new(own, port))?;
            socket.listen(BACKLOG)
        };
        listen().map_err(|error| port_error(port, &error))
    }

    /// The local address on the interface for which `wanted` is true.
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

impl fmt::Display for DeviceAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.peer(), &self.interface) {
            (Some(peer), Some(interface)) => write!(f, "{peer} at {interface}"),
            (Some(peer), None) => write!(f, "{peer}"),
            (None, Some(interface)) => f.write_str(interface),
            (None, None) => f.write_str("anywhere"),
        }
    }
}

/// Why a local port cannot be used.
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
