//! CAN adapters that are network interfaces (Linux `SocketCAN`).
//!
//! Sources: linux/can.h, linux/can/error.h, Documentation/networking/can.rst and timestamping.rst of the
//! kernel. Its stamps are on the wall clock and are put on the monotonic one as they are read.

use std::io;
use std::mem::{size_of, zeroed};
use std::os::fd::{AsFd, AsRawFd as _, BorrowedFd, FromRawFd as _, OwnedFd};
use std::time::Duration;

use socketcan::{CanSocket, Socket as _, SocketOptions as _};

use super::link::{Arrival, LinkError, is_overflow};
use super::netlink::{self, Ready};
use crate::control::can::CanFrame;
use crate::time::{Stamp, WallClock};

/// Bytes of the receive queue that are asked for; the kernel grants `net.core.rmem_max` of them at most
/// to who is not root. A frame takes about 1 KiB there.
const QUEUE: usize = 8 << 20;
/// A frame that waited longer than this did not: the wall clock was set.
const OLDEST: Duration = Duration::from_secs(10);

/// A bound socket.
#[derive(Debug)]
pub struct Socket {
    bound: CanSocket,
    name: String,
    index: u32,
    restarts: bool,
    /// The kernel's count of frames that found the queue full.
    dropped: u32,
    lost: u64,
    description: String,
}

impl Socket {
    pub(super) fn open(name: &str, bitrate: u32) -> Result<Self, LinkError> {
        let ready = netlink::bring_up(name, bitrate)?;
        let socket = listen(ready.index).map_err(|error| open_error(name, &error))?;
        Ok(Self::of(socket, name, ready, format!("{name} at {bitrate} bit/s")))
    }

    /// Datagrams stand in for frames: the kernel hands over both, their stamps and the count of what found the
    /// queue full in the same way.
    pub(super) fn stand_in(socket: OwnedFd) -> Result<Self, LinkError> {
        let socket = CanSocket::from(socket);
        set_up(&socket).map_err(|error| LinkError::Retry(format!("the stand-in for a bus: {error}")))?;
        Ok(Self::of(socket, "stand-in", Ready { index: 0, restarts: false }, "stand-in".to_owned()))
    }

    fn of(socket: CanSocket, name: &str, ready: Ready, description: String) -> Self {
        let Ready { index, restarts } = ready;
        Self { bound: socket, name: name.to_owned(), index, restarts, dropped: 0, lost: 0, description }
    }

    pub(super) fn send(&mut self, frame: &CanFrame) -> Result<(), LinkError> {
        if frame.error {
            return Ok(());
        }
        let raw = to_raw(frame);
        // SAFETY: `raw` is a whole can_frame that outlives the call.
        let written = unsafe {
            libc::send(
                self.bound.as_raw_fd(),
                (&raw const raw).cast(),
                size_of::<libc::can_frame>(),
                libc::MSG_DONTWAIT,
            )
        };
        if written >= 0 {
            return Ok(());
        }
        self.result_of(&io::Error::last_os_error(), "sending to").map_or(Err(LinkError::Full), Err)
    }

    pub(super) fn try_recv(&mut self, frame: &mut CanFrame) -> Result<Option<Arrival>, LinkError> {
        let message = loop {
            match receive(&self.bound) {
                Ok(Some(message)) => break message,
                // Something else than a classical frame.
                Ok(None) => {}
                Err(error) => return self.result_of(&error, "reading from").map_or(Ok(None), Err),
            }
        };
        if let Some(dropped) = message.dropped {
            self.lost += u64::from(dropped.wrapping_sub(self.dropped));
            self.dropped = dropped;
        }
        *frame = from_raw(&message.frame);
        self.lost += u64::from(is_overflow(frame));
        Ok(Some(arrival(message.stamp_ns)))
    }

    /// Why the link has ended; `None` if it has not, and trying again is all there is to do.
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

/// Hands a frame to a socket that is not ours alone; how many bytes it took.
pub(super) fn put(socket: BorrowedFd<'_>, frame: &CanFrame) -> rustix::io::Result<usize> {
    let raw = to_raw(frame);
    // SAFETY: `raw` is a whole can_frame of integers, without gaps, that outlives the slice.
    let bytes = unsafe { std::slice::from_raw_parts((&raw const raw).cast::<u8>(), size_of::<libc::can_frame>()) };
    rustix::io::write(socket, bytes)
}

/// Opens a socket and closes it: the first one of a kind makes the kernel load its modules.
pub(super) fn load() {
    // SAFETY: plain numbers.
    let socket = unsafe { libc::socket(libc::PF_CAN, libc::SOCK_RAW | libc::SOCK_CLOEXEC, libc::CAN_RAW) };
    if socket >= 0 {
        // SAFETY: it was just opened and has no other owner.
        drop(unsafe { OwnedFd::from_raw_fd(socket) });
    }
}

fn listen(index: u32) -> io::Result<CanSocket> {
    let socket = CanSocket::open_iface(index)?;
    socket.set_error_filter_accept_all()?;
    set_up(&socket)?;
    Ok(socket)
}

fn set_up(socket: &CanSocket) -> io::Result<()> {
    socket.set_nonblocking(true)?;
    socket.set_recv_timestamp(true)?;
    socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RXQ_OVFL, 1)?;
    let queue = libc::c_int::try_from(QUEUE).unwrap_or(libc::c_int::MAX);
    // The first only as root; the second takes what is granted.
    if socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RCVBUFFORCE, queue).is_err() {
        socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RCVBUF, queue)?;
    }
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

