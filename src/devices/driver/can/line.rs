//! CAN adapters on serial lines.
//!
//! A frame is written whole or not at all: after a partial write the rest goes first, and the next frame is refused
//! until it is written.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use rapid_core::time::Stamp;
use rapid_motors::control::can::CanFrame;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;

use super::outcome::{Arrival, LinkError};
use super::{damiao_serial, slcan};
use crate::driver::{arrival, serial};

/// Bytes taken from the kernel at once.
const INBOX: usize = 4096;
/// Ignored by adapters that are USB devices themselves; the usual rate of those behind a UART.
const SLCAN_BAUD: u32 = 115_200;
/// An adapter that answers does so within a few ms; some never do.
pub(super) const ANSWER: Duration = Duration::from_millis(100);

/// An adapter on a serial line.
#[derive(Debug)]
pub struct Line {
    fd: OwnedFd,
    codec: Codec,
    inbox: Box<[u8; INBOX]>,
    /// `inbox[taken..filled]` is still to be decoded.
    taken: usize,
    filled: usize,
    /// When the bytes in `inbox` arrived.
    arrived: Stamp,
    /// Arrival of the last frame.
    stamped: Stamp,
    /// `unsent[..left]` is the rest of the last frame.
    unsent: [u8; LONGEST],
    left: usize,
    lost: u64,
    refused: u64,
    description: String,
}

#[derive(Debug)]
enum Codec {
    Slcan(slcan::Decoder),
    Damiao(damiao_serial::Decoder),
}

/// Bytes of the longest frame.
const LONGEST: usize = if slcan::LONGEST > damiao_serial::SENT { slcan::LONGEST } else { damiao_serial::SENT };

enum Decoded {
    Frame(CanFrame),
    Answer { refused: bool },
    Nothing,
}

impl Line {
    /// Waits for each answer of the adapter for `longest`.
    pub(super) fn slcan(path: &Path, bitrate: u32, longest: Duration) -> Result<Self, LinkError> {
        let Some(set) = slcan::Command::bitrate(bitrate) else {
            return Err(LinkError::Fatal(format!(
                "slcan has no name for {bitrate} bits a second: choose another bitrate"
            )));
        };
        let description = format!("{} (slcan) at {bitrate} bit/s", path.display());
        let fd = serial::open_raw(path, SLCAN_BAUD).map_err(LinkError::of_driver)?;
        let mut line = Self::new(fd, Codec::Slcan(slcan::Decoder::default()), description);
        // An open adapter accepts no bit rate; a closed one refuses to close.
        line.order(slcan::Command::Close, longest)?;
        for (command, what) in [(set, "the bit rate"), (slcan::Command::Open, "to open the bus")] {
            if line.order(command, longest)? {
                return Err(LinkError::Retry(format!("{}: the adapter refused {what}", path.display())));
            }
        }
        (line.lost, line.refused) = (0, 0);
        Ok(line)
    }

    pub(super) fn damiao(path: &Path) -> Result<Self, LinkError> {
        let description = format!("{} (Damiao USB2CAN)", path.display());
        let fd = serial::open_raw(path, damiao_serial::BAUD).map_err(LinkError::of_driver)?;
        Ok(Self::new(fd, Codec::Damiao(damiao_serial::Decoder::default()), description))
    }

    /// Any descriptor in the place of a line to an adapter of Damiao's.
    #[cfg(test)]
    pub(super) fn stand_in(fd: OwnedFd) -> Self {
        Self::new(fd, Codec::Damiao(damiao_serial::Decoder::default()), String::new())
    }

    fn new(fd: OwnedFd, codec: Codec, description: String) -> Self {
        Self {
            fd,
            codec,
            inbox: Box::new([0; INBOX]),
            taken: 0,
            filled: 0,
            arrived: Stamp::default(),
            stamped: Stamp::default(),
            unsent: [0; LONGEST],
            left: 0,
            lost: 0,
            refused: 0,
            description,
        }
    }

    /// Sends a command of slcan and waits for the answer; returns whether it was refused. Silence is not a refusal.
    fn order(&mut self, command: slcan::Command, longest: Duration) -> Result<bool, LinkError> {
        let deadline = Stamp::now().after(longest);
        self.put(command.encode().bytes())?;
        loop {
            while self.taken < self.filled {
                if let Decoded::Answer { refused } = self.decode() {
                    return Ok(refused);
                }
            }
            if !self.fill()? {
                let left = deadline.since(Stamp::now());
                if left.is_zero() {
                    return Ok(false);
                }
                let timeout = Timespec {
                    tv_sec: left.as_secs().try_into().unwrap_or(i64::MAX),
                    tv_nsec: left.subsec_nanos().into(),
                };
                // Errors also show in the read and the deadline.
                let _ = poll(&mut [PollFd::new(&self.fd, PollFlags::IN)], Some(&timeout));
            }
        }
    }

