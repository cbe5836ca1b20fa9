//! Packets that a device sends to a local port, for example from a LiDAR. One packet is one sample, unchanged, without
//! its IP and UDP headers.
//!
//! A packet's time is the moment the kernel took it from the network (`SO_TIMESTAMPNS`, socket(7)). Packets that the
//! kernel had to drop because they were not read in time (`SO_RXQ_OVFL`), and packets larger than the entry permits,
//! are counted as lost.
//!
//! Invariant: receiving a packet does not allocate.

use std::ffi::OsString;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::os::fd::{AsFd as _, OwnedFd};
use std::time::Duration;

use nix::sys::socket::sockopt::BindToDevice;
use nix::sys::socket::{SockaddrStorage, setsockopt};
use rapid_core::sample::{Encoding, FLAG_DEVICE_TIME, FLAG_ERROR};
use rapid_core::time::{Stamp, WallClock};
use rapid_registry::own_side;
use rustix::net::{AddressFamily, SocketFlags, SocketType};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::task::coop::consume_budget;
use tokio::time::timeout;

use super::address::{DeviceAddress, port_error};
use crate::driver::datagram::{self, Datagram, StampClock};
use crate::driver::{DriverError, Reading};

/// The interface is checked after this long without a packet.
const ASK_AFTER: Duration = Duration::from_millis(500);

#[derive(Debug)]
pub(super) struct Packets {
    socket: AsyncFd<OwnedFd>,
    place: DeviceAddress,
    packet: Vec<u8>,
    filled: usize,
    /// Number of packets that the kernel has dropped so far.
    dropped: u32,
    lost: u64,
    clock: StampClock,
    /// Time of the newest packet.
    last: Stamp,
}

impl Packets {
    /// Receives packets at `port`; a packet has at most `max_bytes`.
    pub(super) fn open(place: DeviceAddress, port: u16, max_bytes: usize) -> Result<Self, DriverError> {
        let socket = bind(&place, port).map_err(|error| port_error(port, &error))?;
        // SAFETY: the registered value owns the descriptor.
        let socket = unsafe { AsyncFd::register_with_interest(socket, Interest::READABLE) }
            .map_err(|error| DriverError::Retry(format!("port {port}: {}", io::Error::from(error))))?;
        Ok(Self {
            socket,
            place,
            packet: vec![0; max_bytes],
            filled: 0,
            dropped: 0,
            lost: 0,
            clock: StampClock::new(WallClock::now(), Stamp::now()),
            last: Stamp::default(),
        })
    }

    pub(super) async fn read(&mut self) -> Result<Reading<'_>, DriverError> {
        let captured = loop {
            // Foreign or oversized packets may arrive endlessly.
            consume_budget().await;
            // If the future is dropped, every packet stays with the kernel.
            let ready = timeout(ASK_AFTER, self.socket.readable()).await;
            let Ok(ready) = ready else {
                if self.place.is_gone() {
                    return Err(DriverError::Gone);
                }
                continue;
            };
            let mut guard = ready.map_err(|error| self.place.lost(error))?;
            let (received, from) = match datagram::receive(guard.get_inner().as_fd(), &mut self.packet) {
                Ok(received) => received,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    guard.clear_ready();
                    continue;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(self.place.lost(error)),
            };
            drop(guard);
            if let Some(captured) = self.accept(received, from.as_ref().and_then(address)) {
                break captured;
            }
        };
        let (stamp, flags) = captured;
        Ok(Reading {
            bytes: self.packet.get(..self.filled).unwrap_or_default(),
            encoding: Encoding::Bytes,
            captured: stamp,
            flags,
            width: 0,
            height: 0,
            lost: std::mem::take(&mut self.lost),
        })
    }

    /// The packet's time and flags, if it is a sample.
    fn accept(&mut self, received: Datagram, from: Option<IpAddr>) -> Option<(Stamp, u32)> {
        self.lost += received.newly_dropped(&mut self.dropped);
        if !from.is_some_and(|from| self.place.means(from)) {
            return None;
        }
        self.place.received();
        if received.is_cut {
            self.lost += 1;
            return None;
        }
        if received.length == 0 {
            return None;
        }
        self.filled = received.length;
        let (stamp, flags) = stamp(received.stamp_ns, &mut self.clock, WallClock::now(), Stamp::now());
        // The two clocks are read one after the other, with a varying delay.
        self.last = self.last.max(stamp);
        Some((self.last, flags))
    }
}

