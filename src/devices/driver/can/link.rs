//! An open CAN adapter of any kind.
//!
//! Only opening and [`Link::recv_until`] wait, the latter until its deadline. Frames that the controller or the kernel
//! lost are counted, and so are those that the adapter refused to send.
//!
//! Invariant: nothing is allocated for a frame.
//! Invariant: no bytes from an adapter cause a panic.

use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::path::Path;
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rapid_registry::device::DeviceNode;
use rapid_registry::{CanAdapter, CanSpec};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::line::{ANSWER, Line};
use super::outcome::{Arrival, LinkError, Received, is_bus_off};
use super::socket::Socket;

/// What else can wake a thread that waits for the bus: orders from two places, and actions.
pub const BELLS: usize = 3;

/// An interface that goes down reports an error without anything to read.
const INTEREST: Interest = Interest::READABLE.add(Interest::ERROR);

/// An open adapter.
#[derive(Debug)]
pub enum Link {
    /// A network interface.
    Socket(Socket),
    /// A serial line with slcan.
    Slcan(Line),
    /// A serial line with the protocol of Damiao's adapter.
    Damiao(Line),
}

impl Link {
    /// Opens the adapter of an entry at its node. May block: keep it off the runtime.
    ///
    /// # Errors
    /// When the node is gone, is not an adapter of this kind, or cannot be opened.
    pub fn open(spec: &CanSpec, node: &DeviceNode) -> Result<Self, LinkError> {
        match (spec.adapter, node) {
            (CanAdapter::SocketCan, DeviceNode::Net(name)) => Self::open_socket(name, spec.bitrate),
            (CanAdapter::Slcan, DeviceNode::Tty(path)) => Self::open_slcan(path, spec.bitrate),
            (CanAdapter::Damiao, DeviceNode::Tty(path)) => Self::open_damiao(path),
            (adapter, node) => {
                let text = format!("{} is no CAN adapter of kind \"{adapter}\": correct `adapter`", node.label());
                Err(LinkError::Fatal(text))
            }
        }
    }

    /// Opens the network interface `name` and brings it up with `bitrate`. May block: keep it off the
    /// runtime.
    ///
    /// # Errors
    /// When the interface is gone, is not a CAN bus, or is down and may not be brought up.
    pub fn open_socket(name: &str, bitrate: u32) -> Result<Self, LinkError> {
        Socket::open(name, bitrate).map(Self::Socket)
    }

    /// A socket of datagrams in the place of a network interface's.
    pub(super) fn stand_in(socket: OwnedFd) -> Result<Self, LinkError> {
        Socket::stand_in(socket).map(Self::Socket)
    }

    /// Opens the serial line at `path`, and the bus behind it with `bitrate`. Waits for the adapter's
    /// answers, a few hundred ms at most: keep it off the runtime.
    ///
    /// # Errors
    /// When the line is gone, held by another program or not permitted, or the adapter refuses.
    pub fn open_slcan(path: &Path, bitrate: u32) -> Result<Self, LinkError> {
        Line::slcan(path, bitrate, ANSWER).map(Self::Slcan)
    }

    /// Opens the serial line at `path` to an adapter of Damiao's. May block: keep it off the runtime.
    ///
    /// # Errors
    /// When the line is gone, held by another program or not permitted.
    pub fn open_damiao(path: &Path) -> Result<Self, LinkError> {
        Line::damiao(path).map(Self::Damiao)
    }

    /// Another descriptor of the adapter.
    ///
    /// # Errors
    /// When the system gives none.
    pub(super) fn duplicate(&self) -> io::Result<OwnedFd> {
        self.as_fd().try_clone_to_owned()
    }

    /// Hands a frame to the kernel. Does not wait, and does not confirm that the frame was on the bus.
    ///
    /// # Errors
    /// [`LinkError::Full`] when the frame was not taken and may be tried again; the others end the link.
    pub fn send(&mut self, frame: &CanFrame) -> Result<(), LinkError> {
        match self {
            Self::Socket(socket) => socket.send(frame),
            Self::Slcan(line) | Self::Damiao(line) => line.send(frame),
        }
    }