    pub(super) fn send(&mut self, frame: &CanFrame) -> Result<(), LinkError> {
        match self.codec {
            Codec::Slcan(_) => self.put(slcan::encode(frame).bytes()),
            Codec::Damiao(_) => match damiao_serial::encode(frame) {
                Some(bytes) => self.put(&bytes),
                None => Ok(()),
            },
        }
    }

    fn put(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.flush()?;
        if self.left > 0 {
            return Err(LinkError::Full);
        }
        let written = self.write(bytes)?;
        if written == 0 && !bytes.is_empty() {
            return Err(LinkError::Full);
        }
        let rest = bytes.get(written..).unwrap_or_default();
        if let Some(place) = self.unsent.get_mut(..rest.len()) {
            place.copy_from_slice(rest);
            self.left = rest.len();
        }
        Ok(())
    }

    /// Writes the rest of the last frame, as far as there is room.
    pub(super) fn flush(&mut self) -> Result<(), LinkError> {
        if self.left == 0 {
            return Ok(());
        }
        let unsent = self.unsent;
        let written = self.write(unsent.get(..self.left).unwrap_or_default())?;
        self.unsent.copy_within(written..self.left, 0);
        self.left -= written;
        Ok(())
    }

    pub(super) const fn has_unsent(&self) -> bool {
        self.left > 0
    }

    /// How many bytes the kernel took, at most all of them.
    fn write(&self, bytes: &[u8]) -> Result<usize, LinkError> {
        match rustix::io::write(&self.fd, bytes) {
            Ok(count) => Ok(count.min(bytes.len())),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(error) => Err(ended("writing to", error)),
        }
    }

    pub(super) fn try_recv(&mut self, frame: &mut CanFrame) -> Result<Option<Arrival>, LinkError> {
        loop {
            while self.taken < self.filled {
                if let Decoded::Frame(found) = self.decode() {
                    *frame = found;
                    self.stamped = arrival::completed(self.arrived, self.filled - self.taken, self.stamped);
                    return Ok(Some(Arrival { at: self.stamped, from_kernel: false }));
                }
            }
            if !self.fill()? {
                return Ok(None);
            }
        }
    }

    /// Reads pending bytes; false if there are none.
    fn fill(&mut self) -> Result<bool, LinkError> {
        match rustix::io::read(&self.fd, &mut self.inbox[..]) {
            Ok(0) => Err(LinkError::Gone),
            Ok(count) => {
                self.arrived = Stamp::now();
                (self.taken, self.filled) = (0, count);
                Ok(true)
            }
            Err(Errno::AGAIN | Errno::INTR) => Ok(false),
            Err(error) => Err(ended("reading", error)),
        }
    }

    /// Takes bytes from the inbox up to the end of one message at most.
    fn decode(&mut self) -> Decoded {
        let bytes = self.inbox.get(self.taken..self.filled).unwrap_or_default();
        let (taken, decoded) = match &mut self.codec {
            Codec::Slcan(codec) => {
                let (taken, event) = codec.feed(bytes);
                let decoded = match event {
                    Some(slcan::Event::Frame(frame, _)) => Decoded::Frame(frame),
                    Some(slcan::Event::Done) => Decoded::Answer { refused: false },
                    Some(slcan::Event::Refused) => Decoded::Answer { refused: true },
                    None => Decoded::Nothing,
                };
                (taken, decoded)
            }
            Codec::Damiao(codec) => {
                use damiao_serial::Kind;
                let (taken, message) = codec.feed(bytes);
                let decoded = match message.map(|message| (message.kind, message.frame)) {
                    Some((Kind::Received, frame)) => Decoded::Frame(frame),
                    Some((Kind::SendFailed, _)) => Decoded::Answer { refused: true },
                    Some((Kind::ReceiveFailed, _)) => {
                        self.lost += 1;
                        Decoded::Nothing
                    }
                    // As the kernel reports a controller that left the bus: linux/can/error.h.
                    Some((Kind::BusError, _)) => {
                        Decoded::Frame(CanFrame { id: 0x40, error: true, ..CanFrame::default() })
                    }
                    _ => Decoded::Nothing,
                };
                (taken, decoded)
            }
        };
        self.taken += taken;
        self.refused += u64::from(matches!(decoded, Decoded::Answer { refused: true }));
        decoded
    }

    pub(super) fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }

    pub(super) fn take_refused(&mut self) -> u64 {
        std::mem::take(&mut self.refused)
    }

    pub(super) fn description(&self) -> &str {
        &self.description
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        // The adapter would keep filling the line without a reader. It may be gone by now.
        if matches!(self.codec, Codec::Slcan(_)) {
            let _ = self.put(slcan::Command::Close.encode().bytes());
        }
    }
}

impl AsFd for Line {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

/// A line whose device is gone reports EIO, ENODEV or ENXIO.
fn ended(what: &str, error: Errno) -> LinkError {
    match error {
        Errno::IO | Errno::NODEV | Errno::NXIO | Errno::BADF | Errno::PIPE => LinkError::Gone,
        _ => LinkError::Retry(format!("{what} the adapter's line: {error}")),
    }
}
