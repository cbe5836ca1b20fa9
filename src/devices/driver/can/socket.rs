//! CAN adapters that are network interfaces (Linux `SocketCAN`).
//!
//! Sources: linux/can.h, linux/can/error.h, Documentation/networking/can.rst and timestamping.rst of the
//! kernel. Its stamps are of the wall clock and are converted to the monotonic clock when read.

use std::io;
use std::num::NonZeroU32;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::RcvBufForce;
use rapid_core::time::{Stamp, WallClock};
use rapid_motors::control::can::CanFrame;
use rustix::net::{AddressFamily, Protocol, SendFlags, SocketFlags, SocketType};
use socketcan::{CanSocket, Socket as _, SocketOptions as _};

use super::netlink::{self, Ready};
use super::outcome::{Arrival, LinkError, is_overflow};
use crate::driver::datagram::{self, Datagram, StampClock};

/// Bytes of a classical frame (`struct can_frame`, linux/can.h): identifier, length, three that mean nothing, data.
const FRAME: usize = 16;
/// linux/can.h.
const CAN_RAW: Protocol = Protocol::from_raw(NonZeroU32::MIN);
/// A bound socket.
#[derive(Debug)]
pub struct Socket {
    bound: CanSocket,
    name: String,
    index: u32,
    restarts: bool,
    /// The kernel's count of frames lost to a full queue.
    dropped: u32,
    lost: u64,
    clock: StampClock,
    description: String,
}

impl Socket {
    pub(super) fn open(name: &str, bitrate: u32) -> Result<Self, LinkError> {
        let ready = netlink::bring_up(name, bitrate)?;
        let socket = listen(ready.index).map_err(|error| open_error(name, &error))?;
        Ok(Self::new(socket, name, ready, format!("{name} at {bitrate} bit/s")))
    }

    /// Datagrams stand in for frames: the kernel delivers both, their stamps and the count of losses in the same way.
    pub(super) fn stand_in(socket: OwnedFd) -> Result<Self, LinkError> {
        let socket = CanSocket::from(socket);
        set_up(&socket).map_err(|error| LinkError::Retry(format!("the stand-in for a bus: {error}")))?;
        Ok(Self::new(socket, "stand-in", Ready { index: 0, restarts: false }, "stand-in".to_owned()))
    }

    fn new(socket: CanSocket, name: &str, ready: Ready, description: String) -> Self {
        let Ready { index, restarts } = ready;
        Self {
            bound: socket,
            name: name.to_owned(),
            index,
            restarts,
            dropped: 0,
            lost: 0,
            clock: StampClock::new(WallClock::now(), Stamp::now()),
            description,
        }
    }

    pub(super) fn send(&mut self, frame: &CanFrame) -> Result<(), LinkError> {
        if frame.error {
            return Ok(());
        }
        match rustix::net::send(&self.bound, &to_bytes(frame), SendFlags::DONTWAIT) {
            Ok(_) => Ok(()),
            Err(error) => self.result_of(&error.into(), "sending to").map_or(Err(LinkError::Full), Err),
        }
    }

    pub(super) fn try_recv(&mut self, frame: &mut CanFrame) -> Result<Option<Arrival>, LinkError> {
        let (received, datagram) = loop {
            match receive(&self.bound) {
                Ok(Some(received)) => break received,
                // Not a classical frame.
                Ok(None) => {}
                Err(error) => return self.result_of(&error, "reading from").map_or(Ok(None), Err),
            }
        };
        *frame = received;
        self.lost += datagram.newly_dropped(&mut self.dropped) + u64::from(is_overflow(frame));
        Ok(Some(arrival(datagram.stamp_ns, &mut self.clock)))
    }

    /// Why the link has ended; `None` if it has not: try again.
    fn result_of(&self, error: &io::Error, what: &str) -> Option<LinkError> {
        match error.raw_os_error() {
            Some(libc::EAGAIN | libc::EINTR | libc::ENOBUFS) => None,
            Some(libc::ENODEV | libc::ENXIO) => Some(LinkError::Gone),
            // The interface went down: with its adapter, or by an operator's command.
            Some(libc::ENETDOWN) if netlink::is_gone(&self.name, self.index) => Some(LinkError::Gone),
            Some(libc::ENETDOWN) => {
                netlink::was_set_down(self.index);
                Some(LinkError::Retry(format!("{} was set down", self.name)))
            }
            _ => Some(LinkError::Retry(format!("{what} {}: {error}", self.name))),
        }
    }