    /// The next pending frame, error frames of the controller included; `None` if there is none.
    ///
    /// # Errors
    /// When the link has ended.
    pub fn try_recv(&mut self, frame: &mut CanFrame) -> Result<Option<Arrival>, LinkError> {
        match self {
            Self::Socket(socket) => socket.try_recv(frame),
            Self::Slcan(line) | Self::Damiao(line) => line.try_recv(frame),
        }
    }

    /// The next frame of the bus and its arrival; `None` if there is none until `deadline`. A pending frame is returned
    /// even if the deadline has passed.
    ///
    /// # Errors
    /// [`LinkError::BusOff`] when the controller reports it, after which the link may still be used; the
    /// others end the link.
    pub fn recv_until(&mut self, deadline: Stamp, frame: &mut CanFrame) -> Result<Option<Arrival>, LinkError> {
        self.recv_unless_rung(deadline, frame, [const { None }; BELLS])
    }

    /// As [`Self::recv_until`], or until one of `bells` can be read.
    ///
    /// # Errors
    /// As [`Self::recv_until`].
    pub fn recv_unless_rung(
        &mut self,
        deadline: Stamp,
        frame: &mut CanFrame,
        bells: [Option<BorrowedFd<'_>>; BELLS],
    ) -> Result<Option<Arrival>, LinkError> {
        let mut hung_up = false;
        let mut is_rung = false;
        loop {
            while let Some(arrival) = self.try_recv(frame)? {
                if !frame.error {
                    return Ok(Some(arrival));
                }
                if is_bus_off(frame) {
                    return Err(LinkError::BusOff);
                }
            }
            if hung_up {
                return Err(LinkError::Gone);
            }
            let left = deadline.since(Stamp::now());
            if is_rung || left.is_zero() {
                return Ok(None);
            }
            (hung_up, is_rung) = self.wait(left, bells)?;
        }
    }

    /// Waits for bytes from the adapter, for room to it where some wait, or for a bell. Returns whether the adapter hung
    /// up, and whether a bell rang.
    fn wait(&mut self, longest: Duration, bells: [Option<BorrowedFd<'_>>; BELLS]) -> Result<(bool, bool), LinkError> {
        let mut interest = PollFlags::IN;
        let unsent = matches!(self, Self::Slcan(line) | Self::Damiao(line) if line.has_unsent());
        interest.set(PollFlags::OUT, unsent);
        let timeout = Timespec {
            tv_sec: longest.as_secs().try_into().unwrap_or(i64::MAX),
            tv_nsec: longest.subsec_nanos().into(),
        };
        let adapter = self.as_fd();
        // An absent bell is replaced by the link itself, polled for no event.
        let [first, second, third] = bells.map(|bell| match bell {
            Some(bell) => PollFd::from_borrowed_fd(bell, PollFlags::IN),
            None => PollFd::from_borrowed_fd(adapter, PollFlags::empty()),
        });
        let mut polled = [PollFd::from_borrowed_fd(adapter, interest), first, second, third];
        let (found, is_rung) = match poll(&mut polled, Some(&timeout)) {
            Ok(_) => {
                let [first, rest @ ..] = &polled;
                (first.revents(), rest.iter().any(|bell| bell.revents().contains(PollFlags::IN)))
            }
            Err(rustix::io::Errno::INTR) => (PollFlags::empty(), false),
            Err(error) => return Err(LinkError::Retry(format!("waiting for the bus: {error}"))),
        };
        if unsent && found.contains(PollFlags::OUT) {
            match self {
                Self::Slcan(line) | Self::Damiao(line) => line.flush()?,
                Self::Socket(_) => {}
            }
        }
        // POLLERR on a socket means that the next read returns the cause; a hang-up has no more to read.
        Ok((found.intersects(PollFlags::HUP | PollFlags::NVAL), is_rung))
    }

    /// Frames that were lost before they could be received, since the last call: by the controller, by
    /// the kernel, or on the line.
    pub fn take_lost(&mut self) -> u64 {
        match self {
            Self::Socket(socket) => socket.take_lost(),
            Self::Slcan(line) | Self::Damiao(line) => line.take_lost(),
        }
    }

    /// Frames that the adapter accepted and reported as not sent, since the last call.
    pub fn take_refused(&mut self) -> u64 {
        match self {
            Self::Socket(_) => 0,
            Self::Slcan(line) | Self::Damiao(line) => line.take_refused(),
        }
    }

    /// After a bus-off it returns to the bus by itself.
    pub const fn restarts(&self) -> bool {
        match self {
            Self::Socket(socket) => socket.restarts(),
            // These adapters do not document what they do then.
            Self::Slcan(_) | Self::Damiao(_) => true,
        }
    }

    /// What was opened, for people.
    pub fn description(&self) -> &str {
        match self {
            Self::Socket(socket) => socket.description(),
            Self::Slcan(line) | Self::Damiao(line) => line.description(),
        }
    }
}

impl AsFd for Link {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Self::Socket(socket) => socket.as_fd(),
            Self::Slcan(line) | Self::Damiao(line) => line.as_fd(),
        }
    }
}

