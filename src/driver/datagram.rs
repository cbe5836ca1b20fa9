//! Datagrams with the kernel's metadata: when it took them from the network or the bus (`SO_TIMESTAMPNS`, socket(7)),
//! and how many it had to drop because they were not read in time (`SO_RXQ_OVFL`). Used for UDP packets and frames of a
//! CAN bus.
//!
//! Invariant: receiving a datagram neither allocates nor waits.

use std::io;
use std::mem::{size_of, zeroed};
use std::os::fd::{AsRawFd as _, BorrowedFd};

/// Requested size of the receive queue in bytes; the kernel grants at most `net.core.rmem_max`. A CAN frame takes about
/// 1 KiB of it.
pub(super) const QUEUE: libc::c_int = 8 << 20;

/// The kernel's report on one datagram.
#[derive(Debug, Clone, Copy)]
pub(super) struct Datagram {
    /// Bytes that were written.
    pub(super) length: usize,
    /// The datagram was longer than the buffer.
    pub(super) is_cut: bool,
    /// `CLOCK_REALTIME`, ns since 1970.
    pub(super) stamp_ns: Option<u64>,
    /// Datagrams of this socket that were dropped before this one, since it was opened.
    dropped: Option<u32>,
}

impl Datagram {
    /// Datagrams dropped since there were `before`, which is updated.
    pub(super) fn newly_dropped(&self, before: &mut u32) -> u64 {
        let now = self.dropped.unwrap_or(*before);
        u64::from(now.wrapping_sub(std::mem::replace(before, now)))
    }
}

/// Makes the kernel timestamp datagrams for this socket, count dropped ones, and keep a long queue.
pub(super) fn prepare(socket: BorrowedFd<'_>) -> io::Result<()> {
    for (option, value) in [(libc::SO_TIMESTAMPNS, 1), (libc::SO_RXQ_OVFL, 1), (libc::SO_RCVBUF, QUEUE)] {
        set(socket, option, &value.to_ne_bytes())?;
    }
    Ok(())
}

/// Sets an option of `SOL_SOCKET`.
pub(super) fn set(socket: BorrowedFd<'_>, option: libc::c_int, value: &[u8]) -> io::Result<()> {
    let length = libc::socklen_t::try_from(value.len()).map_err(|_| io::ErrorKind::InvalidInput)?;
    // SAFETY: the value is valid during the call, and its length is passed.
    let result =
        unsafe { libc::setsockopt(socket.as_raw_fd(), libc::SOL_SOCKET, option, value.as_ptr().cast(), length) };
    if result == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// Space for a stamp and a counter with their headers, aligned as a header requires.
#[repr(C, align(8))]
struct Control([u8; 128]);

/// Receives the next pending datagram into `into`, and its sender into `from`.
pub(super) fn receive(
    socket: BorrowedFd<'_>,
    into: &mut [u8],
    from: Option<&mut libc::sockaddr_storage>,
) -> io::Result<Datagram> {
    let mut control = Control([0; 128]);
    // SAFETY: it holds only integers and pointers, for which zero is valid.
    let mut message: libc::msghdr = unsafe { zeroed() };
    let mut place = libc::iovec { iov_base: into.as_mut_ptr().cast(), iov_len: into.len() };
    if let Some(from) = from {
        message.msg_name = (&raw mut *from).cast();
        message.msg_namelen = libc::socklen_t::try_from(size_of::<libc::sockaddr_storage>()).unwrap_or(0);
    }
    message.msg_iov = &raw mut place;
    message.msg_iovlen = 1;
    message.msg_control = control.0.as_mut_ptr().cast();
    message.msg_controllen = control.0.len();
    // SAFETY: every pointer of the message is to a local or to memory borrowed for the call, with its length.
    let length = unsafe { libc::recvmsg(socket.as_raw_fd(), &raw mut message, libc::MSG_DONTWAIT) };
    let length = usize::try_from(length).map_err(|_| io::Error::last_os_error())?;
    let is_cut = message.msg_flags & libc::MSG_TRUNC != 0;
    let mut datagram = Datagram { length, is_cut, stamp_ns: None, dropped: None };
    // SAFETY: the kernel wrote complete headers into `control`, `msg_controllen` bytes, and the macros stay within
    // them; payloads are as long as their type, and read unaligned.
    unsafe {
        let mut next = libc::CMSG_FIRSTHDR(&raw const message);
        while let Some(header) = next.as_ref() {
            let data = libc::CMSG_DATA(next);
            match (header.cmsg_level, header.cmsg_type) {
                (libc::SOL_SOCKET, libc::SCM_TIMESTAMPNS) => {
                    datagram.stamp_ns = nanoseconds(&data.cast::<libc::timespec>().read_unaligned());
                }
                (libc::SOL_SOCKET, libc::SO_RXQ_OVFL) => datagram.dropped = Some(data.cast::<u32>().read_unaligned()),
                _ => {}
            }
            next = libc::CMSG_NXTHDR(&raw const message, next);
        }
    }
    Ok(datagram)
}

fn nanoseconds(time: &libc::timespec) -> Option<u64> {
    let seconds = u64::try_from(time.tv_sec).ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(u64::try_from(time.tv_nsec).ok()?)
}
