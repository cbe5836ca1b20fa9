//! Where a device is reached: an interface, an address, or both.

use std::ffi::CStr;
use std::fmt;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;
use std::time::Duration;

use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::time::timeout;

use crate::driver::DriverError;
use crate::registry::{DeviceNode, Heard, own_side};

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
    heard: Heard,
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
                Ok(Self { interface: Some(interface.clone()), address, heard: Heard::default() })
            }
            DeviceNode::Lan { address, heard } => {
                Ok(Self { interface: None, address: Some(*address), heard: heard.clone() })
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

    /// The device was heard of, now.
    pub(super) fn heard(&self) {
        self.heard.now();
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
        addresses()
            .into_iter()
            .find(|(name, address)| name == interface && wanted(*address))
            .map(|(_, address)| address)
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

/// Every IPv4 address of ours, with the name of its interface.
fn addresses() -> Vec<(String, Ipv4Addr)> {
    let mut first: *mut libc::ifaddrs = std::ptr::null_mut();
    // SAFETY: the pointer is written by the call, and given back below.
    if unsafe { libc::getifaddrs(&raw mut first) } != 0 {
        return Vec::new();
    }
    let mut found = Vec::new();
    let mut next = first;
    // SAFETY: the list is the kernel's until it is freed; its links are valid or null.
    while let Some(entry) = unsafe { next.as_ref() } {
        next = entry.ifa_next;
        // SAFETY: an address is null or one of the family that it says.
        let Some(address) = (unsafe { entry.ifa_addr.as_ref() }) else { continue };
        if i32::from(address.sa_family) != libc::AF_INET {
            continue;
        }
        // SAFETY: of this family it is a `sockaddr_in`, which may lie unaligned; the name ends in a zero.
        let (address, name) =
            unsafe { (entry.ifa_addr.cast::<libc::sockaddr_in>().read_unaligned(), CStr::from_ptr(entry.ifa_name)) };
        let address = Ipv4Addr::from(u32::from_be(address.sin_addr.s_addr));
        found.push((name.to_string_lossy().into_owned(), address));
    }
    // SAFETY: from getifaddrs, freed once.
    unsafe { libc::freeifaddrs(first) };
    found
}