    pub(super) fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }

    pub(super) const fn restarts(&self) -> bool {
        self.restarts
    }

    pub(super) fn description(&self) -> &str {
        &self.description
    }
}

impl AsFd for Socket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.bound.as_fd()
    }
}

/// Passes a frame to a shared socket; returns how many bytes it took.
pub(super) fn put(socket: BorrowedFd<'_>, frame: &CanFrame) -> rustix::io::Result<usize> {
    rustix::io::write(socket, &to_bytes(frame))
}

/// Opens a socket and closes it: the first one of a kind makes the kernel load its modules.
pub(super) fn load() {
    let _ = rustix::net::socket_with(AddressFamily::CAN, SocketType::RAW, SocketFlags::CLOEXEC, Some(CAN_RAW));
}

fn listen(index: u32) -> io::Result<CanSocket> {
    let socket = CanSocket::open_iface(index)?;
    socket.set_error_filter_accept_all()?;
    set_up(&socket)?;
    Ok(socket)
}

fn set_up(socket: &CanSocket) -> io::Result<()> {
    socket.set_nonblocking(true)?;
    datagram::prepare(socket.as_fd())?;
    // Past the limit of the machine, which root alone may do.
    let _ = setsockopt(socket, RcvBufForce, &datagram::QUEUE);
    Ok(())
}

fn open_error(name: &str, error: &io::Error) -> LinkError {
    match error.raw_os_error() {
        Some(libc::ENODEV | libc::ENXIO) => LinkError::Gone,
        Some(libc::EAFNOSUPPORT) => LinkError::Fatal(
            "this kernel has no CAN sockets: load them (`sudo modprobe can_raw`) or use a kernel that has them"
                .to_owned(),
        ),
        _ => LinkError::Retry(format!("opening {name}: {error}")),
    }
}

/// The next pending frame; `None` if it is not a classical frame.
fn receive(socket: &CanSocket) -> io::Result<Option<(CanFrame, Datagram)>> {
    let mut bytes = [0; FRAME];
    let (datagram, _) = datagram::receive::<()>(socket.as_fd(), &mut bytes)?;
    Ok((datagram.length == FRAME && !datagram.is_cut).then(|| (from_bytes(bytes), datagram)))
}

/// When a frame arrived, by the kernel's stamp if it can be converted.
fn arrival(wall_ns: Option<u64>, clock: &mut StampClock) -> Arrival {
    let now = Stamp::now();
    match wall_ns.and_then(|wall_ns| clock.convert(wall_ns, WallClock::now(), now)) {
        Some(at) => Arrival { at, from_kernel: true },
        None => Arrival { at: now, from_kernel: false },
    }
}

fn to_bytes(frame: &CanFrame) -> [u8; FRAME] {
    let mut bytes = [0; FRAME];
    bytes[..4].copy_from_slice(&can_id(frame).to_ne_bytes());
    bytes[4] = frame.len.min(8);
    bytes[8..].copy_from_slice(&frame.data);
    bytes
}

/// The identifier with the flags of linux/can.h.
pub(super) fn can_id(frame: &CanFrame) -> u32 {
    let flag = |is, flag| if is { flag } else { 0 };
    let mask = if frame.extended || frame.error { libc::CAN_EFF_MASK } else { libc::CAN_SFF_MASK };
    frame.id & mask
        | flag(frame.extended, libc::CAN_EFF_FLAG)
        | flag(frame.remote, libc::CAN_RTR_FLAG)
        | flag(frame.error, libc::CAN_ERR_FLAG)
}

fn from_bytes([a, b, c, d, len, _, _, _, data @ ..]: [u8; FRAME]) -> CanFrame {
    let id = u32::from_ne_bytes([a, b, c, d]);
    let is = |flag| id & flag != 0;
    let (extended, error) = (is(libc::CAN_EFF_FLAG), is(libc::CAN_ERR_FLAG));
    let mask = if extended || error { libc::CAN_EFF_MASK } else { libc::CAN_SFF_MASK };
    CanFrame { id: id & mask, extended, remote: is(libc::CAN_RTR_FLAG), error, len: len.min(8), data }
}

#[cfg(test)]
pub(super) mod tests;