/// When a packet was received, and its flags: the moment of arrival if the kernel does not say, and damaged if what it says
/// cannot be right.
fn stamp(kernel: Option<u64>, clock: &mut StampClock, wall: WallClock, now: Stamp) -> (Stamp, u32) {
    match kernel.map(|kernel| clock.convert(kernel, wall, now)) {
        Some(Some(at)) => (at, FLAG_DEVICE_TIME),
        Some(None) => (now, FLAG_ERROR),
        None => (now, 0),
    }
}

fn bind(place: &DeviceAddress, port: u16) -> io::Result<OwnedFd> {
    let own = SocketAddr::new(own_side(place.peer()), port);
    let family = if own.is_ipv6() { AddressFamily::INET6 } else { AddressFamily::INET };
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = rustix::net::socket_with(family, SocketType::DGRAM, flags, None)?;
    datagram::prepare(socket.as_fd())?;
    if let Some(interface) = place.interface() {
        setsockopt(&socket, BindToDevice, &OsString::from(interface))?;
    }
    rustix::net::bind(&socket, &own)?;
    Ok(socket)
}

fn address(from: &SockaddrStorage) -> Option<IpAddr> {
    let v4 = from.as_sockaddr_in().map(|from| from.ip().into());
    v4.or_else(|| from.as_sockaddr_in6().map(|from| from.ip().into()))
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use rapid_registry::device::{DeviceNode, LastReceived};

    use super::*;

    /// For UDP and TCP.
    #[tokio::test]
    async fn a_socket_is_bound_to_the_configured_address() {
        let (any, any_v6) = ([0; 4].into(), [0; 16].into());
        for (host, expected) in [
            ("127.0.0.1", None),
            ("127.0.0.9", None),
            ("::1", None),
            // Broadcasts must be received as well.
            ("192.0.2.201", Some(any)),
            ("fd00::7", Some(any_v6)),
        ] {
            let host: IpAddr = host.parse().expect("an address");
            let node = DeviceNode::Lan { address: SocketAddr::new(host, 2368), last_received: LastReceived::default() };
            let place = DeviceAddress::new(&node, None).expect("a place");
            let expected = expected.unwrap_or(host);
            match bind(&place, 0) {
                Ok(socket) => {
                    assert_eq!(UdpSocket::from(socket).local_addr().expect("an address").ip(), expected, "{host}");
                }
                Err(error) => no_ipv6(host, &error),
            }
            match place.listen(0) {
                Ok(listener) => {
                    assert_eq!(listener.local_addr().expect("an address").ip(), expected, "{host}");
                }
                Err(error) => no_ipv6(host, &error),
            }
        }
    }

    /// A machine may lack it; containers often do.
    fn no_ipv6(host: IpAddr, error: &dyn std::fmt::Display) {
        assert!(host.is_ipv6() && UdpSocket::bind("[::1]:0").is_err(), "{host}: {error}");
        crate::skip::skipped(&format!("for {host}: this machine has no IPv6"));
    }

    #[test]
    fn a_packet_is_as_old_as_the_kernel_says() {
        const S: u64 = 1_000_000_000;
        let (now, wall) = (Stamp(5_000 * S), 1_700_000_000 * S);
        let relation = |wall: u64| WallClock::with_offset(i128::from(wall) - i128::from(now.0));
        let here = relation(wall);
        for (kernel, before, expected) in [
            (Some(wall - 1_000), here, (Stamp(now.0 - 1_000), FLAG_DEVICE_TIME)),
            (Some(wall), here, (now, FLAG_DEVICE_TIME)),
            // The clocks are read one after the other.
            (Some(wall + 1), here, (now, FLAG_DEVICE_TIME)),
            // `rapid` was stopped meanwhile.
            (Some(wall - 2 * S), here, (Stamp(now.0 - 2 * S), FLAG_DEVICE_TIME)),
            (Some(wall - 3_600 * S), here, (Stamp(now.0 - 3_600 * S), FLAG_DEVICE_TIME)),
            // The clock was set, back by a minute, while the packet waited.
            (Some(wall + 59 * S), relation(wall + 60 * S), (Stamp(now.0 - S), FLAG_DEVICE_TIME)),
            // The kernel's time is of no clock that was known.
            (Some(wall + 59 * S), relation(wall - 60 * S), (now, FLAG_ERROR)),
            (None, here, (now, 0)),
        ] {
            assert_eq!(
                stamp(kernel, &mut StampClock::new(before, Stamp::default()), here, now),
                expected,
                "{kernel:?}"
            );
        }
    }
}
