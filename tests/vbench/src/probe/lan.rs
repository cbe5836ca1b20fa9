//! Receives a LiDAR's packets in the guest.

use std::io::{self, ErrorKind};
use std::net::UdpSocket;
use std::time::Duration;

use rustix::net::sockopt::set_socket_recv_buffer_size_force;
use serde_json::Value;

use super::tally::Tally;
use crate::emu::lan::lidar;

/// Receive buffer for seconds of packets, so that a reader delayed by a busy machine loses nothing.
const ROOM: usize = 16 << 20;
/// Time limit for a packet.
const PATIENCE: Duration = Duration::from_secs(30);

/// Reads this many packets and counts them.
pub fn count(port: u16, wanted: usize) -> io::Result<Value> {
    let socket = UdpSocket::bind(("0.0.0.0", port))?;
    socket.set_read_timeout(Some(PATIENCE))?;
    set_socket_recv_buffer_size_force(&socket, ROOM)?;
    let mut tally = Tally::default();
    let mut bytes = [0; 2048];
    while tally.len() < wanted {
        let length = match socket.recv(&mut bytes) {
            Ok(length) => length,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => break,
            Err(error) => return Err(error),
        };
        lidar::number(&bytes[..length]).into_iter().for_each(|number| tally.add(number));
    }
    Ok(tally.summary())
}
