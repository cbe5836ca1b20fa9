//! Independent eyes inside the guest: what a camera delivers, what goes over CAN and the network, what the mask is, what kernel
//! and udev report and how evenly a thread can beat, all without `rapid`.
//!
//! Invariant: the only `unsafe` of the bench is here, in the calls of V4L2 and the address of a CAN socket.

pub mod beat;
pub mod can;
pub mod keys;
pub mod lan;
pub mod mask;
pub mod tally;
pub mod uevent;
pub mod v4l;
