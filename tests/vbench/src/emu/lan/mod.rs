//! A USB network adapter and the devices behind it: a camera controlled over HTTP, a LiDAR that sends packets.
//!
//! Invariant: no clock, no system socket, no thread below this module; the TCP/IP stack is `smoltcp`, in memory.

pub mod ecm;
pub mod gopro;
pub mod http;
pub mod lidar;
pub mod stack;
