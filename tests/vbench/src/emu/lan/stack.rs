//! The TCP/IP behind an adapter: `smoltcp` on two queues of Ethernet frames, an HTTP server, datagrams.
//!
//! Invariant: the output never exceeds `QUEUE` frames; TCP waits for space.

use std::collections::VecDeque;
use std::fmt;
use std::net::Ipv4Addr;

use serde_json::json;
use smoltcp::iface::{Config, Interface, SocketHandle, SocketSet};
use smoltcp::phy::{self, Device, DeviceCapabilities, Medium};
use smoltcp::socket::{tcp, udp};
use smoltcp::time::Instant;
use smoltcp::wire::{EthernetAddress, IpCidr, Ipv4Cidr};

use super::gopro::{self, Gopro};
use super::http::{self, Body, Inbox, Reply};

/// Frames that wait for the host.
const QUEUE: usize = 64;
/// Maximum simultaneous connections.
const CONNECTIONS: usize = 6;
/// Minimum frame size of cables and drivers.
const SHORTEST_FRAME: usize = 60;
const LONGEST_FRAME: usize = 1514;

/// The network behind an adapter.
pub struct Stack {
    interface: Interface,
    wire: Wire,
    sockets: SocketSet<'static>,
    connections: Vec<Connection>,
    datagrams: SocketHandle,
}

struct Connection {
    handle: SocketHandle,
    inbox: Vec<u8>,
    /// The answer, and how much of header and body has been sent.
    reply: Option<(Reply, usize)>,
}

impl Stack {
    /// A network of one host with this address, and the computer.
    pub fn new(mac: [u8; 6], address: Ipv4Addr) -> Self {
        let mut wire = Wire::default();
        let mut config = Config::new(EthernetAddress(mac).into());
        config.random_seed = u64::from(mac[5]);
        let mut interface = Interface::new(config, &mut wire, Instant::ZERO);
        interface.update_ip_addrs(|all| all.push(IpCidr::Ipv4(Ipv4Cidr::new(address, 24))).expect("room for one"));
        let mut sockets = SocketSet::new(Vec::new());
        let connections = (0..CONNECTIONS)
            .map(|_| {
                let buffer = |size| tcp::SocketBuffer::new(vec![0; size]);
                let handle = sockets.add(tcp::Socket::new(buffer(8 * 1024), buffer(64 * 1024)));
                Connection { handle, inbox: Vec::new(), reply: None }
            })
            .collect();
        let buffer = || udp::PacketBuffer::new(vec![udp::PacketMetadata::EMPTY; 4], vec![0; 8 * 1024]);
        let datagrams = sockets.add(udp::Socket::new(buffer(), buffer()));
        Self { interface, wire, sockets, connections, datagrams }
    }

    /// Receives a frame from the host.
    pub fn receive(&mut self, frame: &[u8]) {
        if self.wire.inbound.len() < QUEUE {
            self.wire.inbound.push_back(frame.to_vec());
        }
    }

    /// Processes received frames; returns when it must be called again at the latest.
    pub fn poll(&mut self, mut gopro: Option<&mut Gopro>, now_ns: u64) -> Option<u64> {
        let now = instant(now_ns);
        loop {
            self.interface.poll(now, &mut self.wire, &mut self.sockets);
            let mut changed = false;
            if let Some(gopro) = &mut gopro {
                for connection in &mut self.connections {
                    let socket = self.sockets.get_mut::<tcp::Socket<'_>>(connection.handle);
                    changed |= connection.serve(socket, gopro, now_ns);
                }
            }
            if !changed {
                break;
            }
        }
        let due = self.interface.poll_at(now, &self.sockets)?;
        // The host empties a full queue, not the clock.
        let is_full = self.wire.outbound.len() >= QUEUE;
        let due_ns = u64::try_from(due.total_micros()).unwrap_or_default() * 1_000;
        (!is_full).then_some(due_ns.max(now_ns + 1_000_000))
    }

    /// Broadcasts a datagram.
    pub fn broadcast(&mut self, port: u16, payload: &[u8], now_ns: u64) {
        let socket = self.sockets.get_mut::<udp::Socket<'_>>(self.datagrams);
        if !socket.is_open() {
            // This fails only for port 0.
            let _bound = socket.bind(port);
        }
        if socket.send_slice(payload, (Ipv4Addr::BROADCAST, port)).is_ok() {
            self.interface.poll(instant(now_ns), &mut self.wire, &mut self.sockets);
        }
    }

    /// Whether no frame waits to be sent.
    pub fn is_quiet(&self) -> bool {
        self.wire.outbound.is_empty()
    }

    /// The next frame for the host.
    pub fn next_frame(&mut self) -> Option<Vec<u8>> {
        self.wire.outbound.pop_front()
    }

