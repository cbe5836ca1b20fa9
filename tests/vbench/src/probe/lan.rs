//! Receives a LiDAR's packets in the guest.

use std::io::{self, ErrorKind};
use std::net::UdpSocket;
use std::time::Duration;

use serde_json::{Value, json};

use crate::clock;
use crate::emu::lan::lidar;

/// Packets come more often than this, or there are none.
const PATIENCE: Duration = Duration::from_secs(5);

/// Reads so many packets; how many numbers were missing among them, and how long it took.
pub fn count(port: u16, wanted: u64) -> io::Result<Value> {
    let socket = UdpSocket::bind(("0.0.0.0", port))?;
    socket.set_read_timeout(Some(PATIENCE))?;
    let (mut packets, mut lost, mut next) = (0_u64, 0_u64, None);
    let mut begun_ns = 0;
    let mut bytes = [0; 2048];
    while packets < wanted {
        let length = match socket.recv(&mut bytes) {
            Ok(length) => length,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => break,
            Err(error) => return Err(error),
        };
        let Some(number) = lidar::number(&bytes[..length]) else { continue };
        match next {
            None => begun_ns = clock::mono_ns(),
            Some(next) => lost += u64::from(number.wrapping_sub(next)),
        }
        next = Some(number.wrapping_add(1));
        packets += 1;
    }
    let seconds = clock::mono_ns().saturating_sub(begun_ns) as f64 / 1e9;
    Ok(json!({"packets": packets, "lost": lost, "seconds": seconds}))
}
