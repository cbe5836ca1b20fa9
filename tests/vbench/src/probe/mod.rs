//! Independent observers inside the guest, without `rapid`: camera data, CAN and network traffic, the mask, kernel and
//! udev events, and how evenly a thread can wake.
//!
//! Invariant: the only `unsafe` code of the bench is here: V4L2 calls and the address of a CAN socket.

pub mod beat;
pub mod can;
pub mod keys;
pub mod lan;
pub mod mask;
pub mod tally;
pub mod uevent;
pub mod v4l;