    /// Discards waiting frames.
    pub fn discard(&mut self) {
        self.wire.outbound.clear();
        self.wire.inbound.clear();
    }

    /// The cable is gone: connections end silently.
    pub fn hang_up(&mut self) {
        for connection in &mut self.connections {
            self.sockets.get_mut::<tcp::Socket<'_>>(connection.handle).abort();
            connection.inbox.clear();
            connection.reply = None;
        }
        self.interface.poll(instant(0), &mut self.wire, &mut self.sockets);
        self.discard();
    }
}

impl fmt::Debug for Stack {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Stack").field("address", &self.interface.ipv4_addr()).finish_non_exhaustive()
    }
}

impl Connection {
    /// Makes as much progress as possible; true if anything changed.
    fn serve(&mut self, socket: &mut tcp::Socket<'_>, gopro: &mut Gopro, now_ns: u64) -> bool {
        if matches!(socket.state(), tcp::State::TimeWait) {
            socket.abort();
        }
        if !socket.is_open() {
            self.inbox.clear();
            self.reply = None;
            return socket.listen(gopro::PORT).is_ok();
        }
        let mut changed = false;
        while self.reply.is_none() && socket.can_recv() {
            let took = socket.recv(|bytes| {
                self.inbox.extend_from_slice(bytes);
                (bytes.len(), bytes.len())
            });
            changed |= took.is_ok_and(|took| took > 0);
            self.reply = match http::read(&self.inbox) {
                Inbox::Partial => None,
                Inbox::Bad => Some(Reply::json(400, &json!({"error": "no request"}))),
                Inbox::Whole(request) => Some(gopro.answer(&request, now_ns)),
            }
            .map(|reply| (reply, 0));
        }
        let Some((reply, sent)) = &mut self.reply else {
            // The host closed the connection without a request.
            if matches!(socket.state(), tcp::State::CloseWait) {
                socket.close();
            }
            return changed;
        };
        let mut is_done = false;
        while socket.can_send() && !is_done {
            let put = socket.send(|room| {
                let put = reply.write(*sent, room);
                (put, put)
            });
            let put = put.unwrap_or_default();
            *sent += put;
            changed |= put > 0;
            is_done = put == 0;
        }
        if is_done {
            socket.close();
        }
        changed
    }
}

impl Reply {
    /// Writes its bytes from `at` on over `out`, as many as fit; returns their number, 0 at the end.
    fn write(&self, at: usize, out: &mut [u8]) -> usize {
        let head = self.head();
        let copy = |from: &[u8], out: &mut [u8]| {
            let length = from.len().min(out.len());
            out[..length].copy_from_slice(&from[..length]);
            length
        };
        if let Some(rest) = head.as_bytes().get(at..).filter(|rest| !rest.is_empty()) {
            return copy(rest, out);
        }
        let at = at - head.len();
        match &self.body {
            Body::Json(text) => copy(&text.as_bytes()[at..], out),
            Body::Clip { number, from, size } => {
                let left = size - from - at as u64;
                let length = usize::try_from(left).unwrap_or(usize::MAX).min(out.len());
                gopro::clip(*number, from + at as u64, &mut out[..length]);
                length
            }
        }
    }
}

/// Two queues of frames.
#[derive(Debug, Default)]
struct Wire {
    inbound: VecDeque<Vec<u8>>,
    outbound: VecDeque<Vec<u8>>,
}

impl Device for Wire {
    type RxToken<'a> = Received;
    type TxToken<'a> = Room<'a>;

    fn receive(&mut self, _now: Instant) -> Option<(Received, Room<'_>)> {
        let frame = self.inbound.pop_front()?;
        Some((Received(frame), Room(&mut self.outbound)))
    }

    fn transmit(&mut self, _now: Instant) -> Option<Room<'_>> {
        (self.outbound.len() < QUEUE).then_some(Room(&mut self.outbound))
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = LONGEST_FRAME;
        capabilities
    }
}

struct Received(Vec<u8>);

impl phy::RxToken for Received {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, f: F) -> R {
        f(&self.0)
    }
}

struct Room<'a>(&'a mut VecDeque<Vec<u8>>);

impl phy::TxToken for Room<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, f: F) -> R {
        let mut frame = vec![0; length.max(SHORTEST_FRAME)];
        let result = f(&mut frame[..length]);
        self.0.push_back(frame);
        result
    }
}

fn instant(now_ns: u64) -> Instant {
    Instant::from_micros(i64::try_from(now_ns / 1_000).unwrap_or(i64::MAX))
}

#[cfg(test)]
#[path = "stack_tests.rs"]
mod tests;
