//! Datagrams with the kernel's metadata: when it took them from the network or the bus (`SO_TIMESTAMPNS`, socket(7)),
//! and how many it had to drop because they were not read in time (`SO_RXQ_OVFL`). Used for UDP packets and frames of a
//! CAN bus.
//!
//! The kernel's stamps are of the wall clock; [`StampClock`] converts them. However long a datagram waited, it is as old as it
//! is: a process that was stopped does not take what it missed for the present.
//!
//! Invariant: receiving a datagram neither allocates nor waits.

use std::io::{self, IoSliceMut};
use std::os::fd::{AsRawFd as _, BorrowedFd};

use nix::sys::socket::sockopt::{RcvBuf, ReceiveTimestampns, RxqOvfl};
use nix::sys::socket::{ControlMessageOwned, MsgFlags, SockaddrLike, recvmsg, setsockopt};
use nix::sys::time::TimeSpec;
use rapid_core::time::{STEP, Stamp, WallClock};

/// Requested size of the receive queue in bytes; the kernel grants at most `net.core.rmem_max`. A CAN frame takes about
/// 1 KiB of it.
pub(super) const QUEUE: usize = 8 << 20;

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
    setsockopt(&socket, ReceiveTimestampns, &true)?;
    setsockopt(&socket, RxqOvfl, &1)?;
    setsockopt(&socket, RcvBuf, &QUEUE)?;
    Ok(())
}

/// Converts the kernel's stamps to our clock, also when the wall clock is set while datagrams wait.
#[derive(Debug)]
pub(super) struct StampClock {
    /// The relation of the clocks, by which the newest stamp was converted.
    wall: WallClock,
    last: Stamp,
}

impl StampClock {
    /// For datagrams received from the moment `since` on, at which the clocks' relation was `wall`.
    pub(super) const fn new(wall: WallClock, since: Stamp) -> Self {
        Self { wall, last: since }
    }

    /// When a datagram that is read `now`, at which the clocks' relation is `wall`, was received; `None` if its stamp cannot be
    /// converted, because the wall clock was set more than once.
    pub(super) fn convert(&mut self, stamp_ns: u64, wall: WallClock, now: Stamp) -> Option<Stamp> {
        let (at, before) = (wall.stamp(stamp_ns), self.wall.stamp(stamp_ns));
        let is_possible = |at: Stamp| at.after(STEP) >= self.last && at <= now.after(STEP);
        let was_set = at.since(before).max(before.since(at)) >= STEP;
        let converted = if !was_set || is_possible(at) {
            Some(at)
        } else if is_possible(before) {
            // It waited while the clock was set, as the next one may have.
            self.last = before.min(now);
            return Some(self.last);
        } else {
            None
        };
        self.wall = wall;
        self.last = converted.unwrap_or(now).min(now);
        converted.map(|_| self.last)
    }
}

/// Space for a stamp and a counter with their headers, aligned as a header requires.
#[repr(C, align(8))]
struct Control([u8; 128]);

/// Receives the next pending datagram into `into`, and its sender, where the kind of the socket has addresses.
pub(super) fn receive<S: SockaddrLike>(socket: BorrowedFd<'_>, into: &mut [u8]) -> io::Result<(Datagram, Option<S>)> {
    let mut control = Control([0; 128]);
    let mut place = [IoSliceMut::new(into)];
    let message = recvmsg::<S>(socket.as_raw_fd(), &mut place, Some(&mut control.0), MsgFlags::MSG_DONTWAIT)?;
    let is_cut = message.flags.contains(MsgFlags::MSG_TRUNC);
    let mut datagram = Datagram { length: message.bytes, is_cut, stamp_ns: None, dropped: None };
    for part in message.cmsgs()? {
        match part {
            ControlMessageOwned::ScmTimestampns(time) => datagram.stamp_ns = nanoseconds(time),
            ControlMessageOwned::RxqOvfl(dropped) => datagram.dropped = Some(dropped),
            _ => {}
        }
    }
    Ok((datagram, message.address))
}

fn nanoseconds(time: TimeSpec) -> Option<u64> {
    let seconds = u64::try_from(time.tv_sec()).ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(u64::try_from(time.tv_nsec()).ok()?)
}

#[cfg(test)]
mod tests;