impl AsRawFd for Link {
    fn as_raw_fd(&self) -> RawFd {
        self.as_fd().as_raw_fd()
    }
}

/// A link for a task.
#[derive(Debug)]
pub struct AsyncLink {
    link: AsyncFd<Link>,
    /// What ended the link after frames that were still given.
    ended: Option<LinkError>,
}

impl AsyncLink {
    /// Gives `link` to the runtime of the caller.
    ///
    /// # Errors
    /// When the runtime cannot watch it.
    pub fn new(link: Link) -> Result<Self, LinkError> {
        // SAFETY: a link has one descriptor all its life, and drops it last.
        let link = unsafe { AsyncFd::register_with_interest(link, INTEREST) };
        let link = link.map_err(|error| LinkError::Retry(format!("watching the adapter: {error}")))?;
        Ok(Self { link, ended: None })
    }

    /// The pending frames in order, error frames of the controller included: at least one, at most as many as `into`
    /// has room for. Waits until there is one. Cancel-safe.
    ///
    /// # Errors
    /// When the link has ended.
    pub async fn recv(&mut self, into: &mut [Received]) -> Result<usize, LinkError> {
        if into.is_empty() {
            return Ok(0);
        }
        loop {
            // Frames already in the inbox do not make the descriptor readable.
            let count = self.take_waiting(into)?;
            if count > 0 {
                return Ok(count);
            }
            let mut guard = self
                .link
                .ready_mut(INTEREST)
                .await
                .map_err(|error| LinkError::Retry(format!("waiting for the bus: {error}")))?;
            let hung_up = guard.ready().is_read_closed();
            let mut first = Received::default();
            let tried = guard.try_io(|link| match link.get_mut().try_recv(&mut first.frame) {
                Ok(Some(arrival)) => Ok(Ok(arrival)),
                Ok(None) if hung_up => Ok(Err(LinkError::Gone)),
                Ok(None) => Err(io::ErrorKind::WouldBlock.into()),
                Err(error) => Ok(Err(error)),
            });
            if let Ok(Ok(arrival)) = tried {
                first.arrival = arrival?;
                let [place, rest @ ..] = into else { return Ok(0) };
                *place = first;
                // The first frame is delivered, whatever follows.
                let others = self.take_waiting(rest).unwrap_or_else(|error| {
                    self.ended = Some(error);
                    0
                });
                return Ok(1 + others);
            }
        }
    }

    fn take_waiting(&mut self, into: &mut [Received]) -> Result<usize, LinkError> {
        if let Some(error) = self.ended.take() {
            return Err(error);
        }
        let link = self.link.get_mut();
        for (count, place) in into.iter_mut().enumerate() {
            match link.try_recv(&mut place.frame) {
                Ok(Some(arrival)) => place.arrival = arrival,
                Ok(None) => return Ok(count),
                Err(error) if count == 0 => return Err(error),
                Err(error) => {
                    self.ended = Some(error);
                    return Ok(count);
                }
            }
        }
        Ok(into.len())
    }

    /// The link itself.
    pub fn get_mut(&mut self) -> &mut Link {
        self.link.get_mut()
    }
}

#[cfg(test)]
pub(super) mod tests;
