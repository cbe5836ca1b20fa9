//! Sends and receives on a CAN interface of the guest, as `cansend` and `candump` would.

use std::fs;
use std::io;
use std::os::fd::OwnedFd;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::addr::{SocketAddrArg, SocketAddrLen, SocketAddrOpaque};
use rustix::net::sockopt::set_socket_recv_buffer_size_force;
use rustix::net::{AddressFamily, Protocol, RecvFlags, SendFlags, SocketType, bind, recv, send, socket};
use serde_json::{Value, json};

use super::tally::Tally;
use crate::clock;
use crate::emu::can::Frame;
use crate::emu::can::bus::FLOOD_ID;

/// `struct can_frame`: identifier and flags, length, three bytes of padding, data.
const CAN_FRAME: usize = 16;
const ERROR: u32 = 1 << 29;
const EXTENDED: u32 = 1 << 31;
/// Time limit for an answer.
const PATIENCE: Duration = Duration::from_secs(6);

/// Receive buffer for seconds of a full bus, so that a reader delayed by a busy machine loses nothing.
const ROOM: usize = 16 << 20;

/// A raw socket on one interface.
#[derive(Debug)]
pub struct Bus {
    socket: OwnedFd,
}

/// `struct sockaddr_can` as far as a raw socket needs it.
#[repr(C)]
struct Address {
    family: u16,
    interface: i32,
    _rest: [u32; 4],
}

// SAFETY: the pointer is to a whole `sockaddr_can` (linux/can.h) that outlives the call.
unsafe impl SocketAddrArg for Address {
    unsafe fn with_sockaddr<R>(&self, f: impl FnOnce(*const SocketAddrOpaque, SocketAddrLen) -> R) -> R {
        let length = SocketAddrLen::try_from(size_of::<Self>()).unwrap_or_default();
        f(std::ptr::from_ref(self).cast(), length)
    }
}

impl Bus {
    /// Opens an interface by its name.
    pub fn open(name: &str) -> io::Result<Self> {
        let index = fs::read_to_string(format!("/sys/class/net/{name}/ifindex"))?;
        let interface = index.trim().parse().map_err(io::Error::other)?;
        // CAN_RAW; rustix does not name it.
        let raw = std::num::NonZeroU32::new(1).map(Protocol::from_raw);
        let socket = socket(AddressFamily::CAN, SocketType::RAW, raw)?;
        set_socket_recv_buffer_size_force(&socket, ROOM)?;
        bind(&socket, &Address { family: AddressFamily::CAN.as_raw(), interface, _rest: [0; 4] })?;
        Ok(Self { socket })
    }

    /// Puts a frame on the bus.
    pub fn send(&self, frame: &Frame) -> Result<(), Errno> {
        let mut bytes = [0; CAN_FRAME];
        bytes[..4].copy_from_slice(&(frame.id | if frame.extended { EXTENDED } else { 0 }).to_ne_bytes());
        bytes[4] = frame.len();
        bytes[8..].copy_from_slice(&frame.padded());
        send(&self.socket, &bytes, SendFlags::empty()).map(drop)
    }

    /// The next frame; `None` if none arrived within `limit`.
    pub fn receive(&self, limit: Duration) -> Result<Option<Frame>, Errno> {
        let end = Instant::now() + limit;
        loop {
            let left = Timespec::try_from(end.saturating_duration_since(Instant::now())).map_err(|_| Errno::INVAL)?;
            if poll(&mut [PollFd::new(&self.socket, PollFlags::IN)], Some(&left))? == 0 {
                return Ok(None);
            }
            let mut bytes = [0; CAN_FRAME];
            recv(&self.socket, &mut bytes, RecvFlags::empty())?;
            let id = u32::from_ne_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
            let len = usize::from(bytes[4]);
            if id & ERROR == 0
                && let Some(data) = bytes.get(8..8 + len)
                && let Some(frame) = Frame::new(id & 0x1fff_ffff, id & EXTENDED != 0, false, len, data)
            {
                return Ok(Some(frame));
            }
        }
    }
}

/// Parses `ID#DATA`, as `cansend` does: three digits of the identifier, two per byte.
pub fn parse(text: &str) -> Option<Frame> {
    let (id, data) = text.split_once('#')?;
    let (pairs, odd) = data.as_bytes().as_chunks::<2>();
    let byte = |pair: &[u8; 2]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    let bytes: Option<Vec<u8>> = if odd.is_empty() { pairs.iter().map(byte).collect() } else { None };
    let bytes = bytes?;
    Frame::new(u32::from_str_radix(id, 16).ok()?, id.len() > 3, false, bytes.len(), &bytes)
}

/// A frame in the format of `parse`.
pub fn text(frame: &Frame) -> String {
    let digits = if frame.extended { 8 } else { 3 };
    let data: String = frame.bytes().iter().map(|byte| format!("{byte:02x}")).collect();
    format!("{:0digits$x}#{data}", frame.id)
}

/// Sends each frame and prints the next received one, or `-` if there is none.
pub fn ask(name: &str, frames: &[&str]) -> io::Result<()> {
    let bus = Bus::open(name)?;
    for wanted in frames {
        let frame = parse(wanted).ok_or_else(|| io::Error::other(format!("`{wanted}` is no ID#DATA")))?;
        bus.send(&frame)?;
        println!("{}", bus.receive(PATIENCE)?.map_or_else(|| "-".into(), |frame| text(&frame)));
    }
    Ok(())
}

/// Sends a frame every `period` until the interface is gone; returns frames sent and received, and what ended it.
pub fn stream(name: &str, frame: &str, period: Duration) -> io::Result<Value> {
    let frame = parse(frame).ok_or_else(|| io::Error::other("no ID#DATA"))?;
    let bus = Bus::open(name)?;
    let (mut sent, mut received) = (0_u64, 0_u64);
    let ended = |sent, received, error: Errno| {
        Ok(json!({
            "sent": sent, "received": received, "errno": error.raw_os_error(), "mono_ns": clock::mono_ns(),
        }))
    };
    loop {
        match bus.send(&frame) {
            // The queue is full while the bus is off.
            Ok(()) | Err(Errno::NOBUFS) => sent += 1,
            Err(error) => return ended(sent, received, error),
        }
        let end = Instant::now() + period;
        loop {
            match bus.receive(end.saturating_duration_since(Instant::now())) {
                Ok(Some(_)) => received += 1,
                Ok(None) => break,
                Err(error) => return ended(sent, received, error),
            }
        }
    }
}

/// Reads this many generated frames and counts them.
pub fn count(name: &str, wanted: usize) -> io::Result<Value> {
    let bus = Bus::open(name)?;
    let mut tally = Tally::default();
    while tally.len() < wanted {
        let Some(frame) = bus.receive(PATIENCE)? else { break };
        if frame.id == u32::from(FLOOD_ID) {
            let [a, b, c, d, ..] = frame.padded();
            tally.add(u32::from_le_bytes([a, b, c, d]));
        }
    }
    Ok(tally.summary())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_words() {
        for word in ["005#7fff7ff0000007ff", "7ff#", "00000005#ab"] {
            assert_eq!(parse(word).map(|frame| text(&frame)).as_deref(), Some(word));
        }
        for word in ["005", "005#7", "005#xx", "fff#00", "005#000102030405060708"] {
            assert_eq!(parse(word), None, "{word}");
        }
    }
}