/// What one call received.
struct Message {
    frame: libc::can_frame,
    /// `CLOCK_REALTIME`.
    stamp_ns: Option<u64>,
    dropped: Option<u32>,
}

/// Room for a stamp and a counter with their headers; aligned as a header wants it.
#[repr(C, align(8))]
struct Extras([u8; 128]);

/// The next frame that waits; `None` if it is no classical frame.
fn receive(socket: &CanSocket) -> io::Result<Option<Message>> {
    // SAFETY: integers alone, for which zero is a value.
    let (mut frame, mut header): (libc::can_frame, libc::msghdr) = unsafe { (zeroed(), zeroed()) };
    let mut extras = Extras([0; 128]);
    let mut place = libc::iovec { iov_base: (&raw mut frame).cast(), iov_len: size_of::<libc::can_frame>() };
    header.msg_iov = &raw mut place;
    header.msg_iovlen = 1;
    header.msg_control = extras.0.as_mut_ptr().cast();
    header.msg_controllen = extras.0.len();
    // SAFETY: the header points to `place`, which points to all of `frame`, and to all of `extras`.
    let count = unsafe { libc::recvmsg(socket.as_raw_fd(), &raw mut header, libc::MSG_DONTWAIT | libc::MSG_TRUNC) };
    let count = usize::try_from(count).map_err(|_| io::Error::last_os_error())?;
    if count != size_of::<libc::can_frame>() {
        return Ok(None);
    }
    let mut message = Message { frame, stamp_ns: None, dropped: None };
    // SAFETY: the kernel wrote whole headers into `extras`, as many as `msg_controllen` says by now, and
    // the macros stay within them; payloads are as long as their type, and read unaligned.
    unsafe {
        let mut next = libc::CMSG_FIRSTHDR(&raw const header);
        while let Some(extra) = next.as_ref() {
            let data = libc::CMSG_DATA(next);
            match (extra.cmsg_level, extra.cmsg_type) {
                (libc::SOL_SOCKET, libc::SCM_TIMESTAMPNS) => {
                    let stamp = data.cast::<libc::timespec>().read_unaligned();
                    message.stamp_ns = nanoseconds(&stamp);
                }
                (libc::SOL_SOCKET, libc::SO_RXQ_OVFL) => message.dropped = Some(data.cast::<u32>().read_unaligned()),
                _ => {}
            }
            next = libc::CMSG_NXTHDR(&raw const header, next);
        }
    }
    Ok(Some(message))
}

fn nanoseconds(time: &libc::timespec) -> Option<u64> {
    let seconds = u64::try_from(time.tv_sec).ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(u64::try_from(time.tv_nsec).ok()?)
}

/// Puts a stamp of the wall clock on the monotonic one.
fn arrival(wall_ns: Option<u64>) -> Arrival {
    let now = Stamp::now();
    let stamp = wall_ns.map(|wall_ns| WallClock::now().stamp(wall_ns).min(now));
    match stamp.filter(|stamp| now.since(*stamp) < OLDEST) {
        Some(at) => Arrival { at, from_kernel: true },
        None => Arrival { at: now, from_kernel: false },
    }
}

fn to_raw(frame: &CanFrame) -> libc::can_frame {
    // SAFETY: integers alone, for which zero is a value.
    let mut raw: libc::can_frame = unsafe { zeroed() };
    raw.can_id = can_id(frame);
    raw.can_dlc = frame.len.min(8);
    raw.data = frame.data;
    raw
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

fn from_raw(raw: &libc::can_frame) -> CanFrame {
    let is = |flag| raw.can_id & flag != 0;
    let (extended, error) = (is(libc::CAN_EFF_FLAG), is(libc::CAN_ERR_FLAG));
    let mask = if extended || error { libc::CAN_EFF_MASK } else { libc::CAN_SFF_MASK };
    CanFrame {
        id: raw.can_id & mask,
        extended,
        remote: is(libc::CAN_RTR_FLAG),
        error,
        len: raw.can_dlc.min(8),
        data: raw.data,
    }
}

#[cfg(test)]
pub(super) mod tests;
