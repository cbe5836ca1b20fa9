//! A USB network adapter and what is behind it: a camera that is controlled over HTTP, a LiDAR that sends packets.
//!
//! Invariant: no clock, no socket of the system's, no thread below this module; the TCP/IP is `smoltcp`'s, in memory.

pub mod ecm;
pub mod gopro;
pub mod http;
pub mod lidar;
pub mod stack;
